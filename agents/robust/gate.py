"""The Mahalanobis gate: measurements that the prediction finds too unlikely are left out."""

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block
from agents.robust.mahalanobis import chi_square, mahalanobis_squared


def gate_weights(
    block: Block, covariance: Float[Tensor, "B N E E"], probability: float
) -> Float[Tensor, "B N m"]:
    """1 where the innovation's Mahalanobis distance is inside the χ² ``probability`` quantile."""
    limit = chi_square(probability, block.residual.shape[-1])
    return (mahalanobis_squared(block, covariance) <= limit).to(block.residual.dtype)


def residual_gate_weights(block: Block, probability: float) -> Float[Tensor, "B N m"]:
    """The same for residuals at an estimate that is sharp beside each measurement's own noise."""
    limit = chi_square(probability, block.residual.shape[-1])
    squared = (block.residual**2 / block.total_variance).sum(-1)
    return (squared <= limit).to(block.residual.dtype)
