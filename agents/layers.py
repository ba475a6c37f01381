"""Layers of small networks inside filters.

torch's own sigmoid, SiLU and softplus round differently in vectorized bodies and tails, which would
make a UAV's numbers depend on how many share its batch; tanh, exp and log1p do not.
"""

import torch
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
        return row_product(x, weight)[..., : self.out_features] + self.bias


def row_product(
    x: Float[Tensor, "*s m i"], weight: Float[Tensor, "i o"]
) -> Float[Tensor, "*s m o"]:
    """x @ weight, each of x's last two dimensions a product of its own."""
    return x @ weight.expand(*x.shape[:-2], *weight.shape)


def sigmoid(x: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """1 / (1 + e^−x)."""
    return 0.5 + 0.5 * torch.tanh(0.5 * x)


def softplus(x: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """log(1 + eˣ)."""
    return torch.log1p(torch.exp(x))


class SiLU(nn.Module):
    """x σ(x)."""

    def forward(self, x: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
        return x * sigmoid(x)
