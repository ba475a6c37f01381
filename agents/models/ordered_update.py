"""The update of a vague prior: a UAV's own measurements first, then those of other UAVs.

A range between two UAVs that are both metres off is linearized where neither of them is, and what
it claims to know is never taken back. So what does not involve others is used first, iterated to
convergence. What does is linearized once, at what that left: to iterate it would gain information
on how the team as a whole is turned, which ranges do not have (Huang, Mourikis & Roumeliotis, IJRR
2010). What linearizing a range neglects counts as noise (``Block.bent``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block, Measurement
from agents.robust.screen import Trust

_MOST = 10  # iterations of a UAV's own measurements
_STILL = 1e-3  # m, m/s, rad: an iteration that moves nothing by more is the last
_PERSISTENCE = 1.5  # s that the error of linearizing a range stays about the same

T = TypeVar("T")
Information = tuple[Float[Tensor, "*s E E"], Float[Tensor, "*s E"]]


@dataclass(frozen=True)
class Estimation:
    """What is estimated from what: each UAV's error (*s = B N), or a team's joint one (*s = B).

    ``linearize(x, cooperative)`` gives the blocks at a state that involve other UAVs, or those that
    do not, ``information(blocks, trusts)`` their Λ and η, ``boxplus(x, δ)`` the state after a
    correction, and ``apart(P)`` the covariances [B, N, S, d, d] of the UAVs' positions relative to
    those in each slot; ``dt`` is a step, s.
    """

    linearize: Callable[[Float[Tensor, "B N S"], bool], Sequence[Block]]
    information: Callable[[Sequence[Block], Sequence[Trust]], Information]
    boxplus: Callable[[Float[Tensor, "B N S"], Float[Tensor, "*s E"]], Float[Tensor, "B N S"]]
    apart: Callable[[Float[Tensor, "*s E E"]], Float[Tensor, "B N S d d"]]
    dt: float


def ordered_update(
    x: Float[Tensor, "B N S"],
    covariance: Float[Tensor, "*s E E"],
    model: Estimation,
    own: Sequence[Trust],
    shared: Sequence[Trust],
) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "*s E E"]]:
    """The posterior of ``x`` with covariance P, by the UAVs' own measurements and by the shared
    ones, each trusted as given."""
    if own:

        def own_information(at: Tensor) -> Information:
            return model.information(model.linearize(at, False), own)

        x, covariance = gauss_newton(x, covariance, own_information, model.boxplus, _MOST)
    if shared:
        apart, steps = model.apart(covariance), max(1.0, _PERSISTENCE / model.dt)
        blocks = [block.bent(apart, steps) for block in model.linearize(x, True)]
        known = model.information(blocks, shared)
        x, covariance = gauss_newton(x, covariance, lambda _: known, model.boxplus, 1)
    return x, covariance


def gauss_newton(
    x: Float[Tensor, "B N S"],
    covariance: Float[Tensor, "*s E E"],
    information: Callable[[Float[Tensor, "B N S"]], Information],
    boxplus: Callable[[Tensor, Tensor], Tensor],
    most: int,
) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "*s E E"]]:
    """x ⊞ δ that minimizes δᵀ P⁻¹ δ + Σ w rᵀ R⁻¹ r, and P⁺ there, after at most so many
    iterations; a row that has converged stays as it is, whoever else iterates.

    With P = L Lᵀ, P⁺ = L (I + Lᵀ Λ L)⁻¹ Lᵀ: positive, however vague P.
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


def by_kind(models: Sequence[Measurement]) -> tuple[list[int], list[int]]:
    """Which models are about the UAV alone, and which involve other UAVs."""
    kinds = [model.cooperative for model in models]
    return [i for i, k in enumerate(kinds) if not k], [i for i, k in enumerate(kinds) if k]


def pick(items: Sequence[T], which: Sequence[int]) -> list[T]:
    """Items by index."""
    return [items[i] for i in which]
