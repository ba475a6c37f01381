"""How far a team's members are from the truth in what they say of each other."""

import math

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from coloc_env.geometry import poses_in
from coloc_env.motion import Kinematics

CLOSE = (0.3, math.radians(10.0))  # m, rad: what counts as converged


def team_figures(
    said: Float64[Tensor, "B H N P"], truth: Kinematics
) -> dict[str, Float32[Tensor, "B H"]]:
    """Of poses relative to UAV 0: each holder's largest position error over all UAVs (m), its
    largest angle (rad), and whether *every* holder is within 0.3 m and 10° of *every* UAV (1 or 0,
    the same for all)."""
    poses = poses_in(truth.position.shape[-1])
    pose = torch.cat((truth.position, truth.attitude), -1)
    true = poses.between(pose[:, :1], pose).unsqueeze(1).expand_as(said)
    shift = poses.split(said)[0] - poses.split(true)[0]
    error = shift.square().sum(-1).sqrt().amax(-1)
    turn = poses.minus(said, true)[..., poses.dim :].square().sum(-1).sqrt().amax(-1)
    close = ((error < CLOSE[0]) & (turn < CLOSE[1])).all(-1, keepdim=True).expand_as(error)
    return {
        "team_error": error.to(torch.float32),
        "team_turn": turn.to(torch.float32),
        "converged": close.to(torch.float32),
    }
