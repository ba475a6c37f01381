"""Rewards: how well each UAV's estimate fits the truth at the same step."""

import math

import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor


def reward(
    kind: str,
    estimates: Float32[Tensor, "B N A"],
    position: Float64[Tensor, "B N d"],
    error: Float32[Tensor, "B N"],
    scored: Bool[Tensor, "B N"],
) -> Float32[Tensor, "B N"]:
    """Reward of each UAV, 0 where it is not scored (whatever its estimate, NaN included).

    - ``error``: −‖p̂ − p‖ in m (the default);
    - ``squared``: −‖p̂ − p‖² in m²;
    - ``team``: the mean of ``error`` over the UAVs that are scored, the same for all of them;
    - ``log_score``: log density of the truth under the Gaussian that the action states.
    """
    if kind == "error":
        return -error
    if kind == "squared":
        return -error * error
    if kind == "team":
        count = scored.sum(-1, keepdim=True).clamp_min(1)
        total = error[:, 0]
        for column in error.unbind(1)[1:]:
            total = total + column
        return torch.where(scored, -(total.unsqueeze(-1) / count), 0.0)
    dim = position.shape[-1]
    log_std = estimates[..., 2 * dim :]
    scaled = (estimates[..., :dim] - position).to(torch.float32) / log_std.exp()
    terms = -0.5 * (scaled * scaled + math.log(2 * math.pi)) - log_std
    total = terms[..., 0]
    for column in terms.unbind(-1)[1:]:
        total = total + column
    return torch.where(scored, total, 0.0)
