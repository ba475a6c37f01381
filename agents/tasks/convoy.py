"""``convoy-v0``: along a corridor with anchors at its entry only, as far as positions are known."""

from typing import ClassVar

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.tasks.memory import TaskMemory
from agents.tasks.options import Drift, SteeredTaskOptions
from agents.tasks.rules import Seen, idle, random_policy, steer, towards
from agents.tasks.space import CRUISE, Space
from agents.tasks.task import Task, sensors, task_scenario
from coloc_env.network import Network
from coloc_env.options import PositiveCount, Uavs
from coloc_env.scenario import Prior
from coloc_env.world import World

_RADIUS, _LENGTH, _WIDTH, _V_MAX, _A_MAX = 40.0, 200.0, 20.0, 3.0, 1.5
_START = 10.0  # m: about where UAVs start
_WALLS = tuple(((x, y), (x + 3.0, y + 12.0)) for x, y in ((60.0, 0.0), (110.0, 8.0), (160.0, 0.0)))
_KNOWN = 1.0  # m: ground counts while the true error is below


def all_go(seen: Seen) -> Tensor:
    """Everybody straight on."""
    return steer(seen, _ahead(seen))


def half_speed(seen: Seen) -> Tensor:
    """Everybody straight on at half the speed."""
    return steer(seen, 0.5 * _ahead(seen))


def _ahead(seen: Seen) -> Tensor:
    """Straight on, and up over the walls where there are some."""
    way = torch.zeros_like(seen.position[:, : seen.task.n_agents])
    way[..., 0] = 1.0
    if way.shape[-1] == 3:
        way[..., 2] = ((CRUISE - seen.position[:, : seen.task.n_agents, 2]) / _V_MAX).clamp(-1, 1)
    return way


def leapfrog(seen: Seen, stride: float = 30.0) -> Tensor:
    """The rear half goes on until it is ``stride`` m ahead of the other half, which stands.

    Stops lie on a ladder, the halves in turns, so that nobody needs to remember whose turn it is.
    """
    n = seen.task.n_agents
    group = (torch.arange(n) >= n // 2).long()
    x = seen.position[:, :n, 0] - _START
    least = torch.stack([x[:, group == g].amin(-1) for g in (0, 1)], -1)
    rung = torch.tensor([0.0, 1.0])  # stops at (2 k + own) strides
    passed = ((least / stride + 0.05 - rung) / 2).floor().clamp_min(-1.0) * 2 + rung
    passed = torch.where(least < stride * 0.5, torch.tensor([0.0, -1.0]), passed)
    goes = torch.stack((passed[:, 0] < passed[:, 1], passed[:, 1] < passed[:, 0]), -1)
    target = _START + stride * (passed + torch.tensor([2.0, 2.0]))
    y = _WIDTH * (torch.arange(n) % (n // 2) + 0.5) / max(n // 2, 1)
    stand = _START + stride * passed.clamp_min(0.0)
    goal_x = torch.where(goes, target, stand)[:, group]
    goal = torch.stack((goal_x, y.expand(len(x), -1)), -1)
    moving = goes[:, group].unsqueeze(-1)
    return torch.where(moving, towards(seen, goal), idle(seen))


class Convoy(Task):
    """Four UAVs in a corridor of 200 × 20 m, with two anchors at its entry.

    Reward of each: new ground in x over v_max, counted where the true error is below 1 m.
    ``drift``: odometry's noise, m/√m.
    """

    name = "convoy-v0"
    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "all_go": all_go,
        "half_speed": half_speed,
        "leapfrog_12": lambda seen: leapfrog(seen, 12.0),
        "leapfrog_20": lambda seen: leapfrog(seen, 20.0),
        "leapfrog": leapfrog,
    }
    best = "leapfrog"
    about: ClassVar = {"order": "how far ahead of the team's mean / 40 m, and rank in x"}

    def __init__(
        self,
        *,
        n_uavs: Uavs = 4,
        horizon: PositiveCount = 120,
        drift: Drift = 0.3,
        task: SteeredTaskOptions = SteeredTaskOptions(),
    ) -> None:
        space = Space((_LENGTH, _WIDTH), self.hard, _WALLS)
        anchors = space.anchors(((0.0, 0.0), (0.0, _WIDTH)))
        start = space.start((5.0, 2.0), (15.0, _WIDTH - 2.0))
        scenario = task_scenario(
            self.name,
            sensors(anchors, 0.02, drift, _RADIUS, space.walls),
            arena=space.arena(n_uavs),
            horizon=horizon,
            motion=task.steered(_V_MAX, _A_MAX, start, space),
            network=Network(_RADIUS, space.walls, max_neighbours=max(16, n_uavs)),
            prior=Prior(0.5),
        )
        super().__init__(scenario, n_uavs, task, _RADIUS, _V_MAX, _A_MAX)

    def start(self, blank: Float32[Tensor, "B N"]) -> dict[str, Tensor]:
        return {"farthest": blank.clone()}

    def extras(self, memory: TaskMemory) -> dict[str, Float32[Tensor, "B n F"]]:
        x, others = memory.position[..., 0], self.others(memory)
        theirs = others.position[..., 0]  # [B, n, N]
        if others.age is not None:  # of who was never heard: as far as oneself
            unknown = others.age.isinf() | torch.eye(
                self.n_agents, dtype=torch.bool, device=x.device
            )
            theirs = torch.where(unknown, x.unsqueeze(-1), theirs)
        ahead = (x - theirs.mean(-1)) / _RADIUS
        rank = (x.unsqueeze(-1) > theirs).to(x.dtype).mean(-1)
        return {"order": torch.stack((ahead, 2 * rank - 1), -1)}

    def secrets(self, memory: TaskMemory) -> list[Float32[Tensor, "B F"]]:
        return [2 * memory.more["farthest"] / _LENGTH - 1]

    def own_reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        x, before = world.now.target[..., 0], memory.more["farthest"]
        first = memory.step <= 1
        before = torch.where(first & (before == 0), x, before)
        farthest = torch.maximum(before, x)
        new = (farthest - before) * self.known(memory, world, _KNOWN)
        memory.more["farthest"] = farthest
        return memory, new / self.v_max


class ConvoyHard(Convoy):
    """``convoy-v0`` in three dimensions, 20 m high, with three walls of 12 m that leave a gap of
    8 m; anchors are on masts."""

    name = "convoy-hard-v0"
    hard = True
