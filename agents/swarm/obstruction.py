"""Which links are obstructed: what a swarm's filter learns of its ranges' errors, and remembers."""

from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.swarm import calibration, delays, joint, persistence
from agents.swarm.belief import Found, Prepared
from agents.swarm.links import lengths

_ENOUGH = 50.0  # remembered errors of links between fixes: with fewer, all links' are learned from


def learned(now: Prepared, memory: Float64[Tensor, "B N N"], std: float, dense: bool) -> Prepared:
    """The same with the error model after this step's links between those who know where they
    are, how these change, and how likely each link is obstructed, from how likely it was
    (``memory``). Where such links are few, but links ``dense``, all others count besides, with what
    is unsure of their ends."""
    links = now.links
    guides = now.fixed.any(0).nonzero()[:, 0]
    known = links.mask & now.fixed.unsqueeze(-1) & now.fixed.unsqueeze(-2)
    remembered = 0.5 * calibration.FORGET * known.sum((-2, -1)).to(torch.float32)
    others = dense * (1 - remembered / _ENOUGH).clamp_min(0.0)[:, None, None]
    if bool((others > 0).any()):
        guides = torch.arange(links.mask.shape[-1], device=guides.device)
    rows, columns = guides.unsqueeze(-1), guides

    def part(x: Tensor) -> Tensor:
        return torch.triu(x[:, rows, columns], 1).flatten(1)

    counts = part(torch.where(known, 1.0, others) * links.mask)
    error, unsure = part(links.distance - lengths(now.place)), part(now.between)
    model = calibration.learned(now.model, error, counts, unsure, std)
    share = model.share[:, 1]
    chain = persistence.learned(
        now.chain,
        part(memory),
        calibration.outlier_evidence(model, error, unsure, std),
        counts,
        share,
    )
    rho = persistence.persistence(chain)
    outlier = persistence.forecast(memory.flatten(1), rho, share)
    return replace(now, model=model, chain=chain, outlier=outlier.view_as(memory))


def seen(
    now: Prepared, found: Found, prior: Float64[Tensor, "B N N"], std: float
) -> Float64[Tensor, "B N N"]:
    """How likely each link is obstructed once positions were found; as likely as before where there
    was no range."""
    residual = now.links.distance - lengths(found.position.detach())
    if found.delays is not None and found.delays.common.shape[-1]:
        residual = residual - delays.added(found.delays.delay - now.delays.delay)
    after = calibration.outlier_probability(
        now.model, residual.flatten(1), unsure(now, found).flatten(1), std, prior.flatten(1)
    )
    return torch.where(now.links.mask, after.view_as(residual), prior)


def unsure(now: Prepared, found: Found) -> Float64[Tensor, "B N N"]:
    """Variance (m²) of every range that is foretold from what was found; as before where no joint
    covariance is kept."""
    if found.joint is None:
        return now.between
    between = joint.between(found.joint)
    if found.delays is None or not found.delays.common.shape[-1]:
        return between
    return between + delays.unsure(found.delays)
