"""What becomes of a claim or a goal: decided by one rule from an interval, never by hand.

Ours is a figure with a 95 % interval over runs, of paired differences where two methods are
compared. A claim says on which ``side`` of a ``limit`` the figure lies, and may say how far: its
``size``. A claim without a side says that the figure is ``limit``. A goal is a limit of our own.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from scipy.stats import binomtest

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Flags, Floats
from training.reproduce.results import Need, Runs
from training.reproduce.tables import DASH, Table, ends, signed

REPRODUCED, NOT, CONTRADICTED, UNKNOWN = (
    "reproduced",
    "not reproduced",
    "contradicted",
    "not measured",
)
MET, MISSED = "met", "missed"
Found = Difference | str  # a figure of ours, or why there is none
RULE = """\
**The rule.** Ours is a mean with its 95 % interval: Student's over runs, of differences paired by
world where methods are compared; exact binomial for shares of runs; shared among the rivals (after
Bonferroni) where the best of several is meant. *Reproduced*: the whole interval lies on the claimed
side of the claim's limit (of zero, for a difference), and a claimed size is not beyond the
interval's far end. *Contradicted*: the whole interval lies on the other side. *Not reproduced*:
everything else; the reason is given. A claim that something equals a number is reproduced if the
interval holds the number, else not reproduced. *Not measured*: what it takes was not run."""
GOAL_RULE = """\
A goal is met if the mean is not beyond its limit. Where its words say "interval and all", the whole
95 % interval must be on the right side; where they say "not worse", it must not be wholly on the
wrong one."""


class Lookup(Protocol):
    """Where claims look for what they need."""

    def get(self, name: str, agent: str = "", kind: Any = None) -> Any: ...


@dataclass(frozen=True)
class Claim:
    """What a paper says of a figure, in the figure's ``unit``; ``theirs`` in its own words.
    ``figure`` of ours is made from what the claim ``needs``."""

    words: str
    theirs: str
    unit: str
    side: Literal["above", "below"] | None
    limit: float = 0.0
    size: float | None = None
    needs: tuple[Need, ...] = ()
    figure: Callable[..., Found] = lambda *_: "no figure"

    @property
    def compares(self) -> bool:
        """Whether the figure is a difference, whose limit is zero."""
        return self.side is not None and self.limit == 0


@dataclass(frozen=True)
class Goal:
    """What was to be reached: a ``figure`` in ``unit`` ``above`` (or below) a ``limit``, by its
    mean, by its whole interval, or "not wholly beyond"."""

    words: str
    unit: str
    limit: float
    above: bool
    needs: tuple[Need, ...]
    figure: Callable[..., Found]
    by: Literal["mean", "interval", "mean and sign", "not worse"] = "mean"


@dataclass(frozen=True)
class Verdict:
    """A claim or a goal, our figure (None: not measured), what became of it, and why."""

    claim: Any
    ours: Difference | None
    verdict: str
    reason: str


def judge(claims: Iterable[Claim], found: Lookup) -> list[Verdict]:
    """Claims decided; one for which something is missing is not measured."""
    judged = []
    for claim in claims:
        there = [found.get(*need) for need in claim.needs]
        absent = [n for n, one in zip(claim.needs, there, strict=True) if one is None]
        judged.append(decide(claim, _absent(absent) if absent else claim.figure(*there)))
    return judged


def judge_goals(goals: Iterable[Goal], found: Lookup) -> list[Verdict]:
    """Goals decided, once each."""
    judged = []
    for goal in goals:
        there = [found.get(*need) for need in goal.needs]
        absent = [n for n, one in zip(goal.needs, there, strict=True) if one is None]
        ours = _absent(absent) if absent else goal.figure(*there)
        if isinstance(ours, str) or np.isnan(ours.mean):
            why = ours if isinstance(ours, str) else "no figure"
            judged.append(Verdict(goal, None, UNKNOWN, why))
            continue
        sign = 1.0 if goal.above else -1.0
        near, far = sorted((sign * (ours.low - goal.limit), sign * (ours.high - goal.limit)))
        beyond = {
            "mean": sign * (ours.mean - goal.limit) >= 0,
            "interval": near > 0,
            "mean and sign": sign * (ours.mean - goal.limit) >= 0 and ours.low > 0,
            "not worse": far >= 0,
        }[goal.by]
        judged.append(Verdict(goal, ours, MET if beyond else MISSED, ""))
    return judged


def decide(claim: Claim, ours: Found) -> Verdict:
    """Apply the rule."""
    if isinstance(ours, str):
        return Verdict(claim, None, UNKNOWN, ours)
    if np.isnan([ours.mean, ours.low, ours.high]).any():
        return Verdict(claim, None, UNKNOWN, "no figure")
    if claim.side is None:
        inside = ours.low <= claim.limit <= ours.high
        away = "lower" if ours.high < claim.limit else "higher"
        reason = "within the interval" if inside else f"ours is {away}"
        return Verdict(claim, ours, REPRODUCED if inside else NOT, reason)
    sign = 1.0 if claim.side == "above" else -1.0
    near, far = sorted((sign * (ours.low - claim.limit), sign * (ours.high - claim.limit)))
    if far < 0:
        return Verdict(claim, ours, CONTRADICTED, "the opposite holds")
    if near <= 0:
        return Verdict(claim, ours, NOT, "no detectable effect" if claim.compares else "undecided")
    if claim.size is not None and sign * (claim.size - claim.limit) > far:
        return Verdict(claim, ours, NOT, "same direction, but smaller")
    return Verdict(claim, ours, REPRODUCED, "the whole interval is on the claimed side")


def _absent(needs: Sequence[Need]) -> str:
    """What is missing, by name."""
    what = dict.fromkeys(agent or rest[0].label for _, agent, *rest in needs)
    places = list(dict.fromkeys(need[0] for need in needs))
    more = " and others" if len(places) > 1 else ""
    return f"not run: {', '.join(what)} in {places[0]}{more}"


# ------------------------------------------------------------------ intervals


def interval(values: Floats, level: float = 0.95) -> Difference:
    """Mean over runs with Student's interval."""
    return metrics.paired_difference(values, np.zeros_like(values), level)


