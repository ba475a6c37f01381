"""``beacon-v0``: when to speak, so that those who listen can tell where they are."""

from typing import ClassVar

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from agents.tasks.gains import intersection_gains, log_gain, rank
from agents.tasks.memory import TaskMemory, own_covariance, own_sigma
from agents.tasks.options import Drift, TaskOptions
from agents.tasks.rules import Seen, idle, random_policy
from agents.tasks.space import Space
from agents.tasks.task import MOST_ERROR, Task, sensors, task_scenario
from coloc_env.commands import SILENT, Commands
from coloc_env.motion import Roam
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.options import PositiveCount, Uavs
from coloc_env.scenario import Prior
from coloc_env.world import World

_SIDE, _RADIUS, _ANCHOR_RADIUS = 120.0, 50.0, 20.0
_ANCHORS = ((20.0, 45.0), (100.0, 75.0))
_WALLS = (((35.0, 30.0), (38.0, 80.0)), ((82.0, 40.0), (85.0, 90.0)))


def slots(seen: Seen) -> Tensor:
    """UAVs in turns."""
    n = seen.task.n_agents
    return (torch.arange(n) == (seen.memory.step[:, :1] % n)).long()


def local(seen: Seen) -> Tensor:
    """Who would give the team more, alone, than everybody within two hops speaks."""
    gain = seen.memory.more["gain"]
    apart = (seen.position.unsqueeze(2) - seen.position.unsqueeze(1)).norm(dim=-1)
    most = torch.where(apart <= 2 * _RADIUS, gain.unsqueeze(1), -1.0).amax(-1)
    return ((gain >= most) & (gain > 0)).long()


def central(seen: Seen) -> Tensor:
    """Speaker by speaker the one that raises most what all listeners together will gain, as each
    hears exactly one in reach: for one that sees all."""
    b, n = seen.plane.shape[:2]
    gain = seen.memory.more["gains"].view(b, n, n)  # of listener i, by speaker j
    apart = (seen.position.unsqueeze(2) - seen.position.unsqueeze(1)).norm(dim=-1)
    near = (apart <= seen.task.radius).to(gain.dtype)
    speaks = torch.zeros(b, n)
    worth = torch.zeros(b, 1)
    for _ in range(n):
        tried = (speaks.unsqueeze(1) + torch.eye(n)).clamp(max=1.0)  # [B, k, n]: k speaks, too
        heard = tried @ near  # [B, k, i]: how many i would hear
        found = (tried @ (gain * near).transpose(1, 2)) * (heard == 1) * (1 - tried)
        best, choice = found.sum(-1).max(-1, keepdim=True)
        better = best > worth + 1e-9
        speaks = torch.where(
            better, tried.gather(1, choice.unsqueeze(-1).expand(-1, -1, n))[:, 0], speaks
        )
        worth = torch.where(better, best, worth)
    return speaks.long()


class Beacon(Task):
    """Ten UAVs on waypoints, two anchors that only the near can range to. Each speaks or listens;
    who hears exactly one ranges to it and fuses its estimate, by covariance intersection.

    Reward of each: minus the own error / 10, of errors up to 10 m. ``drift``: odometry's noise,
    m/√m.
    A local rule does as well as a planner here: a sanity check more than a challenge.
    """

    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "slots": slots,
        "local": local,
        "central": central,
    }
    best = "local"
    sampled = True
    about: ClassVar = {
        "gain": "log of what all in reach would gain, 10⁻³ … 10 m² as −1 … 1, if it alone spoke",
        "ranks": "rank of the own σ and of that gain among all",
        "flags": "whether it spoke, whether it heard somebody, whether it is its turn",
    }
    name = "beacon-v0"
    choices = 2
    meaning = "0 to listen, 1 to speak"

    def __init__(
        self,
        *,
        n_uavs: Uavs = 10,
        horizon: PositiveCount = 100,
        drift: Drift = 0.3,
        task: TaskOptions = TaskOptions("ekf:fusion=ci:second_order=true", credit="own"),
    ) -> None:
        space = Space((_SIDE, _SIDE), self.hard, _WALLS)
        scenario = task_scenario(
            self.name,
            sensors(space.anchors(_ANCHORS), 0.05, drift, _ANCHOR_RADIUS, space.walls),
            arena=space.arena(n_uavs),
            horizon=horizon,
            motion=Roam(2.0, space.over()),
            network=Network(
                _RADIUS, space.walls, links="broadcast", max_neighbours=max(16, n_uavs)
            ),
            prior=Prior(2.0),
        )
        super().__init__(scenario, n_uavs, task, _RADIUS, 2.0)

    def commands(self, memory: TaskMemory, action: Float32[Tensor, "B n"]) -> Commands:
        return Commands(calls=torch.where(action > 0, 0, SILENT))

    def estimate(
        self, memory: TaskMemory, action: Float32[Tensor, "B n"]
    ) -> tuple[TaskMemory, Float32[Tensor, "B N A"]]:
        memory.more["called"] = action.to(torch.float32)
        return memory, memory.action

    def start(self, blank: Float32[Tensor, "B N"]) -> dict[str, Tensor]:
        n = blank.shape[1]
        gains = blank.unsqueeze(-1).repeat(1, 1, n)
        return {"called": blank.clone(), "gain": blank.clone(), "gains": gains}

    def keep(self, memory: TaskMemory, observation: Observation) -> TaskMemory:
        """What all who are in reach would gain, in m², if a UAV alone spoke."""
        p = memory.position
        own = own_covariance(memory.joint)
        near = (p.unsqueeze(2) - p.unsqueeze(1)).norm(dim=-1) <= self.radius
        near = near & ~torch.eye(p.shape[1], dtype=torch.bool, device=p.device)
        gains = intersection_gains(p, own) * near
        memory.more["gains"], memory.more["gain"] = gains, gains.sum(1)
        return memory

    def allowed(self, memory: TaskMemory) -> Bool[Tensor, "B n C"]:
        return memory.position.new_ones(*memory.position.shape[:2], 2, dtype=torch.bool)

    def extras(self, memory: TaskMemory) -> dict[str, Float32[Tensor, "B n F"]]:
        """Where agents know what they heard, there are no ranks."""
        n, gain = self.n_agents, memory.more["gain"]
        heard = memory.seen[:, :, :n].any(-1).to(gain.dtype)
        turn = ((memory.step - torch.arange(n, device=gain.device)) % n == 0).to(gain.dtype)
        flags = (2 * memory.more["called"] - 1, 2 * heard - 1, 2 * turn - 1)
        found = {"gain": log_gain(gain).unsqueeze(-1)}
        if not self.messages:
            found["ranks"] = torch.stack((rank(own_sigma(memory.joint)), rank(gain)), -1)
        return {**found, "flags": torch.stack(flags, -1)}

    def secrets(self, memory: TaskMemory) -> list[Float32[Tensor, "B F"]]:
        return [log_gain(memory.more["gain"])]

    def own_reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        return memory, -self.cost(memory, world) / MOST_ERROR


class BeaconHard(Beacon):
    """``beacon-v0`` in three dimensions: UAVs roam over two walls of 12 m, which hide anchors."""

    name = "beacon-hard-v0"
    hard = True
