"""Localization from one step's ranges as a semidefinite program (Biswas & Ye, IPSN 2004): convex,
so that its answer depends on no initial guess. Needs CVXPY (the extra ``oracles``)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from agents.registry import make
from training.evaluation.metrics import Flags, Floats
from training.evaluation.rollout import rollout
from training.reproduce.work import Kind

if TYPE_CHECKING:
    from training.evaluation.evaluate import Progress
    from training.reproduce.store import Arrays, Facts
    from training.reproduce.work import Piece, Variant

_HERE = "training.reproduce.stdcl.sdp"
SDP = Kind("sdp", f"{_HERE}:record_sdp", f"{_HERE}:load_sdp", (_HERE,))
METHODS = ("the relaxation", "Gauss–Newton from there", "Gauss–Newton from dead reckoning")


def relaxed(
    distance: Floats, linked: Flags, fixed: Flags, known: Floats, std: float
) -> tuple[Floats, float]:
    """Positions [N, d] (m) from ranges [N, N] (m) of noise ``std`` (m), those of the ``fixed`` UAVs
    being ``known`` [N, d], and the rank gap tr(Y − Xᵀ X)/tr Y: 0 where the relaxation is exact.

    min Σ ((q_ij − d̃_ij² + σ²)/(2 d̃_ij))², q_ij = ‖x_i − x_j‖² linear in Z = [[I, X], [Xᵀ, Y]] ⪰ 0,
    which relaxes Y = Xᵀ X. Raises ImportError without CVXPY, ValueError where it finds no optimum.
    """
    cp: Any = import_module("cvxpy")
    centre, d = known[fixed].mean(0), known.shape[1]
    scale = float(np.abs(known[fixed] - centre).max()) or 1.0
    a, r, sigma = (known - centre) / scale, distance / scale, std / scale
    free = np.flatnonzero(~fixed)
    at = {int(i): d + k for k, i in enumerate(free)}
    z = cp.Variable((d + len(free), d + len(free)), PSD=True)
    terms = []
    for i, j in zip(*np.nonzero(np.triu(linked, 1)), strict=True):
        if fixed[i] and fixed[j]:
            continue
        if fixed[i] or fixed[j]:
            k, m = (i, at[int(j)]) if fixed[i] else (j, at[int(i)])
            q = float(a[k] @ a[k]) - 2 * (a[k] @ z[:d, m]) + z[m, m]
        else:
            m, n = at[int(i)], at[int(j)]
            q = z[m, m] - 2 * z[m, n] + z[n, n]
        terms.append((q - r[i, j] ** 2 + sigma**2) / (2 * r[i, j]))
    problem = cp.Problem(cp.Minimize(cp.sum_squares(cp.hstack(terms))), [z[:d, :d] == np.eye(d)])
    problem.solve(solver=cp.CLARABEL)
    if z.value is None:
        raise ValueError(f"the semidefinite program has no optimum: {problem.status}")
    x, y = z.value[:d, d:], z.value[d:, d:]
    found = known.copy()
    found[free] = centre + scale * x.T
    return found, float(np.trace(y - x.T @ x) / np.trace(y))


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Errors [3, K, M] in m of ``METHODS``, and the rank gap [K]."""

    error: Floats
    gap: Floats

    @property
    def rmse(self) -> dict[str, float]:
        """RMSE in m by method."""
        each = np.sqrt((self.error**2).mean((1, 2)))
        return dict(zip(METHODS, map(float, each), strict=True))


def record_sdp(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """Every step of a run of ``gn`` with any options, solved from its ranges alone, thrice."""
    scenario, (agent,) = piece.variant.build(), piece.agents
    localizer: Any = make(agent, scenario)
    errors, gaps, belief = [], [], None
    for step in rollout(localizer, scenario, torch.tensor([piece.seed])):
        belief = localizer.reset(step.observation) if belief is None else belief
        inputs = localizer.predict(belief, step.observation)
        fixed = inputs.fixed[0].numpy()
        place, gap = relaxed(
            inputs.links.distance[0].numpy(),
            inputs.links.mask[0].numpy(),
            fixed,
            inputs.prior[0].numpy(),
            localizer.std,
        )
        start = replace(inputs, prior=torch.from_numpy(place).unsqueeze(0))
        truth = step.world.truth.position[0].numpy()
        found = (place, *(localizer.solve(belief, x).position[0].numpy() for x in (start, inputs)))
        errors.append([np.linalg.norm(one - truth, axis=-1)[~fixed] for one in found])
        gaps.append(gap)
        belief = step.belief
        progress(agent, step.k + 1, scenario.horizon)
    return {"error": np.array(errors).swapaxes(0, 1), "gap": np.array(gaps)}, {}


def load_sdp(variant: Variant, arrays: Arrays, facts: Facts) -> Relaxation:
    """What ``record_sdp`` made."""
    return Relaxation(**arrays)
