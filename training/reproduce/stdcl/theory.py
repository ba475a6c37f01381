"""ST-DCL's theory of errors (section 3.2), measured: how they accumulate and how they spread.

Equations 7 to 10 are lost; the text says what they hold. In time (equation 7):
‖e(t+1)‖ ≤ α ‖e(t)‖ + β η + σ ξ, α of the UAV's change of velocity, η the NLOS term; theorem 1
(equation 8): ‖e(t)‖ ≤ αᵗ ‖e(0)‖ + (αᵗ − 1)/(α − 1) w, w the largest of the last two terms. In
space: a UAV's error goes to its neighbours with normalized weights (equation 9), from hop to hop
(equation 10).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.sparse.csgraph import shortest_path

from agents.registry import make
from agents.swarm.links import links_of
from coloc_env.observation import Observation
from training.evaluation.metrics import Floats
from training.evaluation.rollout import rollout
from training.reproduce.work import Kind

if TYPE_CHECKING:
    from training.evaluation.evaluate import Progress
    from training.reproduce.results import Runs
    from training.reproduce.store import Arrays, Facts
    from training.reproduce.work import Piece, Variant

_HERE = "training.reproduce.stdcl.theory"
DIFFUSION = Kind("diffusion", f"{_HERE}:record_diffusion", f"{_HERE}:load_diffusion", (_HERE,))
PUSH = 25.0  # m: by which an anchor's fix is wrong, the paper's NLOS bias
_SETTLED = 5  # steps before errors are compared
_TURNS = 0.1  # share of the steps with the largest and the smallest changes of velocity


# ---------------------------------------------------------------- in time


def accumulated(alpha: float, start: float, drive: Floats) -> Floats:
    """Equation 7 with equality: e(0) = ``start``, e(t+1) = α e(t) + w(t), [K + 1] in m."""
    errors = [start]
    for each in drive:
        errors.append(alpha * errors[-1] + float(each))
    return np.array(errors)


def upper_bound(alpha: float, start: float, drive: float, steps: int) -> Floats:
    """Theorem 1: αᵗ e(0) + w Σ_{k<t} αᵏ for t = 0 … ``steps``, in m."""
    t = np.arange(steps + 1)
    total = t.astype(float) if alpha == 1 else (alpha**t - 1) / (alpha - 1)
    return alpha**t * start + total * drive


def coupling(errors: Floats, scored: Any) -> float:
    """α of e_i(t+1) = α e_i(t) + w_i(t) by least squares, from error vectors [K, N, d] in m."""
    before, after = errors[:-1], errors[1:]
    both = (scored[:-1] & scored[1:])[..., None]
    return float((before * after * both).sum() / (before**2 * both).sum())


def settles(one: Runs) -> bool:
    """Whether runs are long enough for errors to be compared from step to step."""
    return one.steps > 2 * _SETTLED


def couplings(one: Runs) -> Floats:
    """[R]: α of each run, after it has settled; NaN for runs that are too short."""
    if not settles(one):
        return np.full(len(one.error), np.nan)
    kept = zip(one.record.offset[:, _SETTLED:], one.scored[:, _SETTLED:], strict=True)
    return np.array([coupling(e.astype(float), s) for e, s in kept])


def couplings_by_turns(one: Runs) -> tuple[Floats, Floats]:
    """[R], [R]: α where velocities change most and where they change least (a tenth of all)."""
    if not settles(one):
        return couplings(one), couplings(one)
    velocity = np.diff(one.truth, axis=1) / one.dt
    turn = np.linalg.norm(np.diff(velocity, axis=1), axis=-1) / one.dt  # at steps 1 … K − 2
    most: list[float] = []
    least: list[float] = []
    for r in range(len(turn)):
        e, s = one.record.offset[r].astype(float), one.scored[r]
        before, after, size = e[1:-1], e[2:], turn[r]
        there = s[1:-1] & s[2:]
        there[:_SETTLED] = False
        low, high = np.quantile(size[there], (_TURNS, 1 - _TURNS))
        for found, chosen in ((least, size <= low), (most, size >= high)):
            kept = (there & chosen)[..., None]
            found.append((before * after * kept).sum() / (before**2 * kept).sum())
    return np.array(most), np.array(least)


def bounded(one: Runs) -> tuple[Floats, Floats]:
    """[R, K'], [R, K']: RMS error over UAVs and theorem 1's bound of it (m), after it has settled.
    α and w are the run's own: w is the largest RMS of e(t+1) − α e(t), so that the bound holds."""
    found, bounds = [], []
    for errors, scored, alpha in zip(one.record.offset, one.scored, couplings(one), strict=True):
        e = errors[_SETTLED:].astype(float)[:, scored[_SETTLED:].all(0)]
        rms = np.sqrt((e**2).sum(-1).mean(-1))
        drive = np.sqrt(((e[1:] - alpha * e[:-1]) ** 2).sum(-1).mean(-1)).max()
        found.append(rms)
        bounds.append(upper_bound(alpha, rms[0], drive, len(rms) - 1))
    return np.array(found), np.array(bounds)


