"""Random commands, which UAVs of a dataset follow where their motion is steered."""

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.motion.draws import uav_keys
from coloc_env.scenario import Scenario

HELD = 1.0  # s


def random_commands(
    scenario: Scenario, seeds: Int64[Tensor, "B"], k: int
) -> Float32[Tensor, "B N d"]:
    """Commands (m/s or m/s², world frame) for the step k → k + 1: each axis uniform up to the
    largest that has any effect, held for 1 s; of a row's seed alone.
    """
    arena = scenario.arena
    turn = k // max(1, round(HELD / arena.dt))
    keys = noise.fold(uav_keys(noise.row_keys(seeds), arena.n_uavs), turn)
    drawn = noise.uniform(keys, "dataset.commands", arena.dim)
    return (2 * drawn - 1) * torch.tensor(scenario.believed.largest_command)
