"""Ranges expanded to the second order, where positions are uncertain across the line of sight."""

from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from agents.models.measurements.base import Block, Measurement
from agents.models.measurements.ranges import AnchorRanges, UavRanges
from coloc_env.observation import Observation


def expanded(
    model: Measurement,
    block: Block,
    relative: Float[Tensor, "B N #m d d"],
    observation: Observation,
) -> Block:
    """A block of ranges with their second-order terms (Jazwinski 1970, section 9.3):
    E r ≈ r̂ + ½ σ_⊥² / r̂, whose variance is ½ (σ_⊥² / r̂)²; σ_⊥² is the variance across the line of
    ``relative``, the covariance (m²) of the positions at its ends. Other blocks, and ranges of tags
    with lever arms, stay as they are."""
    if not isinstance(model, UavRanges | AnchorRanges) or model.tags:
        return block
    unit = block.jacobian[..., 0, : relative.shape[-1]]  # [B, N, m, d]
    along = ((relative @ unit.unsqueeze(-1))[..., 0] * unit).sum(-1)
    across = relative.diagonal(dim1=-2, dim2=-1).sum(-1) - along
    measured = model.read(observation)[0].to(across.dtype)
    distance = (measured - block.residual[..., 0]).clamp_min(1e-3)
    longer = (0.5 * across.clamp_min(0.0) / distance).unsqueeze(-1)
    return replace(block, residual=block.residual - longer, variance=block.variance + 2 * longer**2)
