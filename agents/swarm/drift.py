"""The bias of each UAV's INS velocity, which dead reckoning loses once it is known.

Per UAV and axis a Kalman filter of two states, position and bias, whose covariances all axes share.
The bias is a Gauss–Markov process. It is never measured: it follows from how far positions are
found from where dead reckoning was, through what its error has in common with the position's.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.sensors import Ins


@dataclass(frozen=True)
class Drift:
    """``bias`` (m/s), its covariance with the position ``cross`` (m²/s) and its ``variance``
    (m²/s²), both per axis."""

    bias: Float64[Tensor, "B N d"]
    cross: Float64[Tensor, "B N"]
    variance: Float64[Tensor, "B N"]


def aged(drift: Drift, dt: Float64[Tensor, "B N"], ins: Ins) -> Drift:
    """The bias ``dt`` seconds later, b ← φ b with φ = exp(−dt/τ)."""
    kept = torch.exp(-dt / ins.bias_time)
    return Drift(
        kept.unsqueeze(-1) * drift.bias,
        kept * drift.cross,
        kept.square() * drift.variance + ins.bias**2 * (1 - kept.square()),
    )


def reckoned(
    drift: Drift, position: Float64[Tensor, "B N"], dt: Float64[Tensor, "B N"], ins: Ins
) -> tuple[Drift, Float64[Tensor, "B N"], Float64[Tensor, "B N"]]:
    """After p ← p + (u − b) dt, from the position's variance (m²): the drift; the factor by which
    what was known of the position goes on in its error; and the variance (m²) that is new, so that
    P ← factor² P + new. The factor is that of a position's covariance with others', too, as far as
    those know nothing of its bias but by its position."""
    share = drift.cross / position
    after = Drift(drift.bias, drift.cross - dt * drift.variance, drift.variance)
    new = dt.square() * (ins.std**2 + drift.variance - share * drift.cross)
    return after, 1 - dt * share, new


def informed(
    drift: Drift,
    moved: Float64[Tensor, "B N d"],
    before: Float64[Tensor, "B N"],
    after: Float64[Tensor, "B N"],
) -> Drift:
    """What the bias must be when a position was found ``moved`` (m) from dead reckoning's, its
    variance falling from ``before`` to ``after`` (m²)."""
    gain = drift.cross / before
    return Drift(
        drift.bias + gain.unsqueeze(-1) * moved,
        gain * after,
        drift.variance - gain.square() * (before - after),
    )
