"""The bias b of each UAV's INS velocity, estimated from how far positions lie from dead reckoning.

Per UAV and axis a Kalman filter of two states, position and bias, with covariance
[[P_pp, P_pb], [P_pb, P_bb]] that all axes share. The bias is a Gauss–Markov process and is never
measured: it is corrected through its covariance with the position.
"""

import torch
from jaxtyping import Float64
from tensordict import TensorClass
from torch import Tensor

from agents.tensorclasses import build
from coloc_env.sensors import Ins


class InsBias(TensorClass):
    """``bias`` b (m/s), its covariance ``cross`` P_pb with the position (m²/s) and its
    ``variance`` P_bb (m²/s²), both per axis; batch (B, N)."""

    bias: Float64[Tensor, "B N d"]
    cross: Float64[Tensor, "B N"]
    variance: Float64[Tensor, "B N"]


def initial(position: Float64[Tensor, "B N d"], ins: Ins | None) -> InsBias:
    """No bias, as uncertain as the INS's stationary one; without an INS it is known to be zero."""
    zero = torch.zeros_like(position[..., 0])
    variance = 0.0 if ins is None else ins.bias**2
    return _ins_bias(torch.zeros_like(position), zero, zero + variance)


def decay(ins_bias: InsBias, dt: Float64[Tensor, "B N"], ins: Ins) -> InsBias:
    """``dt`` s later: b ← φ b with φ = exp(−dt/τ), P_bb ← φ² P_bb + σ_b² (1 − φ²)."""
    phi = torch.exp(-dt / ins.bias_time)
    return _ins_bias(
        phi.unsqueeze(-1) * ins_bias.bias,
        phi * ins_bias.cross,
        phi.square() * ins_bias.variance + ins.bias**2 * (1 - phi.square()),
    )


def predict(
    ins_bias: InsBias, position: Float64[Tensor, "B N"], dt: Float64[Tensor, "B N"], ins: Ins
) -> tuple[InsBias, Float64[Tensor, "B N"], Float64[Tensor, "B N"]]:
    """After p ← p + (u − b) dt, from the position's variance P_pp (m²): the bias, a factor f and a
    process noise q² (m²) with P_pp ← f² P_pp + q², f = 1 − dt P_pb/P_pp. Covariances of positions
    with each other go on as f_i f_j P_ij, as far as they depend on the biases through the positions
    alone."""
    gain = ins_bias.cross / position
    after = _ins_bias(ins_bias.bias, ins_bias.cross - dt * ins_bias.variance, ins_bias.variance)
    noise = dt.square() * (ins.std**2 + ins_bias.variance - gain * ins_bias.cross)
    return after, 1 - dt * gain, noise


def update(
    ins_bias: InsBias,
    innovation: Float64[Tensor, "B N d"],
    prior: Float64[Tensor, "B N"],
    posterior: Float64[Tensor, "B N"],
) -> InsBias:
    """After the position moved by ``innovation`` (m) from dead reckoning's, its variance falling
    from ``prior`` P to ``posterior`` P⁺ (m²): b ← b + K Δp with K = P_pb/P."""
    gain = ins_bias.cross / prior
    return _ins_bias(
        ins_bias.bias + gain.unsqueeze(-1) * innovation,
        gain * posterior,
        ins_bias.variance - gain.square() * (prior - posterior),
    )


def _ins_bias(bias: Tensor, cross: Tensor, variance: Tensor) -> InsBias:
    return build(InsBias, cross.shape, bias=bias, cross=cross, variance=variance)
