"""What a fixed-lag smoother keeps."""

from jaxtyping import Float32, Float64, Int64
from tensordict import TensorClass
from torch import Tensor


class SmootherBelief(TensorClass):
    """The window's W states and what was sensed (``window``) and heard of neighbours (``heard``:
    positions, variances) in them, the newest last; what is known of the second of them from before
    (``prior``, ``prior_covariance``), steps taken, and the condensed graphs sent last, the newest
    last; and the newest state's covariance (``spread``) where landmarks come without names; batch
    (B, N)."""

    states: Float64[Tensor, "B N W S"]
    window: Float32[Tensor, "B N W F"]
    heard: Float64[Tensor, "B N W H"]
    prior: Float64[Tensor, "B N S"]
    prior_covariance: Float64[Tensor, "B N E E"]
    step: Int64[Tensor, "B N"]
    sent: Float64[Tensor, "B N A L"]
    spread: Float64[Tensor, "B N E G"]
