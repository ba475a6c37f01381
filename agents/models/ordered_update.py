"""The update of a broad prior: a UAV's own measurements first, then those of other UAVs one by one.

A range between two UAVs that are both metres off is linearized where neither of them is, and what
it claims to know is never taken back. So what does not involve others is used first, iterated to
convergence; then each neighbour's in turn, linearized once where the last left the state. To
iterate those as well would gain information on how the team as a whole is turned, which ranges do
not have (Huang, Mourikis & Roumeliotis, IJRR 2010). What linearizing neglects counts as noise.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from agents.models.measurements import Block
from agents.robust.screen import Trust

_MOST = 10  # iterations of a UAV's own measurements
_PERSISTENCE = 1.5  # s that the error of linearizing a range stays about the same
_STILL = 1e-3  # m, m/s, rad: an iteration that moves nothing by more is the last


@dataclass(frozen=True)
class Estimation:
    """What is estimated from what: a UAV's error (*s = B N), or a team's joint one (*s = B).

    ``linearize(x)`` gives the blocks at a state, ``information(blocks, trusts)`` their Λ and η,
    ``boxplus(x, δ)`` the state after a correction, and ``apart(P, slots)`` the covariance
    [B, N, d, d] of the UAVs' positions relative to those in the given slots; ``dt`` is a step, s.
    """

    linearize: Callable[[Float[Tensor, "B N S"]], Sequence[Block]]
    information: Callable[[Sequence[Block], Sequence[Trust]], tuple[Tensor, Tensor]]
    boxplus: Callable[[Float[Tensor, "B N S"], Float[Tensor, "*s E"]], Float[Tensor, "B N S"]]
    apart: Callable[[Float[Tensor, "*s E E"], Int64[Tensor, "N"]], Float[Tensor, "B N d d"]]
    dt: float


def ordered_update(
    x: Float[Tensor, "B N S"],
    covariance: Float[Tensor, "*s E E"],
    model: Estimation,
    trusts: Sequence[Trust],
    partners: Int64[Tensor, "rounds N"],
    slots: int,
) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "*s E E"]]:
    """The posterior of ``x`` with covariance P, each measurement trusted as given; ``partners[r]``
    is the slot (of ``slots``) whose measurements each UAV uses in round r."""
    first, steps = model.linearize(x), max(1.0, _PERSISTENCE / model.dt)
    own = [i for i, block in enumerate(first) if block.partner is None]
    shared = [i for i, block in enumerate(first) if block.partner is not None]

    def own_information(at: Tensor) -> tuple[Tensor, Tensor]:
        blocks = model.linearize(at)
        return model.information([blocks[i] for i in own], [trusts[i] for i in own])

    def partners_information(slot: Tensor, apart: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
        blocks = model.linearize(at)
        chosen = [blocks[i].of(slot, slots).bent(apart, steps) for i in shared]
        return model.information(chosen, [trusts[i] for i in shared])

    if own:
        x, covariance = gauss_newton(x, covariance, own_information, model.boxplus, _MOST)
    for slot in partners if shared else ():
        information = partial(partners_information, slot, model.apart(covariance, slot))
        x, covariance = gauss_newton(x, covariance, information, model.boxplus, 1)
    return x, covariance


def gauss_newton(
    x: Float[Tensor, "B N S"],
    covariance: Float[Tensor, "*s E E"],
    information: Callable[[Float[Tensor, "B N S"]], tuple[Tensor, Tensor]],
    boxplus: Callable[[Tensor, Tensor], Tensor],
    most: int,
) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "*s E E"]]:
    """x ⊞ δ that minimizes δᵀ P⁻¹ δ + Σ w rᵀ R⁻¹ r, and P⁺ there, after at most so many
    iterations; a row that has converged stays as it is, whoever else iterates.

    With P = L Lᵀ, P⁺ = L (I + Lᵀ Λ L)⁻¹ Lᵀ: positive, however broad P.
    """
    root = torch.linalg.cholesky_ex(covariance).L
    eye = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device)
    state, updated, delta = x, covariance, torch.zeros_like(covariance[..., 0])
    moving = torch.ones_like(delta[..., :1], dtype=torch.bool)
    for _ in range(most):
        precision, vector = information(state)
        vector = vector + (precision @ delta.unsqueeze(-1))[..., 0]  # residuals about x, not x ⊞ δ
        inner = torch.linalg.cholesky_ex(eye + root.mT @ precision @ root).L
        half = torch.linalg.solve_triangular(inner, root.mT, upper=False)
        narrowed = half.mT @ half
        step = (narrowed @ vector.unsqueeze(-1))[..., 0]  # δ = P⁺ η
        updated = torch.where(moving.unsqueeze(-1), narrowed, updated)
        far = ((step - delta).abs() > _STILL).any(-1, keepdim=True)
        delta = torch.where(moving, step, delta)
        state = boxplus(x, delta)
        moving = moving & far
        if not bool(moving.any()):
            break
    return state, updated
