"""What our filters were to reach in the study of robustness, and whether they did.

A goal holds for every agent of its name, whatever its options (several trainings of one learned
part are several agents).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from training.reproduce.pfnn.robustness import Cell, Cells, compare

MET, MISSED, UNKNOWN = "met", "missed", "not measured"
RULE = """\
**The rule.** A figure meets a limit if it is not beyond it; over whole runs where nothing else is
said, *steady* is after 10 s. A ratio is that of the RMSEs over all runs. *Below another*: the whole
95 % interval of the paired difference is below zero. *Not worse*: it is not wholly above zero.
*Typical ratio*: the geometric mean of the runs' ratios, which two lost worlds out of twenty do not
decide alone, with its whole 95 % interval. *None lost*: no run diverged."""
Kind = Literal["at most", "ratio at most", "typical ratio", "below", "not worse", "none lost"]


@dataclass(frozen=True)
class Goal:
    """What agents called ``agent`` are to reach in a variant; ``figure`` as in the results."""

    agent: str
    variant: str
    kind: Kind
    figure: str = "rmse"
    limit: float = 0.0
    other: str = ""

    @property
    def words(self) -> str:
        """The goal in words."""
        name = {"rmse": "RMSE", "rmse_after_10s": "steady RMSE", "nees": "NEES"}[self.figure]
        unit = "" if self.figure == "nees" else " m"
        return {
            "at most": f"{name} ≤ {self.limit:g}{unit}",
            "ratio at most": f"{name} ≤ {self.limit:g} × that of `{self.other}`",
            "typical ratio": f"{name} typically ≤ {self.limit:g} × that of `{self.other}`",
            "below": f"{name} below that of `{self.other}`, interval and all",
            "not worse": f"{name} not worse than that of `{self.other}`",
            "none lost": "none lost",
        }[self.kind]


@dataclass(frozen=True)
class Outcome:
    """A goal, the agent that was measured by it, what was found, and the verdict."""

    goal: Goal
    agent: str
    found: str
    verdict: str


_HUBER, _GATE = "ekf:robust=huber", "ekf:robust=gate"
_HARD = ("few-nlos", "few-nlos-false", "hard")


def goals() -> Iterator[Goal]:
    """All of them, one variant and one demand each."""
    for agent in ("apf", "pfnn"):
        yield Goal(agent, "default", "at most", "rmse_after_10s", 0.036)
        yield Goal(agent, "default", "none lost")
    yield Goal("pfnn", "default", "not worse", other="apf")
    for variant in ("default", "uniform"):
        yield Goal("pf_trust", variant, "ratio at most", limit=1.05, other="apf")
    yield Goal("pf_trust", "nlos", "ratio at most", limit=0.55, other="apf")
    yield Goal("pf_trust", "nlos", "at most", "rmse_after_10s", 0.040)
    yield Goal("pf_trust", "false", "at most", limit=0.045)
    yield Goal("pf_trust", "false", "below", other=_HUBER)
    for variant in _HARD:
        yield Goal("pf_trust", variant, "ratio at most", limit=0.85, other=_HUBER)
        yield Goal("pf_trust", variant, "typical ratio", limit=0.85, other=_HUBER)
        yield Goal("pf_trust", variant, "below", other=_HUBER)
    for variant in _HARD[:2]:
        yield Goal("pf_trust", variant, "not worse", other=_GATE)
    yield Goal("pf_trust", "hard", "at most", "nees", 4.0)
    for variant in ("default", "uniform", "nlos", "false", *_HARD):
        yield Goal("pf_trust", variant, "none lost")


def outcomes(found: Cells, agents: Sequence[str]) -> list[Outcome]:
    """Every goal for every agent of its name; one that nobody was measured by is said to be so."""
    judged = []
    for goal in goals():
        there = found.get(goal.variant, {})
        named = [a for a in agents if a.split(":")[0] == goal.agent and a in there]
        judged += [_judge(goal, there, agent) for agent in named] or [
            Outcome(goal, goal.agent, "not flown", UNKNOWN)
        ]
    return judged


def _judge(goal: Goal, there: dict[str, Cell], agent: str) -> Outcome:
    own = there[agent].figures
    if goal.kind == "none lost":
        lost = own["diverged_runs"]
        return _outcome(goal, agent, f"{lost} of {len(there[agent].rmse)} runs", lost == 0)
    value = own[goal.figure]
    if goal.kind == "at most":
        if value is None:
            return Outcome(goal, agent, "no figure", UNKNOWN)
        return _outcome(goal, agent, f"{value:.3g}", value <= goal.limit)
    apart = compare(there, agent, goal.other)
    if apart is None:
        return Outcome(goal, agent, f"not flown: `{goal.other}`", UNKNOWN)
    ratio = value / there[goal.other].figures[goal.figure]
    words = f"× {ratio:.3f}; {1e3 * apart.mean:+.3g} mm ({1e3 * apart.low:+.3g} to "
    words = (words + f"{1e3 * apart.high:+.3g})").replace("-", "−").replace("inf", "∞")
    if goal.kind == "typical ratio":
        logs = compare(there, agent, goal.other, of=np.log)
        assert logs is not None
        low, middle, high = (math.exp(x) for x in (logs.low, logs.mean, logs.high))
        words = f"× {middle:.3f} ({low:.3f} to {high:.3f})"
        return _outcome(goal, agent, words, high <= goal.limit)
    good = {
        "ratio at most": ratio <= goal.limit,
        "below": apart.high < 0,
        "not worse": apart.low <= 0,
    }[goal.kind]
    return _outcome(goal, agent, words, good)


def _outcome(goal: Goal, agent: str, words: str, good: bool) -> Outcome:
    return Outcome(goal, agent, words, MET if good else MISSED)
