"""Huber's weights: outliers count less the farther out they lie."""

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block
from agents.robust.mahalanobis import chi_square

_CORE = 0.8214  # share of a Gaussian inside Huber's quadratic core for 95 % efficiency (1.345 σ)


def huber_weights(block: Block) -> Float[Tensor, "B N m"]:
    """min(1, c/‖r̃‖) of the residual scaled by its noise (Huber 1964); c grows with its size k so
    that the same share of inliers keeps full weight."""
    squared = (block.residual**2 / block.total_variance).sum(-1)
    core = chi_square(_CORE, block.residual.shape[-1])
    return (core / squared.clamp_min(core)).sqrt()
