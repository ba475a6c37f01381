"""The networks behind learned trust: one for vector measurements, one for ranges."""

import math

import torch
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
RELATIVE = ("relative_std", "relative_doubt", "relative_partner")
"""What stands for ``own_std``, ``doubt`` and ``partner`` in networks without units: log of the
position's prior standard deviation over the noise's, and the other two by component, so that metres
and radians are never added."""
_ABSOLUTE = SHARED[2:5]
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
    ``relative``: its features are free of units (``RELATIVE``); the first trainings' are not.
    """

    kind = "trust"
    features: tuple[str, ...] = SHARED + SIGNED

    def __init__(self, relative: bool = False) -> None:
        super().__init__()
        self.relative = relative
        if relative:
            self.architecture = {"relative": True}
            self.features = tuple(
                dict(zip(_ABSOLUTE, RELATIVE, strict=True)).get(name, name)
                for name in SHARED + SIGNED
            )
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

    @classmethod
    def relative_to(cls, other: "TrustNetwork", vectors: float, ranges: float) -> "TrustNetwork":
        """A network with relative features that judges as ``other``, one without, does where
        vectors and ranges have noise of these standard deviations (m): what was log s is
        log(s / σ) + log σ."""
        made = cls(relative=True)
        made.load_state_dict(other.state_dict())
        with torch.no_grad():
            for layers, std in ((made.vectors, vectors), (made.ranges, ranges)):
                first = layers[0]
                assert isinstance(first, nn.Linear)
                first.bias.add_(first.weight[:, SHARED.index("own_std")], alpha=math.log(std))
        return made
