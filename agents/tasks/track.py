"""``track-v0``: keep track of more targets than one UAV can see at a time."""

from typing import ClassVar

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.tasks.cem import OthersKnown
from agents.tasks.memory import TaskMemory
from agents.tasks.options import Drift, SteeredTaskOptions
from agents.tasks.rules import Seen, idle, random_policy, towards
from agents.tasks.space import Space
from agents.tasks.task import MOST_ERROR, Task, sensors, task_scenario
from coloc_env.motion import Groups, RandomWalk
from coloc_env.network import Network
from coloc_env.options import PositiveCount, Uavs
from coloc_env.scenario import Prior
from coloc_env.world import World

_SIDE, _RADIUS, _V_MAX, _A_MAX = 100.0, 30.0, 3.0, 1.5
_WALLS = (((42.0, 10.0), (45.0, 50.0)), ((42.0, 70.0), (45.0, 95.0)))


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
    own, target = seen.plane[:, :n], seen.plane[:, n:]
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

    name = "track-v0"
    shared = True
    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "nearest": nearest,
        "worst": worst,
        "pairs": pairs,
    }
    planners: ClassVar = {"cem": OthersKnown}
    best = "pairs"

    def __init__(
        self,
        *,
        n_uavs: Uavs = 4,
        targets: PositiveCount = 3,
        horizon: PositiveCount = 100,
        drift: Drift = 0.3,
        task: SteeredTaskOptions = SteeredTaskOptions(),
    ) -> None:
        total, space = n_uavs + targets, Space((_SIDE, _SIDE), self.hard, _WALLS)
        start = space.start((10.0, 10.0), (40.0, 40.0))
        steered = task.steered(_V_MAX, _A_MAX, start, space)
        first = (50.0, 20.0) if self.hard else (20.0, 20.0)  # m: not inside a wall
        walk = RandomWalk(1.0, space.start(first, (80.0, 80.0)), space.walls)
        anchors = space.anchors(((10.0, 10.0), (30.0, 10.0)))
        scenario = task_scenario(
            self.name,
            sensors(anchors, 0.02, drift, _RADIUS, space.walls, blind=targets),
            arena=space.arena(total),
            horizon=horizon,
            motion=Groups(((steered, n_uavs), (walk, targets))),
            network=Network(_RADIUS, space.walls, max_neighbours=max(16, total)),
            prior=Prior(0.5, target_std=4.0),
            targets=targets,
        )
        super().__init__(scenario, n_uavs, task, _RADIUS, _V_MAX, _A_MAX)

    def own_reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        error = self.cost(memory, world)[:, self.n_agents :]
        team = -error.mean(-1, keepdim=True) / MOST_ERROR
        return memory, team.expand(-1, self.n_agents)


class TrackHard(Track):
    """``track-v0`` in three dimensions, 20 m high, where two walls of 12 m are between the anchors
    and the targets; anchors are on masts."""

    name = "track-hard-v0"
    hard = True
