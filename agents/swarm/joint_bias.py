"""The covariance of the INS's biases b with each other and with x, all positions and delays.

Biases are never measured: they follow from what ranges show of x through their covariance with it
(the separated-bias form of the Kalman filter, Friedland, IEEE TAC 1969; exact where ranges are
linear). ``agents.swarm.ins_bias`` keeps each UAV's own covariance alone, so that what ranges show
of one UAV's bias says nothing of its neighbours'.
"""

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm.delays import Delays, joint_covariance, remaining, split
from agents.swarm.ins_bias import InsBias
from agents.tensorclasses import build
from coloc_env.sensors import Clock, Ins


class JointBias(TensorClass):
    """Each UAV's rows of the covariance of biases: ``known`` P_bx with positions and delays (m²/s),
    ``own`` P_bb with biases (m²/s²); batch (B, N). Of width 0 where they are not kept."""

    known: Float64[Tensor, "B N d M"]
    own: Float64[Tensor, "B N d K"]


def initial(
    position: Float64[Tensor, "B N d"], delays: Delays, ins: Ins | None, kept: bool
) -> JointBias:
    """Before the first step: independent, with the stationary variance; of width 0 unless
    ``kept``."""
    b, n, d = position.shape
    if not kept or ins is None:
        return _of(position.new_zeros(b, n * d, 0), position.new_zeros(b, n * d, 0), d)
    known = position.new_zeros(b, n * d, n * d + delays.common.shape[-1])
    return _of(known, position.new_full((b, n * d), ins.bias**2).diag_embed(), d)


def decay(bias: JointBias, dt: Float64[Tensor, "B N"], ins: Ins) -> JointBias:
    """``dt`` s later: b ← φ b + w with φ = exp(−dt/τ), P_bb ← φ P_bb φ + σ_b² (1 − φ²)."""
    d, known, own = _matrices(bias)
    phi = torch.exp(-dt / ins.bias_time).repeat_interleave(d, -1)
    noise = ins.bias**2 * (1 - phi.square())
    own = phi.unsqueeze(-1) * phi.unsqueeze(-2) * own + noise.diag_embed()
    return _of(phi.unsqueeze(-1) * known, own, d)


def predict(
    bias: JointBias,
    joint: Float64[Tensor, "B N d K"],
    delays: Delays,
    dt: Float64[Tensor, "B N"],
    ins: Ins,
) -> tuple[JointBias, Float64[Tensor, "B N d K"], Delays]:
    """After p ← p + (u − b) dt: the biases' covariances, the ``joint`` one of positions (m²), and
    the ``delays`` with theirs. With T = diag(dt) on positions and 0 on delays, P_xx ← P_xx − T P_bx
    − P_xb T + T P_bb T + T² σ_v², P_bx ← P_bx − P_bb T."""
    d, known, own = _matrices(bias)
    t = dt.repeat_interleave(d, -1)
    rest = known.shape[-1] - own.shape[-1]
    moved = torch.nn.functional.pad(t.unsqueeze(-1) * known, (0, 0, 0, rest))  # T P_bx
    noise = t.unsqueeze(-1) * own * t.unsqueeze(-2) + (t * ins.std).square().diag_embed()
    noise = torch.nn.functional.pad(noise, (0, rest, 0, rest))
    whole = joint_covariance(joint, delays) - moved - moved.mT + noise
    positions, delays = split(whole, delays.delay, d)
    known = known - torch.nn.functional.pad(own * t.unsqueeze(-2), (0, rest))
    return _of(known, own, d), positions, delays


