"""Places and ellipsoids of a Gaussian, for whoever draws them in three dimensions."""

import numpy as np

from training.evaluation.metrics import Floats

_CHI2 = {2: 5.991, 3: 7.815}  # the χ² distribution's 95 %


def half_axes(covariance: Floats) -> Floats:
    """Half axes of the ellipsoids that hold 95 % of a Gaussian, as columns [..., 3, 3] (m)."""
    dim = covariance.shape[-1]
    known = np.isfinite(covariance).all((-2, -1), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(known, covariance, 0.0).astype(np.float64))
    radius = _CHI2[dim] ** 0.5
    axes = radius * vectors * np.sqrt(values.clip(0.0))[..., None, :]
    out = np.zeros((*covariance.shape[:-2], 3, 3))
    out[..., :dim, :dim] = np.where(known, axes, np.nan)
    return out


def in_space(places: Floats) -> Floats:
    """Positions with z = 0 in the plane."""
    if places.shape[-1] == 3:
        return places
    return np.concatenate((places, np.zeros((*places.shape[:-1], 1), places.dtype)), -1)
