"""What the trust networks are fed for each measurement: dimensionless, the same for any team.

Every feature is a pure function of a UAV's own blocks, prior and memory; see ``network.SHARED`` and
``network.SIGNED`` for their order and meaning.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block
from agents.robust.screen import Prediction

MEMORY = 3  # numbers kept of each link: running means of innovation and sign, and of being seen
_RATE = 0.1  # of the running means
_SLOW = 0.02  # of the running mean of how many vectors are seen
_FAR = 1e6  # what stands for squares of residuals that nothing could have


@dataclass(frozen=True)
class Innovation:
    """A block's innovations against the prior; ``innovation`` and ``sign`` as the networks get
    them, ``doubt`` = log(1 + tr HPHᵀ / tr R)."""

    innovation: Float[Tensor, "B N m"]
    sign: Float[Tensor, "B N m"]
    doubt: Float[Tensor, "B N m"]
    partner: Float[Tensor, "B N m"]
    seen: Float[Tensor, "B N m"]


def innovation(
    block: Block, covariance: Float[Tensor, "B N E E"], relative: bool = False
) -> Innovation:
    """Of a block linearized at the prior with error covariance ``covariance``; ``relative``: shares
    of variances by component, where these have other units."""
    h, r, noise = block.jacobian, block.residual, block.total_variance
    spread = h @ covariance.unsqueeze(-3) @ h.mT
    s = spread + torch.diag_embed(noise)
    k = r.shape[-1]
    if k == 1:
        distance = (r * r / s[..., 0])[..., 0]
        sign = torch.asinh((r / s[..., 0].sqrt())[..., 0])
    else:
        distance = (r * torch.linalg.solve(s, r)).sum(-1)
        sign = torch.zeros_like(distance)
    predicted, theirs = spread.diagonal(dim1=-2, dim2=-1), block.partner_variance
    partner = torch.zeros_like(distance)
    if relative:
        prior_share = (predicted / noise).mean(-1)
        partner = partner if theirs is None else (theirs / block.variance).mean(-1).log1p()
    else:
        prior_share = predicted.sum(-1) / noise.sum(-1)
        if theirs is not None:
            partner = torch.log1p(theirs.sum(-1) / block.variance.sum(-1))
    return Innovation(
        innovation=torch.log1p(distance.clamp(0, _FAR) / k),
        sign=sign,
        doubt=torch.log1p(prior_share),
        partner=partner,
        seen=block.mask.to(r.dtype),
    )


def features(
    block: Block,
    first: Innovation,
    own_std: Float[Tensor, "B N"],
    counts: Sequence[Float[Tensor, "B N"]],
    memory: Float[Tensor, "B N m 3"],
    relative: bool = False,
) -> Float[Tensor, "B N m 15"]:
    """``SHARED`` and ``SIGNED`` features of a block whose residuals are those after a Huber update.

    ``own_std``: log of the position's prior standard deviation; ``counts``: log(1 + number) of
    vector measurements and of ranges seen, and the running mean of the former. ``relative``:
    ``own_std`` becomes the log of its ratio to the noise of the measured length.
    """
    r, noise = block.residual, block.total_variance
    scaled = r / noise.sqrt()
    residual = torch.log1p(scaled.square().mean(-1).clamp_max(_FAR))
    mean, median = leave_one_out(residual, first.seen)
    signed = torch.asinh(scaled[..., 0]) if r.shape[-1] == 1 else torch.zeros_like(residual)
    link, sign, seen = memory.unbind(-1)
    block_mean = (link * seen).sum(-1) / seen.sum(-1).clamp_min(1e-3)
    wide = [x.unsqueeze(-1).expand_as(residual) for x in (own_std, *counts, block_mean)]
    if relative:  # the first component of every judged measurement is a length
        wide[0] = wide[0] - 0.5 * block.variance[..., 0].log()
    return torch.stack(
        (
            first.innovation,
            residual,
            wide[0],
            first.doubt,
            first.partner,
            wide[1],
            wide[2],
            wide[3],
            mean,
            median,
            link,
            wide[4],
            first.sign,
            signed,
            sign,
        ),
        -1,
    )


def leave_one_out(
    x: Float[Tensor, "*s m"], seen: Float[Tensor, "*s m"]
) -> tuple[Float[Tensor, "*s m"], Float[Tensor, "*s m"]]:
    """Mean and (lower) median of the other entries that are seen; 0 where there are none."""
    count = seen.sum(-1, keepdim=True)
    others = (count - seen).clamp_min(1.0)
    mean = ((x * seen).sum(-1, keepdim=True) - x * seen) / others
    ordered, order = x.masked_fill(seen == 0, torch.inf).sort(stable=True, dim=-1)
    rank = order.argsort(-1)
    # Without the entry of rank k, number j of the rest is number j, or j + 1 from rank k on.
    j = ((count - seen - 1).clamp_min(0) / 2).floor().to(torch.int64)
    j = (j + (j >= rank) * (seen > 0)).clamp_max(x.shape[-1] - 1)
    median = ordered.gather(-1, j)
    return mean, torch.where((count - seen > 0), median, 0.0)


def log_std(prior: Prediction, dim: int) -> Float[Tensor, "B N"]:
    """Log of the position's standard deviation (m), mean over axes."""
    variance = prior.covariance[..., :dim, :dim].diagonal(dim1=-2, dim2=-1).mean(-1)
    return 0.5 * variance.clamp_min(1e-12).log()


def remembered(memory: Float[Tensor, "B N m 3"], first: Innovation) -> Float[Tensor, "B N m 3"]:
    """Running means after another step; links that were not seen keep theirs."""
    now = torch.stack((first.innovation, first.sign, torch.ones_like(first.sign)), -1)
    rate = _RATE * first.seen.unsqueeze(-1)
    return memory + rate * (now - memory)


def running_count(
    before: Float[Tensor, "B N 1"], vectors: Float[Tensor, "B N"]
) -> Float[Tensor, "B N 1"]:
    """Running mean of log(1 + number) of vector measurements."""
    return before + _SLOW * (vectors.unsqueeze(-1) - before)