def exactly(value: float) -> Difference:
    """A figure that does not vary over runs."""
    return Difference(value, value, value)


def share(hits: Flags) -> Difference:
    """Per cent of the runs in which something holds, with the exact interval of Clopper and
    Pearson."""
    ends = binomtest(int(hits.sum()), len(hits)).proportion_ci(0.95, "exact")
    return Difference(100.0 * float(hits.mean()), 100.0 * ends.low, 100.0 * ends.high)


def gain(ours: Floats, other: Floats, level: float = 0.95) -> Difference:
    """By how many per cent of the other's mean ``ours`` is lower, paired by the runs both have."""
    ours, other = paired(ours, other)
    difference = metrics.paired_difference(other, ours, level)
    scale = 100 / metrics.mean(np.asarray(other, np.float64))
    return Difference(*(scale * x for x in (difference.mean, difference.low, difference.high)))


def apart(ours: Floats | None, other: Floats | None) -> str:
    """How much larger an RMSE is than another's, in per cent of that."""
    if ours is None or other is None:
        return DASH
    less = gain(ours, other)
    return signed(Difference(*(0.0 - x for x in (less.mean, less.high, less.low))), "")


def gain_in(measure: Callable[[Runs], Floats]) -> Callable[[Runs, Runs], Difference]:
    """``gain`` of a measure, as a claim's figure of two agents."""
    return lambda one, other: gain(measure(one), measure(other))


def mean_of(measure: Callable[[Any], Floats]) -> Callable[[Any], Difference]:
    """``interval`` of a measure, as a claim's figure of one agent."""
    return lambda one: interval(measure(one))


def paired(one: Floats, other: Floats) -> tuple[Floats, Floats]:
    """Two figures per run, of the first runs, which both have."""
    count = min(len(one), len(other))
    return one[:count], other[:count]


def apart_in(measure: Callable[[Runs], Floats]) -> Callable[[Runs, Runs], Difference]:
    """How far a measure of two agents lies apart, in per cent of the second's, whichever is
    larger."""
    return lambda one, other: away_from_zero(gain(measure(one), measure(other)))


def away_from_zero(difference: Difference) -> Difference:
    """The interval of a difference's size."""
    ends = abs(difference.low), abs(difference.high)
    low = 0.0 if difference.low < 0 < difference.high else min(ends)
    return Difference(abs(difference.mean), low, max(ends))


def least(differences: list[tuple[Floats, Floats]]) -> Difference:
    """The smallest of several gains in per cent, of ``(ours, other)`` each; the level is split
    among them (Bonferroni), since the smallest was picked."""
    level = 1 - 0.05 / len(differences)
    return min((gain(a, b, level) for a, b in differences), key=lambda each: each.mean)


# ------------------------------------------------------------------ tables


def counts(judged: Sequence[Verdict], what: str, kinds: Sequence[str]) -> str:
    """How many came out how, and what those not measured lack."""
    count = Counter(each.verdict for each in judged)
    words = f"**{len(judged)} {what}: " + ", ".join(f"{count[x]} {x}" for x in kinds) + ".**"
    lacking = dict.fromkeys(v.reason for v in judged if v.verdict == UNKNOWN)
    return words + (f" Not measured: {'; '.join(lacking)}." if 0 < len(lacking) <= 3 else "")


def claims_table(judged: Sequence[Verdict]) -> Table:
    """Claims, the paper's figures, ours, and what became of them."""
    rows = []
    for each in judged:
        claim, ours = each.claim, DASH
        if each.ours is not None:
            ours = signed(each.ours, claim.unit, claim.compares)
        rows.append([claim.words, claim.theirs, ours, f"**{each.verdict}**: {each.reason}"])
    return Table("", ["claim", "paper", "ours (95 %)", "verdict"], rows, 4)


def goals_table(judged: Sequence[Verdict]) -> Table:
    """Goals, limits, and whether they were met."""
    rows = []
    for each in judged:
        goal = each.claim
        limit = f"{'≥' if goal.above else '≤'} {goal.limit:g} {goal.unit}".strip()
        ours = DASH if each.ours is None else _shortly(each.ours)
        cells = [goal.words, limit, f"**{each.verdict}**", ours]
        rows.append([cells[0], *(cell.replace("-", "−") for cell in cells[1:])])
    return Table("", ["goal", "limit", "verdict", "ours (95 %)"], rows, 3)


def _shortly(found: Difference) -> str:
    form = "{:.3g}".format
    return form(found.mean) if found.low == found.high else ends(found, form)


def as_json(each: Verdict) -> dict[str, Any]:
    """A verdict as plain values."""
    claim, ours = each.claim, each.ours
    own = {"goal": claim.words, "limit": claim.limit, "above": claim.above} if isinstance(
        claim, Goal
    ) else {"claim": claim.words, "paper": claim.theirs}  # fmt: skip
    return own | {
        "unit": claim.unit,
        "ours": None if ours is None else ours.mean,
        "interval": None if ours is None else [ours.low, ours.high],
        "verdict": each.verdict,
        "reason": each.reason,
    }
