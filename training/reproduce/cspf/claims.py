"""The paper's claims, and the goals of ``../shared/specs/cspf.md``, decided by our runs."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from training.evaluation.metrics import Difference
from training.reproduce.cspf import plan
from training.reproduce.cspf.measures import Runs
from training.reproduce.verdicts import Claim, Verdict, decide, interval, share

WORST = {2: 0.10, 3: 0.06}  # m: the goals for the median of the worst error

Flown = Mapping[tuple[str, str], Runs]  # by variant's key and agent


class Case(NamedTuple):
    """A claim, the variant and agents that it speaks of, and the figure of ours that decides it."""

    claim: Claim
    variant: str
    agents: tuple[str, ...]
    figure: Callable[..., Difference]


def verdicts(flown: Flown, steps: int | None) -> list[Verdict]:
    """Every claim, decided; one whose agents were not flown is not measured."""
    judged = []
    for claim, variant, agents, figure in claims(steps):
        absent = [agent for agent in agents if (variant, agent) not in flown]
        there = [flown[variant, agent] for agent in agents if agent not in absent]
        if absent:
            judged.append(decide(claim, None, f"not flown: {', '.join(absent)}"))
        elif min(one.steps for one in there) < plan.EARLY:
            judged.append(decide(claim, None, f"runs cut before {plan.EARLY} steps"))
        else:
            judged.append(decide(claim, figure(*there)))
    return judged


def claims(steps: int | None) -> Iterator[Case]:
    """The paper's first, then the goals."""
    for dim in plan.DIMS:
        key = plan.published(dim, steps).key
        words = f"{dim}-D: with a fifth of outliers all agents converge within 150 steps"
        # "Converges" in one run shown; read as: in more than 90 % of the runs.
        claim = Claim(
            words, "converged (one run; here: > 90 % of runs)", "% of runs", "above", 90.0
        )
        yield Case(claim, key, ("cspf",), _early)
        claim = Claim(
            f"{dim}-D: without consensus no consistent estimate of everybody is found",
            "fails (here: < 50 % of runs)",
            "% of runs",
            "below",
            50.0,
        )
        yield Case(claim, key, ("cspf:consensus=false",), _early)
        claim = Claim(
            f"{dim}-D: the algorithm as printed converges", "converged", "% of runs", "above", 50.0
        )
        yield Case(claim, key, ("cspf:variant=paper",), _early)
        claim = Claim(
            f"{dim}-D: particles converge more often than one particle (annealed Gauss–Newton)",
            "multi-modal distributions are needed",
            "% of runs",
            "above",
        )
        yield Case(claim, key, ("cspf", "cspf:particles=1"), _more_often)
        # 100 of 100 runs say no more than "above 96 %": a goal is met if it is not ruled out.
        claim = Claim(
            f"goal, {dim}-D: 97 % at a fifth of outliers", "", "% of runs", "above", 90.0, 97.0
        )
        yield Case(claim, key, ("cspf",), _early)
        goal = WORST[dim]
        claim = Claim(
            f"goal, {dim}-D: median worst error at most {goal:g} m", "", "m", "below", goal
        )
        yield Case(claim, key, ("cspf",), _median)
        far = plan.world(dim, steps, outliers=0.4).key
        claim = Claim(f"goal, {dim}-D: 95 % at 0.4 outliers", "", "% of runs", "above", 85.0, 95.0)
        yield Case(claim, far, ("cspf",), _early)
        claim = Claim(
            f"goal, {dim}-D: consensus never makes it worse (0.4, paired)", "", "%", "above"
        )
        yield Case(claim, far, ("cspf", "cspf:consensus=false"), _more_often)


def _early(one: Runs) -> Difference:
    return share(one.converged(plan.EARLY))


def _more_often(one: Runs, other: Runs) -> Difference:
    apart = one.converged(plan.EARLY).astype(float) - other.converged(plan.EARLY)
    return interval(100 * apart)


def _median(one: Runs) -> Difference:
    """Median with its distribution-free 95 % interval (order statistics, by the binomial)."""
    values = np.sort(one.worst(plan.EARLY))
    n = len(values)
    reach = 0.98 * np.sqrt(n)
    low, high = (int(np.clip(round(0.5 * n + s * reach), 0, n - 1)) for s in (-1, 1))
    return Difference(float(np.median(values)), float(values[low]), float(values[high]))
