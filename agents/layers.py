"""Layers of small networks inside filters."""

from jaxtyping import Float
from torch import Tensor, nn


class Linear(nn.Linear):
    """A linear layer whose rounding for one UAV does not depend on how many share its batch.

    torch folds all leading dimensions into the rows of one product, whose kernels round by the
    number of rows; here every UAV's (second but last dimension's) rows are a product of their own.
    A single output is computed twice: products with one column go a way of their own.
    """

    def forward(self, x: Float[Tensor, "*s m i"]) -> Float[Tensor, "*s m o"]:
        weight = self.weight.mT
        if self.out_features == 1:
            weight = weight.expand(-1, 2)
        product = x @ weight.expand(*x.shape[:-2], *weight.shape)
        return product[..., : self.out_features] + self.bias