def at_fixes(
    ins_bias: InsBias,
    bias: JointBias,
    joint: Float64[Tensor, "B N d K"],
    delays: Delays,
    fixed: Bool[Tensor, "B N"],
    innovation: Float64[Tensor, "B N d"],
    fix_variance: float,
) -> tuple[InsBias, JointBias]:
    """The biases of ``fixed`` UAVs after their fixes, ``innovation`` m from dead reckoning, with
    ``fix_variance`` (m²): K = P_bp (P_pp + R)⁻¹. Others learn of fixes by ranges alone; the biases'
    covariances with fixed positions end."""
    rows = fixed.any(0).nonzero()[:, 0]
    if not len(rows):
        return ins_bias, bias
    d, known, own = _matrices(bias)
    m = joint.shape[1] * d
    coordinates = (d * rows.unsqueeze(-1) + torch.arange(d, device=rows.device)).flatten()
    here = fixed[:, rows].repeat_interleave(d, -1)
    pairs = here.unsqueeze(-1) & here.unsqueeze(-2)
    p = joint_covariance(joint, delays)[:, coordinates]
    s = torch.where(pairs, p[..., coordinates], 0.0)
    s = s + torch.where(here, fix_variance, 1.0).diag_embed()
    cross = torch.where(pairs, known[:, coordinates][..., coordinates], 0.0)
    gain = torch.linalg.solve(s, cross.mT).mT  # K
    by = torch.where(here, innovation[:, rows].flatten(1), 0.0).unsqueeze(-1)
    step = torch.zeros_like(ins_bias.bias).flatten(1)
    step[:, coordinates] = (gain @ by)[..., 0]
    reduced = own[:, coordinates] - gain @ known[..., coordinates].mT
    known, own = known.clone(), own.clone()
    known[:, coordinates] = known[:, coordinates] - gain @ p
    own[:, coordinates] = reduced
    own[..., coordinates] = reduced.mT
    known[..., :m] = known[..., :m].masked_fill(fixed.repeat_interleave(d, -1).unsqueeze(-2), 0.0)
    bias = _of(known, own, d)
    return marginal(ins_bias.bias + step.view_as(ins_bias.bias), bias), bias


def with_delays_after(bias: JointBias, dt: Float64[Tensor, "B N"], clock: Clock) -> JointBias:
    """The same ``dt`` s later, as delays fade."""
    d, known, own = _matrices(bias)
    k = own.shape[-1]
    faded = known[..., k:] * remaining(dt, clock).flatten(1).unsqueeze(-2)
    return _of(torch.cat((known[..., :k], faded), -1), own, d)


def update(
    ins_bias: InsBias,
    bias: JointBias,
    innovation: Float64[Tensor, "B M"],
    precision: Float64[Tensor, "B M M"],
    posterior: Float64[Tensor, "B M M"],
) -> tuple[InsBias, JointBias]:
    """After x moved by ``innovation`` (m) from its prior, whose ``precision`` is Λ = P_xx⁻¹ (1/m²;
    0 at fixed UAVs), to the ``posterior`` covariance P_xx⁺ (m²): K = P_bx Λ, b ← b + K Δx,
    P_bx ← K P_xx⁺, P_bb ← P_bb − K (P_xx − P_xx⁺) Kᵀ."""
    d, known, own = _matrices(bias)
    gain = known @ precision
    after = gain @ posterior
    own = own - (known - after) @ gain.mT
    moved = (gain @ innovation.unsqueeze(-1))[..., 0].view_as(ins_bias.bias)
    bias = _of(after, 0.5 * (own + own.mT), d)
    return marginal(ins_bias.bias + moved, bias), bias


def marginal(bias: Float64[Tensor, "B N d"], joint: JointBias) -> InsBias:
    """Each UAV's own bias (m/s), with its variances as means of the axes'."""
    d, known, own = _matrices(joint)
    each = [
        x[..., : own.shape[-1]].diagonal(dim1=-2, dim2=-1).unflatten(-1, (-1, d)).mean(-1)
        for x in (known, own)
    ]
    return build(InsBias, bias.shape[:2], bias=bias, cross=each[0], variance=each[1])


def _matrices(bias: JointBias) -> tuple[int, Float64[Tensor, "B K M"], Float64[Tensor, "B K K"]]:
    return bias.own.shape[2], bias.known.flatten(1, 2), bias.own.flatten(1, 2)


def _of(known: Float64[Tensor, "B K M"], own: Float64[Tensor, "B K K"], d: int) -> JointBias:
    parts = {"known": known.unflatten(1, (-1, d)), "own": own.unflatten(1, (-1, d))}
    n = own.shape[1] // d
    return build(JointBias, torch.Size((len(own), n)), **parts)
