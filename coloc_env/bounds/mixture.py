"""Fisher information of one range about the true distance, for any noise a scenario can have."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from torch import Tensor

from coloc_env.sensors import RangeNoise

EXACT = 1e-6  # m, m/s, rad: what a standard deviation of 0 is taken as
_FINEST = 1e-5  # the narrowest peak resolved, as a part of the whole error's range
_PER_STD = 16  # grid points in the narrowest peak's standard deviation
_TAILS = 40.0  # e⁻⁴⁰: where exponential tails end


@lru_cache(maxsize=256)
def range_information(noise: RangeNoise) -> float:
    """``∫ p′(e)² / p(e) de`` in 1/m² for the density p of a range that arrives, ``dropout`` aside.

    The range is distance + error, so this is the information about the distance (Kay 1993, p. 58);
    for Gaussian noise it is 1/σ². No estimator extracts more from a mixture, and one range alone
    gives less: which ranges are outliers is not known. Where NLOS lasts
    (``nlos_time``) the ranges before show much of that: which are NLOS is then taken as known.
    """
    if noise.nlos_time is not None:
        known = (replace(noise, nlos=share, nlos_time=None) for share in (0.0, 1.0))
        clear, late = map(range_information, known)
        return (1 - noise.nlos) * clear + noise.nlos * late
    _, density, slope = error_density(noise)
    supported = density > 1e-14 * density.max()  # below it the numbers are rounding errors
    step = 1 / density.sum()
    return float((slope[supported] ** 2 / density[supported]).sum() * step)


def distance_information(
    noise: RangeNoise, distance: Float64[Tensor, "*s"]
) -> Float64[Tensor, "*s"]:
    """Information in 1/m² about the distance d of ranges whose standard deviation σ = σ₀ + c d
    grows with it: for N(d, σ²) it is (1 + 2 c²) / σ² (Kay 1993, eq. 3.31). NotImplementedError for
    noise that is not Gaussian."""
    if noise.nlos or noise.tail or noise.uniform or noise.impulse:
        raise NotImplementedError("bounds: noise that grows with distance must be Gaussian")
    std = (noise.std + noise.per_metre * distance).clamp_min(EXACT)
    return (1 + 2 * noise.per_metre**2) / std**2


def error_density(
    noise: RangeNoise,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Errors e (m), their density p(e) (1/m) and its derivative p′(e) on a fine, even grid.

    The error is a sum of independent parts, so its characteristic function is the product of
    theirs; the Gaussian factor makes that vanish long before the grid's highest frequency, and a
    Fourier transform returns density and derivative to rounding.
    """
    shares = ((1 - noise.tail, noise.std), (noise.tail, noise.tail_std))
    stds = [std for share, std in shares if share > 0]
    flat = noise.uniform + (noise.impulse_size if noise.impulse else 0.0)
    bias = noise.nlos_bias if noise.nlos else 0.0
    extent = 2 * (math.sqrt(2 * _TAILS) * max(*stds, EXACT) + flat) + _TAILS * bias
    narrowest = max(min(stds), EXACT, _FINEST * extent)

    count = 2 ** math.ceil(math.log2(_PER_STD * extent / narrowest))
    step = extent / count
    start = -0.5 * (extent - _TAILS * bias)
    t = 2 * np.pi * np.fft.rfftfreq(count, step)

    phi = sum(share * np.exp(-0.5 * (max(std, narrowest) * t) ** 2) for share, std in shares)
    phi = phi * _uniform(t, noise.uniform)
    if noise.nlos:
        constant = noise.nlos_kind == "constant"
        late = np.exp(-1j * bias * t) if constant else 1 / (1 + 1j * bias * t)
        phi = phi * (1 - noise.nlos + noise.nlos * late)
    if noise.impulse:
        phi = phi * (1 - noise.impulse + noise.impulse * _uniform(t, noise.impulse_size))
    phi = phi * np.exp(1j * start * t) / step
    errors = start + step * np.arange(count)
    return errors, np.fft.irfft(phi, count), np.fft.irfft(1j * t * phi, count)


def _uniform(t: NDArray[np.float64], half: float) -> NDArray[np.float64]:
    """Characteristic function of an error uniform within ±half m."""
    return np.asarray(np.sinc(half * t / np.pi))
