"""The paper's claims about its three cases, and what our runs say of them."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from training.evaluation.metrics import Difference, Floats
from training.reproduce.nnhpff.measures import Runs
from training.reproduce.verdicts import (
    Claim,
    Verdict,
    away_from_zero,
    decide,
    gain,
    interval,
    share,
)

NEAR = 5.0  # per cent: as near as this counts as equal (our reading of "nearly identical")
OFTEN = 10  # times as many resets: our reading of "very frequently" beside none
FAILED = 0.5  # m

Flown = Mapping[tuple[int, str], Runs]  # by case and agent


class Case(NamedTuple):
    """A claim, the case and agents that it speaks of, and the figure of ours that decides it."""

    claim: Claim
    case: int
    agents: tuple[str, ...]
    figure: Callable[..., Difference]


def verdicts(flown: Flown) -> list[Verdict]:
    """Every claim, decided; one whose agents were not flown is not measured."""
    judged = []
    for claim, case, agents, figure in claims():
        absent = [agent for agent in agents if (case, agent) not in flown]
        if absent:
            judged.append(decide(claim, None, f"not flown: {', '.join(absent)}"))
        else:
            judged.append(decide(claim, figure(*(flown[case, agent] for agent in agents))))
    return judged


def claims() -> Iterator[Case]:
    """All of them, case by case."""
    for agent, name in (("hpff", "HPFF"), ("nnhpff", "NN-HPFF")):
        words = f"case 1: {name}'s ALE is nearly the PF's"
        claim = Claim(words, f"nearly identical (here: within {NEAR:g} %)", "%", "below", NEAR)
        yield Case(claim, 1, (agent, "pf"), _apart)
    claim = Claim("case 1: HPFF is hardly ever reset", "once (here: < 5 a run)", "", "below", 5.0)
    yield Case(claim, 1, ("hpff",), _resets)
    for case in (1, 2):
        claim = Claim(f"case {case}: NN-HPFF is never reset", "no reset", "resets", None)
        yield Case(claim, case, ("nnhpff",), _resets)
    claim = Claim(
        "case 2: HPFF is reset far more often than NN-HPFF",
        f"very frequently, never (here: {OFTEN} times as often)",
        "resets",
        "above",
    )
    yield Case(claim, 2, ("hpff", "nnhpff"), _more_often)
    claim = Claim("case 2: HPFF's ALE is above the PF's", "significantly", "%", "above")
    yield Case(claim, 2, ("pf", "hpff"), _gain)
    claim = Claim("case 2: NN-HPFF's ALE is nearly the PF's", "equivalent", "%", "below", NEAR)
    yield Case(claim, 2, ("nnhpff", "pf"), _apart)
    claim = Claim(
        "case 3: the PF fails after the first corner", "error > 0.5 m", "m", "above", FAILED
    )
    yield Case(claim, 3, ("pf",), lambda pf: interval(pf.corner_peak()))
    claim = Claim("case 3: NN-HPFF is reset before HPFF", "earlier", "% of runs", "above", 50.0)
    yield Case(claim, 3, ("nnhpff", "hpff"), _earlier)
    claim = Claim("case 3: NN-HPFF's peak at the corner is below HPFF's", "lower", "%", "above")
    yield Case(claim, 3, ("nnhpff", "hpff"), _lower_peak)
    for agent, name in (("hpff", "HPFF"), ("nnhpff", "NN-HPFF")):
        claim = Claim(f"case 3: {name} recovers: ALE below the PF's", "recovers", "%", "above")
        yield Case(claim, 3, (agent, "pf"), _gain)
    words = "case 3: the ALEs of HPFF and NN-HPFF do not differ significantly"
    claim = Claim(words, f"not significant (here: within {NEAR:g} %)", "%", "below", NEAR)
    yield Case(claim, 3, ("nnhpff", "hpff"), _apart)


def _gain(one: Runs, other: Runs) -> Difference:
    return gain(one.ale(), other.ale())


def _apart(one: Runs, other: Runs) -> Difference:
    """How far two ALEs lie apart, in per cent of the second's, whichever is larger."""
    return away_from_zero(gain(one.ale(), other.ale()))


def _resets(one: Runs) -> Difference:
    return interval(one.resets_per_run())


def _more_often(one: Runs, other: Runs) -> Difference:
    excess: Floats = one.resets_per_run() - OFTEN * other.resets_per_run()
    return interval(excess)


def _earlier(one: Runs, other: Runs) -> Difference:
    return share(np.less(one.first_reset(), other.first_reset()))


def _lower_peak(one: Runs, other: Runs) -> Difference:
    return gain(one.corner_peak(), other.corner_peak())
