"""What is left of a team's measurements at a localizer's estimate: numbers for a learner to judge
that estimate by, in metres and in the world frame."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements import Block

_CLIP = 2.0  # standard deviations at which a clipped residual ends


def robust_statistics(
    apart: Float[Tensor, "B N m d"], mask: Bool[Tensor, "B N m"]
) -> tuple[Float[Tensor, "B N d"], Float[Tensor, "B N d"], Float[Tensor, "B N d"]]:
    """Median, Huber mean and scatter of vectors, 0 where there is none.

    The Huber mean is one step from the median, with weights min(1, c/‖x − median‖), c the median
    distance to the median; the scatter is the root mean square distance from the mean.
    """
    seen = mask.unsqueeze(-1)
    count = mask.sum(-1, keepdim=True).clamp_min(1)
    nothing = apart.masked_fill(~seen, torch.nan)
    median = nothing.nanmedian(-2).values.nan_to_num(0.0)
    distance = torch.linalg.vector_norm(apart - median.unsqueeze(-2), dim=-1)
    typical = distance.masked_fill(~mask, torch.nan).nanmedian(-1, keepdim=True).values
    weight = (typical.nan_to_num(0.0) / distance.clamp_min(1e-9)).clamp(max=1.0)
    # Two alike are their own median; with a typical distance of 0 all that count are at it.
    weight = torch.where(typical > 0, weight, (distance == 0).to(weight)) * mask
    total = weight.sum(-1, keepdim=True).clamp_min(1e-9)
    huber = (apart * weight.unsqueeze(-1)).sum(-2) / total
    mean = (apart * seen).sum(-2) / count
    spread = ((apart - mean.unsqueeze(-2)) * seen).square().sum(-2) / count
    return median, huber, spread.sqrt()


def pulls(blocks: Sequence[Block], dim: int) -> tuple[Tensor, Tensor]:
    """Where measurements pull the estimate: the mean of h r/‖h‖² over all of them, with h the
    derivative of each by the position and r its residual, raw and with r clipped at twice its
    standard deviation; [B, N, d] each, 0 where nothing was measured."""
    raw, clipped, count = [], [], []
    for block in blocks:
        h, r = block.jacobian[..., :dim], block.residual
        unit = h / h.square().sum(-1, keepdim=True).clamp_min(1e-9)
        seen = block.mask[..., None, None]
        limit = _CLIP * block.total_variance.sqrt()
        short = torch.maximum(torch.minimum(r, limit), -limit)
        raw.append((unit * r.unsqueeze(-1) * seen).sum((-3, -2)))
        clipped.append((unit * short.unsqueeze(-1) * seen).sum((-3, -2)))
        count.append(block.mask.sum(-1))
    total = torch.stack(count).sum(0).clamp_min(1).unsqueeze(-1)
    return torch.stack(raw).sum(0) / total, torch.stack(clipped).sum(0) / total
