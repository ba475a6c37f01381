"""The paper's claims about its three cases."""

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from training.evaluation.metrics import Difference
from training.learning.nnhpff import FAILED
from training.reproduce.measures import mean_error
from training.reproduce.nnhpff.plan import case, corner_peak, first_reset, resets_per_run
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.verdicts import Claim, apart_in, gain_in, interval, mean_of, share

NEAR = 5.0  # per cent: as near as this counts as equal (our reading of "nearly identical")
Side = Literal["above", "below"] | None
OFTEN = 10  # times as many resets: our reading of "very frequently" beside none


def claims(settings: Settings) -> Iterator[Claim]:
    """All of them, case by case."""
    near, gain, apart = f"(here: within {NEAR:g} %)", gain_in(mean_error), apart_in(mean_error)

    def claim(number: int, words: str, theirs: str, unit: str, side: Side, limit: float,
              agents: tuple[str, ...], figure: Callable[..., Difference]) -> Claim:  # fmt: skip
        key = case(number).key
        needs = tuple((key, agent) for agent in agents)
        return Claim(f"case {number}: {words}", theirs, unit, side, limit, None, needs, figure)

    names = {"hpff:bank=false": "HPFF", "nnhpff:bank=false": "NN-HPFF"}
    for agent, name in names.items():
        yield claim(1, f"{name}'s ALE is nearly the PF's", f"nearly identical {near}", "%",
                    "below", NEAR, (agent, "pf"), apart)  # fmt: skip
    yield claim(1, "HPFF is hardly ever reset", "once (here: < 5 a run)", "", "below", 5.0,
                ("hpff:bank=false",), mean_of(resets_per_run))  # fmt: skip
    for number in (1, 2):
        yield claim(number, "NN-HPFF is never reset", "no reset", "resets", None, 0.0,
                    ("nnhpff:bank=false",), mean_of(resets_per_run))  # fmt: skip
    yield claim(2, "HPFF is reset far more often than NN-HPFF",
                f"very frequently, never (here: {OFTEN} times as often)", "resets", "above", 0.0,
                ("hpff:bank=false", "nnhpff:bank=false"), _more_often)  # fmt: skip
    yield claim(2, "HPFF's ALE is above the PF's", "significantly", "%", "above", 0.0,
                ("pf", "hpff:bank=false"), gain)  # fmt: skip
    yield claim(2, "NN-HPFF's ALE is nearly the PF's", "equivalent", "%", "below", NEAR,
                ("nnhpff:bank=false", "pf"), apart)  # fmt: skip
    yield claim(3, "the PF fails after the first corner", "error > 0.5 m", "m", "above", FAILED,
                ("pf",), mean_of(corner_peak))  # fmt: skip
    yield claim(3, "NN-HPFF is reset before HPFF", "earlier", "% of runs", "above", 50.0,
                ("nnhpff:bank=false", "hpff:bank=false"), _earlier)  # fmt: skip
    yield claim(3, "NN-HPFF's peak at the corner is below HPFF's", "lower", "%", "above", 0.0,
                ("nnhpff:bank=false", "hpff:bank=false"), gain_in(corner_peak))  # fmt: skip
    for agent, name in names.items():
        yield claim(3, f"{name} recovers: ALE below the PF's", "recovers", "%", "above", 0.0,
                    (agent, "pf"), gain)  # fmt: skip
    words = "the ALEs of HPFF and NN-HPFF do not differ significantly"
    yield claim(3, words, f"not significant {near}", "%", "below", NEAR,
                ("nnhpff:bank=false", "hpff:bank=false"), apart)  # fmt: skip


def _more_often(one: Runs, other: Runs) -> Difference:
    return interval(resets_per_run(one) - OFTEN * resets_per_run(other))


def _earlier(one: Runs, other: Runs) -> Difference:
    return share(np.less(first_reset(one), first_reset(other)))