def looseness(one: Runs) -> Floats:
    """[R]: theorem 1's bound over the RMS error in the last step; NaN as in ``couplings``."""
    if not settles(one):
        return couplings(one)
    rms, bound = bounded(one)
    return bound[:, -1] / rms[:, -1]


def power(more: Floats, less: Floats, none: Floats, ratio: float) -> Floats:
    """[R]: the power of the NLOS share by which errors rise above those without, from the errors
    at two shares ``ratio`` apart."""
    return np.log((more - none) / (less - none)) / np.log(ratio)


# ---------------------------------------------------------------- in space


@dataclass(frozen=True, eq=False)
class Diffusion:
    """What a wrong fix does to others: for pairs of one anchor and one other UAV, the ``hops``
    between them and how far the estimate ``moved`` as a share of the fix's error; the average
    ``degree`` of the network."""

    hops: Floats
    moved: Floats
    degree: float

    def by_hops(self) -> dict[int, Floats]:
        """Shares by number of hops, where there are ten pairs at least."""
        there = {int(k): self.moved[self.hops == k] for k in np.unique(self.hops) if np.isfinite(k)}
        return {k: each for k, each in there.items() if len(each) >= 10}


def record_diffusion(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """The last step of a run taken again, once for each anchor, with its fix ``PUSH`` m off."""
    scenario, (agent,) = piece.variant.build(), piece.agents
    localizer, seeds = make(agent, scenario), torch.tensor([piece.seed])
    anchors, before, last = scenario.anchor_uavs, None, None
    for step in rollout(localizer, scenario, seeds):
        if last is not None:
            before = last.belief
        last = step
        progress(agent, step.k + 1, scenario.horizon)
    assert last is not None
    belief = localizer.reset(last.observation) if before is None else before
    observation = last.observation
    linked = links_of(observation).mask[0].numpy()
    hops = shortest_path(linked.astype(float), unweighted=True)
    _, plain = localizer.step(belief, observation)
    moved = np.zeros((anchors, scenario.arena.n_uavs - anchors))
    for i in range(anchors):
        fix = observation["position_fix"].clone()
        fix[0, i, i % scenario.arena.dim] += PUSH
        pushed = Observation({**observation.leaves, "position_fix": fix})
        _, other = localizer.step(belief, pushed)
        shift = (other.position - plain.position)[0, anchors:].norm(dim=-1)
        moved[i] = shift.numpy() / PUSH
    return {"hops": hops[:anchors, anchors:].ravel(), "moved": moved.ravel()}, {
        "degree": float(linked.sum(1).mean())
    }


def load_diffusion(variant: Variant, arrays: Arrays, facts: Facts) -> Diffusion:
    """What ``record_diffusion`` made."""
    return Diffusion(arrays["hops"], arrays["moved"], float(facts["degree"]))
