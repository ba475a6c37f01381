"""Noise of a series of errors, as a filter that takes it for white should believe in it."""

from dataclasses import dataclass

import numpy as np

from coloc_env.datasets.recording import Floats, Stamps
from coloc_env.datasets.residuals import robust

MEMORY = 1.0  # s over which a filter averages what it measures
CLIP = 3.0  # robust deviations: what is beyond is a filter's screen's to deal with
_LEAST = 1e-4
_OF_MEDIAN = (np.pi / 2) ** 0.5  # standard error of a median, in those of a mean


@dataclass(frozen=True)
class Noise:
    """Of T errors: median, robust deviation, the share beyond three deviations, and the deviation
    of white noise that adds up to the same over ``MEMORY``."""

    count: int
    bias: float
    std: float
    tail: float
    white: float


def noise_of(time: Stamps, error: Floats) -> Noise:
    """Noise of errors [T] at times [T] (ns)."""
    bias, std = robust(error)
    std = max(std, _LEAST)
    off = error - bias
    tail = float((np.abs(off) > CLIP * std).mean())
    kept = off.clip(-CLIP * std, CLIP * std)
    return Noise(len(error), bias, std, tail, whitened(time, kept))


def whitened(time: Stamps, error: Floats) -> float:
    """√(σ² n Var(mean of n)/σ²): the deviation of white noise whose mean over ``MEMORY`` varies as
    much as that of these errors."""
    variance = float((error**2).mean())
    block = ((time - time[0]) * 1e-9 // MEMORY).astype(np.int64)
    _, index, size = np.unique(block, return_inverse=True, return_counts=True)
    if len(size) < 5 or size.max() < 2:
        return variance**0.5
    mean = np.bincount(index, error) / size
    # E[n · mean²] is σ² for white errors and n σ² for errors that last
    inflated = float((size * mean**2).mean())
    return max(variance, inflated) ** 0.5


def shrunk(parts: list[Noise]) -> list[float]:
    """Biases of several links, each drawn to their common one as far as it is uncertain (empirical
    Bayes: τ² between links against each one's standard error, from the noise of all of them, since
    a few errors say little of their own)."""
    values = np.array([part.bias for part in parts])
    count = np.array([part.count for part in parts])
    error = _OF_MEDIAN * pooled(parts, "white") / np.sqrt(count)
    common = float(np.median(values))
    between = max(0.0, float(np.average((values - common) ** 2 - error**2, weights=count)))
    share = between / (between + error**2 + _LEAST**2)
    return (common + share * (values - common)).tolist()


def pooled(parts: list[Noise], what: str) -> float:
    """Root mean square over links of a deviation, by their numbers of errors."""
    weights = [part.count for part in parts]
    return float(np.average([getattr(part, what) ** 2 for part in parts], weights=weights) ** 0.5)
