"""``active-v0``: does moving well localize better? UAVs in a room with four anchors choose where
they measure from."""

from dataclasses import replace
from itertools import product
from typing import ClassVar

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from agents.tasks.memory import TaskMemory, own_covariance
from agents.tasks.options import SteeredTaskOptions
from agents.tasks.rules import Seen, idle, random_policy, steer, towards
from agents.tasks.task import Task
from coloc_env.options import PositiveCount, Uavs
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import AnchorRanging, Ranging
from coloc_env.world import World

_V_MAX, _A_MAX = 3.0, 1.5
_CM = 100.0
_AHEAD = 3.0  # s: how far the greedy rule looks
_WAYS = torch.tensor(list(product((-1.0, 0.0, 1.0), repeat=3)))


def circle(seen: Seen) -> Tensor:
    """All on one circle about the middle of the room, at the heights of a spiral stair."""
    task, n = seen.task, seen.task.n_agents
    middle, radius = (task.low + task.high) / 2, 0.3 * (task.high - task.low)[:2].min()
    phase = 2 * torch.pi * torch.arange(n) / n
    lead = phase + 2.0 / radius * task.scenario.arena.dt * (seen.memory.step[:, :n] + 2)
    x, y = (middle[i] + radius * turn for i, turn in enumerate((lead.cos(), lead.sin())))
    height = task.low[2] + (task.high - task.low)[2] * (0.2 + 0.6 * phase / (2 * torch.pi))
    return towards(seen, torch.stack((x, y, height.expand_as(x)), -1))


def information(seen: Seen) -> Tensor:
    """Each goes where three seconds of ranges would leave it the smallest posterior covariance,

        tr (P⁻¹ + Σ_a u uᵀ / R + Σ_j u uᵀ / (R + uᵀ P_j u))⁻¹,

    with others where they are now: one step of the posterior bound's recursion, at estimates."""
    task = seen.task
    assert isinstance(task, Active)
    p = own_covariance(seen.memory.joint)
    way = _WAYS / _WAYS.norm(dim=-1, keepdim=True).clamp_min(1.0)  # [C, 3]
    place = seen.position.unsqueeze(2) + _AHEAD * task.v_max * way  # [B, n, C, 3]
    place = torch.minimum(torch.maximum(place, task.low), task.high)
    steps = _AHEAD / task.scenario.arena.dt
    gained = steps * (task.of_anchors(place) + task.of_others(place, seen.position, p))
    after = torch.linalg.inv(torch.linalg.inv(p).unsqueeze(2) + gained)
    best = after.diagonal(dim1=-2, dim2=-1).sum(-1).argmin(-1)
    return steer(seen, way[best])


class Active(Task):
    """Six UAVs in the room of ``indoor-v0`` without landmarks, with an IMU each, ranges between
    them and to four anchors, and accelerations as actions.

    Two steps a second. Reward of each: minus its own error, averaged over the episode, in cm, of
    errors up to 10 m.
    """

    name = "active-v0"
    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "circle": circle,
        "information": information,
    }
    best = "information"

    def __init__(
        self,
        *,
        n_uavs: Uavs = 6,
        anchors: PositiveCount = 4,
        horizon: PositiveCount = 80,
        task: SteeredTaskOptions = SteeredTaskOptions("ekf_joint", control="acceleration"),
    ) -> None:
        scenario = make_scenario(
            "indoor-v0",
            n_uavs=n_uavs,
            dt=0.5,
            landmarks=0,
            anchors=anchors,
            horizon=horizon,
            control=task.control,
            v_max=_V_MAX,
            a_max=_A_MAX,
            j_max=task.j_max,
            keep_apart=task.keep_apart,
            prior_std=0.5,
        )
        room = sum(side**2 for side in scenario.arena.high) ** 0.5
        scenario = replace(scenario, name=self.name)
        super().__init__(scenario, n_uavs, task, room / 2, _V_MAX, _A_MAX)

    def own_reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        return memory, -_CM / self.scenario.horizon * self.cost(memory, world)

    def of_anchors(self, place: Float[Tensor, "B n C 3"]) -> Float[Tensor, "B n C 3 3"]:
        """Information (1/m²) of one range to each anchor from places."""
        sensor = self.believed.sensor(AnchorRanging)
        assert sensor is not None
        unit = _unit(place.unsqueeze(-2) - self.anchors)
        return unit.mT @ unit / sensor.noise.std**2

    def of_others(
        self,
        place: Float[Tensor, "B n C 3"],
        position: Float[Tensor, "B n 3"],
        p: Float[Tensor, "B n 3 3"],
    ) -> Float[Tensor, "B n C 3 3"]:
        """Information (1/m²) of one range to each other UAV, of covariance ``p``, from places."""
        sensor = self.believed.sensor(Ranging)
        if sensor is None or self.scenario.strangers:
            return place.new_zeros(*place.shape, 3)
        unit = _unit(place.unsqueeze(-2) - position[:, None, None])  # [B, i, C, j, 3]
        spread = torch.einsum("bicjd,bjde,bicje->bicj", unit, p, unit)
        weight = (sensor.noise.std**2 + spread).reciprocal()
        others = ~torch.eye(position.shape[1], dtype=torch.bool, device=place.device)
        weight = weight * others.unsqueeze(1)
        return (unit * weight.unsqueeze(-1)).mT @ unit


def _unit(x: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3"]:
    return x / x.norm(dim=-1, keepdim=True).clamp_min(1e-6)
