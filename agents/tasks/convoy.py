"""``convoy-v0``: along a corridor with anchors at its entry only, as far as positions are known."""

from typing import ClassVar

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from agents.tasks.task import (
    ESTIMATOR,
    Seen,
    Task,
    TaskMemory,
    idle,
    random_policy,
    sensors,
    task_scenario,
    towards,
)
from coloc_env.motion import Arena, Steered
from coloc_env.network import Network
from coloc_env.options import PositiveCount
from coloc_env.scenario import Prior
from coloc_env.world import World

_RADIUS, _LENGTH, _WIDTH, _V_MAX = 40.0, 200.0, 20.0, 3.0
_KNOWN = 1.0  # m: ground counts while the true error is below


def all_go(seen: Seen) -> Tensor:
    """Everybody straight on."""
    return torch.tensor([1.0, 0.0]).expand(len(seen.position), seen.task.n_agents, 2)


def half_speed(seen: Seen) -> Tensor:
    """Everybody straight on at half the speed."""
    return 0.5 * all_go(seen)


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
    return torch.where(moving, towards(seen, goal), torch.zeros(()))


_START = 10.0


class Convoy(Task):
    """Four UAVs in a corridor of 200 × 20 m, with two anchors at its entry.

    Reward, the same for all: the mean over UAVs of new ground in x over v_max, counted where the
    true error is below 1 m. ``drift``: odometry's noise, m/√m.
    """

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

    def __init__(
        self,
        *,
        n_uavs: PositiveCount = 4,
        horizon: PositiveCount = 120,
        drift: float = 0.3,
        estimator: str = ESTIMATOR,
    ) -> None:
        scenario = task_scenario(
            "convoy-v0",
            sensors(((0.0, 0.0), (0.0, _WIDTH)), 0.02, drift, _RADIUS),
            arena=Arena(2, n_uavs, 1.0, (0.0, 0.0), (_LENGTH, _WIDTH)),
            horizon=horizon,
            motion=Steered("velocity", _V_MAX, 1.5, ((5.0, 2.0), (15.0, _WIDTH - 2.0))),
            network=Network(radius=_RADIUS, max_neighbours=max(16, n_uavs)),
            prior=Prior(0.5),
        )
        super().__init__(scenario, n_uavs, estimator, _RADIUS, _V_MAX)

    def start(self, blank: Float32[Tensor, "B N"]) -> dict[str, Tensor]:
        return {"farthest": blank.clone()}

    def extras(self, memory: TaskMemory) -> list[Float32[Tensor, "B n F"]]:
        x = memory.position[..., 0]
        ahead: Float[Tensor, "B n"] = (x - x.mean(-1, keepdim=True)) / _RADIUS
        rank = (x.unsqueeze(-1) > x.unsqueeze(-2)).float().mean(-1)
        return [torch.stack((ahead, 2 * rank - 1), -1)]

    def reward(self, memory: TaskMemory, world: World) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        x, before = world.now.target[..., 0], memory.more["farthest"]
        first = memory.step <= 1
        before = torch.where(first & (before == 0), x, before)
        farthest = torch.maximum(before, x)
        new = (farthest - before) * (self.error(memory, world) < _KNOWN)
        memory.more["farthest"] = farthest
        team = new.mean(-1, keepdim=True) / self.v_max
        return memory, team.expand(-1, self.n_agents)
