"""What becomes of a claim: decided by one rule from the claim and from an interval, never by hand.

Ours is a figure with a 95 % interval over runs, of paired differences where two methods are
compared. A claim says on which ``side`` of a ``limit`` the figure lies, and may say how far: its
``size``. A claim without a side says that the figure is ``limit``.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import binomtest

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Flags, Floats

REPRODUCED, NOT, CONTRADICTED, UNKNOWN = (
    "reproduced",
    "not reproduced",
    "contradicted",
    "not measured",
)
RULE = """\
**The rule.** Ours is a mean with its 95 % interval: Student's over runs, of differences paired by
world where methods are compared; exact binomial for shares of runs; shared among the rivals (after
Bonferroni) where the best of several is meant. *Reproduced*: the whole interval lies on the claimed
side of the claim's limit (of zero, for a difference), and a claimed size is not beyond the
interval's far end. *Contradicted*: the whole interval lies on the other side. *Not reproduced*:
everything else; the reason is given. A claim that something equals a number is reproduced if the
interval holds the number, else not reproduced. *Not measured*: what it takes was not run."""


@dataclass(frozen=True)
class Claim:
    """What a paper says of a figure, in the figure's ``unit``; ``theirs`` in its own words."""

    words: str
    theirs: str
    unit: str
    side: Literal["above", "below"] | None
    limit: float = 0.0
    size: float | None = None

    @property
    def compares(self) -> bool:
        """Whether the figure is a difference, whose limit is zero."""
        return self.side is not None and self.limit == 0


@dataclass(frozen=True)
class Verdict:
    """A claim, our figure (None: not measured), what became of it, and why."""

    claim: Claim
    ours: Difference | None
    verdict: str
    reason: str


def decide(claim: Claim, ours: Difference | None, missing: str = "") -> Verdict:
    """Apply the rule. ``missing``: why there is no figure of ours."""
    if ours is None or np.isnan([ours.mean, ours.low, ours.high]).any():
        return Verdict(claim, None, UNKNOWN, missing or "no figure")
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


def interval(values: Floats, level: float = 0.95) -> Difference:
    """Mean over runs with Student's interval."""
    return metrics.paired_difference(values, np.zeros_like(values), level)


def share(hits: Flags) -> Difference:
    """Per cent of the runs in which something holds, with the exact interval of Clopper and
    Pearson."""
    ends = binomtest(int(hits.sum()), len(hits)).proportion_ci(0.95, "exact")
    return Difference(100.0 * float(hits.mean()), 100.0 * ends.low, 100.0 * ends.high)


def gain(ours: Floats, other: Floats, level: float = 0.95) -> Difference:
    """By how many per cent of the other's mean ``ours`` is lower, paired by run."""
    difference = metrics.paired_difference(other, ours, level)
    scale = 100 / metrics.mean(np.asarray(other, np.float64))
    return Difference(*(scale * x for x in (difference.mean, difference.low, difference.high)))


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
