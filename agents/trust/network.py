"""The networks behind learned trust: one for vector measurements, one for ranges."""

import math

from jaxtyping import Float
from torch import Tensor, nn

from agents.layers import Linear, SiLU, sigmoid, softplus
from agents.weights import Learned

HIDDEN = 32
SHARED = (
    "innovation",  # log(1 + D²/k): Mahalanobis distance of the innovation under the prior
    "residual",  # log(1 + ‖r̃‖²/k): residual after a Huber update, over its noise
    "own_std",  # log of the position's prior standard deviation, m
    "doubt",  # log(1 + tr HPHᵀ / tr R): what the prior adds to the noise
    "partner",  # log(1 + partner's share): what the partner's uncertainty adds to the noise
    "vectors",  # log(1 + number of vector measurements seen)
    "ranges",  # log(1 + number of ranges seen)
    "vectors_lately",  # running mean of ``vectors`` over some 5 s
    "others_mean",  # leave-one-out mean of ``residual`` over the block
    "others_median",  # and median
    "link_mean",  # running mean of ``innovation`` on this link
    "block_mean",  # its mean over the block's links seen so far
)
SIGNED = (
    "signed_innovation",  # asinh of the innovation over its standard deviation: too long is > 0
    "signed_residual",  # asinh of the residual after a Huber update, over its noise
    "link_sign",  # running mean of ``signed_innovation`` on this link
)
_AT_FIRST = math.log(0.98 / 0.02)  # the trust's logit before training


def _layers(inputs: int, outputs: int) -> nn.Sequential:
    last = Linear(HIDDEN, outputs)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(Linear(inputs, HIDDEN), SiLU(), Linear(HIDDEN, HIDDEN), SiLU(), last)


class TrustNetwork(Learned):
    """How far to trust a measurement, from numbers that mean the same for any team and map.

    A vector measurement (landmark, bearing) gets a weight in [0, 1]; a range a weight and a bias
    ≥ 0 in standard deviations of its noise. Some 3 300 weights; untrained it trusts nearly all.
    """

    kind = "trust"
    features = SHARED + SIGNED

    def __init__(self) -> None:
        super().__init__()
        self.vectors = _layers(len(SHARED), 1)
        self.ranges = _layers(len(SHARED) + len(SIGNED), 2)

    def trust_vectors(self, features: Float[Tensor, "*s 12"]) -> Float[Tensor, "*s"]:
        """Weights of vector measurements."""
        return sigmoid(_AT_FIRST + self.vectors(features)[..., 0])

    def trust_ranges(
        self, features: Float[Tensor, "*s 15"]
    ) -> tuple[Float[Tensor, "*s"], Float[Tensor, "*s"]]:
        """Weights of ranges, and biases over the noise's standard deviation."""
        weight, bias = self.ranges(features).unbind(-1)
        return sigmoid(_AT_FIRST + weight), softplus(bias - 4.0)
