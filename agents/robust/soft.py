"""Likelihoods with heavier tails as weights of measurements, for iterated least squares."""

from collections.abc import Callable
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block
from agents.robust.heavy_tails import mixture_weights, student_weights
from agents.robust.huber import huber_weights
from agents.robust.screen import Trust

SOFT: dict[str, Callable[[Block], Float[Tensor, "B N m"]]] = {
    "huber": huber_weights,
    "student": student_weights,
    "mixture": mixture_weights,
}
SoftName = Literal["none", "huber", "student", "mixture"]


def soft_trust(name: SoftName, block: Block) -> Trust:
    """The weights that a likelihood (``none``: the Gaussian) gives a block's measurements, at the
    state that it is linearized about."""
    return Trust() if name == "none" else Trust(SOFT[name](block))


def widened(name: SoftName, block: Block) -> Float[Tensor, "B N m k"]:
    """The noise's variances over those weights."""
    weight = soft_trust(name, block).weight
    return block.variance if weight is None else block.variance / weight.unsqueeze(-1)
