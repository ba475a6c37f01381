"""Ranges of past steps as further terms of the stress (ST-DCL paper, section 4.1.1).

S(y) = Σ_τ w(τ) Σ_{i<j} W_ij(τ) (d̃_ij(τ) − ‖(y_i − Δ_i(τ)) − (y_j − Δ_j(τ))‖)² (equation 19) with
w(τ) = exp(−λ (t − τ)) (equation 15) and Δ_i(τ) the displacement of i since τ by dead reckoning, so
that only the present positions y are unknown. The prior is the one from before the oldest of these
steps, predicted to the present: no range counts twice.
"""

import torch
from jaxtyping import Float64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm import joint
from agents.swarm.links import along_links, lengths
from agents.tensorclasses import build


class RangeWindow(TensorClass):
    """The last T steps, the latest first, batch (B, N).

    Of each step τ: its ``prior`` of the position (m) and the UAV's rows of the priors' ``joint``
    covariance P (m², shared by the axes); since then the ``displacement`` Δ(τ) (m) and the
    prediction f_i f_j P_ij + δ_ij q_i² of the covariance, ``factor`` f and ``noise`` q² (m²); its
    links: ranges less their shifts (``distance``, m), ``weight`` w(τ) W_ij(τ) (1/m²) and
    ``information`` (1/m²), faded alike.
    """

    prior: Float64[Tensor, "B N T d"]
    joint: Float64[Tensor, "B N T N"]
    displacement: Float64[Tensor, "B N T d"]
    factor: Float64[Tensor, "B N T"]
    noise: Float64[Tensor, "B N T"]
    distance: Float64[Tensor, "B N T N"]
    weight: Float64[Tensor, "B N T N"]
    information: Float64[Tensor, "B N T N"]


def empty(
    prior: Float64[Tensor, "B N d"], covariance: Float64[Tensor, "B N 1 K"], steps: int
) -> RangeWindow:
    """``steps`` steps without ranges, all with the present prior (m, m²)."""
    shape = (*prior.shape[:2], steps)
    links = prior.new_zeros(*shape, shape[1])
    rows = covariance if covariance.shape[-1] else links[:, :, :1]
    return RangeWindow(
        prior=prior.unsqueeze(2).repeat(1, 1, steps, 1),
        joint=rows.repeat(1, 1, steps, 1),
        displacement=prior.new_zeros(*shape, prior.shape[-1]),
        factor=prior.new_ones(shape),
        noise=prior.new_zeros(shape),
        distance=links,
        weight=links.clone(),
        information=links.clone(),
        batch_size=prior.shape[:2],
    )


def predict(
    window: RangeWindow,
    displacement: Float64[Tensor, "B N d"],
    factor: Float64[Tensor, "B N"],
    noise: Float64[Tensor, "B N"],
    fading: Float64[Tensor, "B 1"],
) -> RangeWindow:
    """The window a step later, with the step's displacement (m) by dead reckoning, the ``factor``
    and process ``noise`` (m²) of the covariance's prediction, and weights faded."""
    factor, fading = factor.unsqueeze(-1), fading[..., None, None]
    return build(
        RangeWindow,
        window.batch_size,
        prior=window.prior,
        joint=window.joint,
        displacement=window.displacement + displacement.unsqueeze(2),
        factor=factor * window.factor,
        noise=factor.square() * window.noise + noise.unsqueeze(-1),
        distance=window.distance,
        weight=fading * window.weight,
        information=fading * window.information,
    )


def push(
    window: RangeWindow,
    prior: Float64[Tensor, "B N d"],
    covariance: Float64[Tensor, "B N 1 K"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    information: Float64[Tensor, "B N N"],
) -> RangeWindow:
    """The window with the present step in front and without the oldest one."""
    zero = torch.zeros_like(prior[..., 0])
    present = {
        "prior": prior,
        "joint": covariance[:, :, 0],
        "displacement": torch.zeros_like(prior),
        "factor": zero + 1,
        "noise": zero,
        "distance": distance,
        "weight": weight,
        "information": information,
    }
    steps = {
        key: torch.cat((new.unsqueeze(2), getattr(window, key)[:, :, :-1]), 2)
        for key, new in present.items()
    }
    return build(RangeWindow, window.batch_size, **steps)


def oldest_prior(
    window: RangeWindow,
) -> tuple[Float64[Tensor, "B N d"], Float64[Tensor, "B N 1 N"]]:
    """The prior of the oldest step, predicted to the present: positions (m) and their covariance
    (m²). The velocity terms of equation 19 tie the two together."""
    fixed = torch.zeros_like(window.factor[..., 0], dtype=torch.bool)
    covariance = joint.predict(
        window.joint[:, :, -1:], window.factor[..., -1], window.noise[..., -1], fixed, 0.0
    )
    return window.prior[:, :, -1] + window.displacement[:, :, -1], covariance


def _past_positions(
    y: Float64[Tensor, "B N d"], window: RangeWindow
) -> tuple[Float64[Tensor, "B T N d"], Float64[Tensor, "B T N N"]]:
    """Positions y − Δ(τ) in each step, and the distances between them (m)."""
    then = (y.unsqueeze(2) - window.displacement).transpose(1, 2)
    return then, lengths(then.flatten(0, 1)).view(*then.shape[:3], -1)


def stress(y: Float64[Tensor, "B N d"], window: RangeWindow) -> Float64[Tensor, "B"]:
    """The past steps' terms of the stress, in units of ``weight`` · m²."""
    _, length = _past_positions(y, window)
    residual = window.distance.transpose(1, 2) - length
    return 0.5 * (window.weight.transpose(1, 2) * residual.square()).sum((1, 2, 3))


def descent(y: Float64[Tensor, "B N d"], window: RangeWindow) -> Float64[Tensor, "B N d"]:
    """−½ ∂S/∂y of the past steps' terms."""
    then, length = _past_positions(y, window)
    strength = window.weight.transpose(1, 2) * (window.distance.transpose(1, 2) - length)
    return along_links(then, strength, length).sum(1)


def fading(
    decay: float | Float64[Tensor, "B 1"], dt: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B 1"]:
    """The factor exp(−λ dt) of w(τ) in a step, λ in 1/s (equation 15)."""
    return torch.exp(-decay * dt[:, :1])
