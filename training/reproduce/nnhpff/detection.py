"""How good a detector is: from scores and what truly happened, over all samples."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid

from training.evaluation.metrics import Flags, Floats

BINS = 10


@dataclass(frozen=True)
class Curve:
    """ROC and precision–recall at every threshold, from none called failed to all."""

    false_alarms: NDArray[np.float64]
    hits: NDArray[np.float64]  # recall
    precision: NDArray[np.float64]

    @property
    def auc(self) -> float:
        """Area under the ROC curve."""
        return float(trapezoid(self.hits, self.false_alarms))

    @property
    def average_precision(self) -> float:
        """Precision weighted by the gain in recall."""
        return float((np.diff(self.hits) * self.precision[1:]).sum())


@dataclass(frozen=True)
class Confusion:
    """Counts at one threshold."""

    hits: int
    misses: int
    false_alarms: int
    correct_rejections: int

    @property
    def precision(self) -> float:
        """Of what was called failed, how much had."""
        return _share(self.hits, self.false_alarms)

    @property
    def recall(self) -> float:
        """Of what had failed, how much was called so."""
        return _share(self.hits, self.misses)

    @property
    def false_alarm_rate(self) -> float:
        """Of what was sound, how much was called failed."""
        return _share(self.false_alarms, self.correct_rejections)

    @property
    def accuracy(self) -> float:
        right = self.hits + self.correct_rejections
        return _share(right, self.misses + self.false_alarms)


@dataclass(frozen=True)
class Calibration:
    """Mean probability, share that failed, and number of samples in bins of the probability (NaN
    where a bin is empty); Brier score and expected calibration error."""

    probability: NDArray[np.float64]
    failed: NDArray[np.float64]
    count: NDArray[np.int64]
    brier: float
    error: float


def curve(score: Floats, failed: Flags) -> Curve:
    """Equal scores fall together. ValueError if all samples are of one kind."""
    positives = int(failed.sum())
    if positives in (0, failed.size):
        raise ValueError("a curve needs samples that failed and samples that did not")
    order = np.argsort(-score, kind="stable")
    ranked, truth = score[order], failed[order]
    last = np.append(np.flatnonzero(np.diff(ranked)), len(ranked) - 1)
    hits = np.append(0, np.cumsum(truth)[last])
    called = np.append(0, last + 1)
    precision = np.divide(hits, called, out=np.ones(len(hits)), where=called > 0)
    return Curve((called - hits) / (failed.size - positives), hits / positives, precision)


def confusion(score: Floats, failed: Flags, threshold: float) -> Confusion:
    """Called failed where the score is beyond the threshold."""
    called = score > threshold
    return Confusion(
        int((called & failed).sum()),
        int((~called & failed).sum()),
        int((called & ~failed).sum()),
        int((~called & ~failed).sum()),
    )


def least_wrong(score: Floats, failed: Flags) -> float:
    """The threshold at which most samples are called rightly: the first of them, in the middle
    between two scores."""
    order = np.argsort(score, kind="stable")
    ranked, truth = score[order], failed[order]
    # Called failed from rank i on: wrong are failures below, and sound ones from there on.
    wrong = np.append(0, np.cumsum(truth)) + np.append(0, np.cumsum(~truth))[-1]
    wrong = wrong - np.append(0, np.cumsum(~truth))
    ends = np.concatenate(([-np.inf], ranked, [np.inf]))
    possible = ends[1:] > ends[:-1]  # equal scores fall together
    i = int(np.flatnonzero(possible)[wrong[possible].argmin()])
    low, high = ends[i : i + 2]
    if not np.isfinite(high):
        return float(low)
    return float(high - 1.0) if not np.isfinite(low) else float(0.5 * (low + high))


def calibration(probability: Floats, failed: Flags) -> Calibration:
    """Whether of what is given a probability of 30 % three tenths fail, in ten even bins."""
    which = np.minimum((probability * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(which, minlength=BINS)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(which, probability, BINS) / count
        share = np.bincount(which, failed.astype(np.float64), BINS) / count
    gap = np.where(count > 0, np.abs(mean - share), 0.0)
    brier = float(np.mean((probability - failed) ** 2))
    return Calibration(mean, share, count, brier, float((gap * count).sum() / count.sum()))


def _share(part: int, rest: int) -> float:
    return part / (part + rest) if part + rest else float("nan")
