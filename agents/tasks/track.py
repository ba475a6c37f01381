"""``track-v0``: keep track of more targets than one UAV can see at a time."""

from typing import ClassVar

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.tasks.task import (
    ESTIMATOR,
    MOST_ERROR,
    Seen,
    Task,
    TaskMemory,
    idle,
    random_policy,
    sensors,
    task_scenario,
    towards,
)
from coloc_env.motion import Arena, Groups, RandomWalk, Steered
from coloc_env.network import Network
from coloc_env.options import PositiveCount
from coloc_env.scenario import Prior
from coloc_env.world import World

_SIDE, _RADIUS, _V_MAX = 100.0, 30.0, 3.0


def nearest(seen: Seen) -> Tensor:
    """Each goes to the nearest target."""
    n = seen.task.n_agents
    apart = (seen.position[:, :n, None] - seen.position[:, None, n:]).norm(dim=-1)
    return _follow(seen, apart.argmin(-1))


def worst(seen: Seen) -> Tensor:
    """Each goes to the target that is known worst."""
    n = seen.task.n_agents
    choice = seen.sigma[:, n:].argmax(-1, keepdim=True)
    return _follow(seen, choice.expand(-1, n))


def pairs(seen: Seen) -> Tensor:
    """UAVs in pairs, each pair at the most uncertain target that no pair before it has chosen; they
    come from two sides, so that their ranges cross."""
    n, b = seen.task.n_agents, len(seen.position)
    sigma = seen.sigma[:, n:].clone()
    own, target = seen.position[:, :n], seen.position[:, n:]
    goals = []
    for first in range(0, n, 2):
        members = own[:, first : first + 2]
        apart = (members.mean(1, keepdim=True) - target).norm(dim=-1)
        choice = (sigma - 0.02 * apart).argmax(-1)
        place = target[torch.arange(b), choice]
        sigma[torch.arange(b), choice] = -1.0
        middle = torch.tensor(2 * [0.15 * _SIDE])
        way = place - middle
        way = way / way.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        across = torch.stack((-way[:, 1], way[:, 0]), -1)
        for side in (1.0, -1.0)[: members.shape[1]]:
            goals.append(place + 8.0 * (0.7 * side * across - 0.7 * way))
    return towards(seen, torch.stack(goals, 1))


def _follow(seen: Seen, choice: Tensor) -> Tensor:
    n = seen.task.n_agents
    target = seen.position[:, n:]
    goal = target.gather(1, choice.unsqueeze(-1).expand(-1, -1, target.shape[-1]))
    return towards(seen, goal)


class Track(Task):
    """Four UAVs and three targets in random walk, 100 × 100 m, two anchors near a corner.

    Reward, the same for all: minus the mean error of the targets / 10, of errors up to 10 m.
    ``drift``: odometry's noise, m/√m.
    """

    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "nearest": nearest,
        "worst": worst,
        "pairs": pairs,
    }
    best = "pairs"

    def __init__(
        self,
        *,
        n_uavs: PositiveCount = 4,
        targets: PositiveCount = 3,
        horizon: PositiveCount = 100,
        drift: float = 0.3,
        estimator: str = ESTIMATOR,
    ) -> None:
        total = n_uavs + targets
        steered = Steered("velocity", _V_MAX, 1.5, ((10.0, 10.0), (40.0, 40.0)))
        walk = RandomWalk(1.0, ((20.0, 20.0), (80.0, 80.0)))
        scenario = task_scenario(
            "track-v0",
            sensors(((10.0, 10.0), (30.0, 10.0)), 0.02, drift, _RADIUS, blind=targets),
            arena=Arena(2, total, 1.0, (0.0, 0.0), (_SIDE, _SIDE)),
            horizon=horizon,
            motion=Groups(((steered, n_uavs), (walk, targets))),
            network=Network(radius=_RADIUS, max_neighbours=max(16, total)),
            prior=Prior(0.5, target_std=4.0),
            targets=targets,
        )
        super().__init__(scenario, n_uavs, estimator, _RADIUS, _V_MAX)

    def reward(self, memory: TaskMemory, world: World) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        error = self.error(memory, world)[:, self.n_agents :]
        team = -error.mean(-1, keepdim=True) / MOST_ERROR
        return memory, team.expand(-1, self.n_agents)
