"""Position fixes: where each measured landmark, with an attitude, puts a UAV; leaves of them."""

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from coloc_env.geometry import rotate_by
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors.base import MASK, Leaf


def fix_leaves(believed: Believed) -> dict[str, Leaf]:
    """Names and widths of the leaves that ``relative_fixes`` gives; none without landmarks."""
    slots, dim = sum(sensor.fix_slots for sensor in believed.sensors), believed.arena.dim
    if not slots:
        return {}
    return {
        "landmark_fixes": Leaf(slots * dim, unit="m", frame="world"),
        "landmark_fix_mask": Leaf(slots, *MASK),
        "fix_mean": Leaf(dim, unit="m", frame="world"),
        "fix_share": Leaf(1, *MASK),
    }


def fixes(
    believed: Believed, observation: Observation, attitude: Float32[Tensor, "B N a"]
) -> tuple[Float32[Tensor, "B N m d"], Bool[Tensor, "B N m"]]:
    """Positions (m, world frame) that each landmark's measurement alone implies, and their mask."""
    found = [
        sensor.fixes(observation.leaves, attitude)
        for sensor in believed.sensors
        if sensor.fix_slots
    ]
    positions, masks = zip(*found, strict=True)
    return torch.cat(positions, -2), torch.cat(masks, -1)


def relative_fixes(
    believed: Believed,
    observation: Observation,
    attitude: Float32[Tensor, "B N a"],
    position: Float32[Tensor, "B N d"],
) -> tuple[dict[str, Float32[Tensor, "B N F"]], Float32[Tensor, "B N m d"], Bool[Tensor, "B N m"]]:
    """Leaves of the fixes relative to a position (0 where nothing was measured), and the fixes."""
    places, mask = fixes(believed, observation, attitude)
    apart = (places - position.unsqueeze(-2)) * mask.unsqueeze(-1)
    count = mask.sum(-1, keepdim=True, dtype=torch.float32)
    leaves = {
        "landmark_fixes": apart.flatten(-2),
        "landmark_fix_mask": mask.to(torch.float32),
        "fix_mean": apart.sum(-2) / count.clamp_min(1),
        "fix_share": count / mask.shape[-1],
    }
    return leaves, apart, mask


def next_attitude(
    believed: Believed, observation: Observation, attitude: Float32[Tensor, "B N a"]
) -> Float32[Tensor, "B N a"]:
    """An attitude one step on, by gyroscope or odometry; the same where there is neither."""
    for sensor in believed.sensors:
        rate = sensor.turn_rate(observation.leaves)
        if rate is not None:
            return rotate_by(attitude, rate * believed.arena.dt)
    return attitude
