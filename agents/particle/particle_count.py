"""How many particles live: counts that adapt (PF-NN paper, equation 17 and Algorithm 2)."""

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from agents.particle.cloud import select

GROW, SHRINK = 100, 50  # particles
_FEW, _MANY = 0.3, 0.8  # shares of the count that the effective sample size is held against


def adapted(
    count: Int64[Tensor, "B N"], ess: Float32[Tensor, "B N"], bounds: tuple[int, int]
) -> Int64[Tensor, "B N"]:
    """Equation 17: 100 more where the effective sample size is below 0.3 of the count, 50 fewer
    where it is above 0.8, within bounds."""
    more, fewer = (count + GROW).clamp_max(bounds[1]), (count - SHRINK).clamp_min(bounds[0])
    number = count.to(torch.float32)
    return torch.where(ess < _FEW * number, more, torch.where(ess > _MANY * number, fewer, count))


def alive(count: Int64[Tensor, "B N"], slots: int) -> Bool[Tensor, "B N M"]:
    """Which of the slots hold live particles: the first ``count``."""
    return torch.arange(slots, device=count.device) < count.unsqueeze(-1)


def equal_log_weights(live: Bool[Tensor, "B N M"]) -> Float32[Tensor, "B N M"]:
    """−log(count) for live particles, −∞ for dead ones."""
    each = -live.sum(-1, keepdim=True).to(torch.float32).log()
    return torch.where(live, each, -torch.inf)


def heaviest_first(
    particles: Float32[Tensor, "B N M S"],
    log_weights: Float32[Tensor, "B N M"],
    rows: Bool[Tensor, "B N"],
) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
    """Some UAVs' particles in the order of their weights, so that the first slots hold those to
    keep."""
    slots = torch.arange(log_weights.shape[-1], device=rows.device)
    order = torch.argsort(log_weights, dim=-1, descending=True, stable=True)
    order = torch.where(rows.unsqueeze(-1), order, slots)
    return select(particles, order), log_weights.gather(-1, order)
