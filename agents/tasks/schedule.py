"""``schedule-v0``: who ranges with whom, on a channel where exchanges collide."""

from typing import ClassVar

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from agents.tasks.gains import anchor_gains, log_gain, range_gains, rank
from agents.tasks.memory import TaskMemory, own_sigma
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

_SIDE, _RADIUS = 100.0, 45.0
_WALLS = (((30.0, 30.0), (33.0, 70.0)), ((67.0, 30.0), (70.0, 70.0)))
_ANCHORS = ((0.0, 0.0), (100.0, 100.0))


def own_gain(seen: Seen) -> Tensor:
    """Everybody calls for what it gains most by."""
    return _best(seen)[1]


def nearest(seen: Seen) -> Tensor:
    """Everybody calls the nearest."""
    distance = seen.memory.more["distance"][:, : seen.task.n_agents]
    return 1 + distance.argmin(-1)


def slots(seen: Seen) -> Tensor:
    """UAVs in turns, each for its own gain."""
    return _only(seen, seen.memory.step[:, 0] % seen.task.n_agents)


def uncertain(seen: Seen) -> Tensor:
    """The UAV that is least sure of its position calls, for its own gain."""
    return _only(seen, seen.sigma.argmax(-1))


def local(seen: Seen) -> Tensor:
    """Who gains more than everybody within 1.5 times the interference's reach calls."""
    gain, choice = _best(seen)
    apart = (seen.position.unsqueeze(2) - seen.position.unsqueeze(1)).norm(dim=-1)
    near = apart <= 1.5 * _RADIUS
    most = torch.where(near, gain.unsqueeze(1), -1.0).amax(-1)
    return torch.where((gain >= most) & (gain > 0), choice, 0)


def central(seen: Seen) -> Tensor:
    """Exchange by exchange the one that takes most off the whole team's variance, as long as it
    disturbs none before it: for one that sees all."""
    task, n = seen.task, seen.task.n_agents
    b = len(seen.position)
    team = seen.memory.more["team_gain"].clone()  # [B, n, C − 1]
    place = torch.cat((seen.position, task.anchors.expand(b, -1, -1)), 1)
    near = (place.unsqueeze(2) - place.unsqueeze(1)).norm(dim=-1) <= _RADIUS + 3.0
    target = task.targets_of(n)  # type: ignore[attr-defined]
    action = torch.zeros(b, n, dtype=torch.int64)
    rows = torch.arange(b)
    for _ in range(3):
        flat = team.flatten(1)
        value, index = flat.max(-1)
        i, k = index // team.shape[-1], index % team.shape[-1]
        t = target[i, k]
        good = value > 1e-6
        action[rows[good], i[good]] = 1 + k[good]
        callers_near = near[rows, t][:, :n]  # initiators that would disturb this target
        spoiled = near[rows, i][:, target]  # targets that this caller would disturb
        busy = torch.zeros(b, n, dtype=torch.bool)
        busy[rows, i] = True
        busy |= torch.nn.functional.one_hot(t, n + len(task.anchors))[:, :n] > 0
        called = (target.unsqueeze(0) == i[:, None, None]) | (
            target.unsqueeze(0) == t[:, None, None]
        )
        barred = (busy | callers_near).unsqueeze(-1) | spoiled | called
        team = torch.where(good[:, None, None] & barred, 0.0, team)
    return action


def _best(seen: Seen) -> tuple[Tensor, Tensor]:
    """Each UAV's largest own gain (m²) of a call, and that call."""
    gain, choice = seen.memory.more["gain"].max(-1)
    return gain, 1 + choice


def _only(seen: Seen, caller: Int64[Tensor, "B"]) -> Tensor:
    _, choice = _best(seen)
    return torch.where(torch.arange(seen.task.n_agents) == caller.unsqueeze(-1), choice, 0)


class Schedule(Task):
    """Six UAVs on waypoints that they do not steer share a channel; each may call one other UAV or
    anchor a step, and calls collide.

    Reward of each: minus the own error / 10, of errors up to 10 m. ``drift``: odometry's noise,
    m/√m.
    """

    name = "schedule-v0"
    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "nearest": nearest,
        "own_gain": own_gain,
        "slots": slots,
        "uncertain": uncertain,
        "local": local,
        "central": central,
    }
    best = "local"
    sampled = True
    about: ClassVar = {
        "gain": "log of what each call but silence would take off the own variance, 10⁻³ … 10 m² "
        "as −1 … 1",
        "ranks": "rank of the own σ and of the best gain among all",
        "success": "whether the UAV ranged to anybody, and whether it is its turn",
        "called": "whether each called in the last step, the own first, then (i + k) mod N",
    }
    meaning = "0 for silence, k for UAV (i + k) mod N, N … for an anchor"

    def __init__(
        self,
        *,
        n_uavs: Uavs = 6,
        horizon: PositiveCount = 100,
        drift: Drift = 0.25,
        task: TaskOptions = TaskOptions(credit="own"),
    ) -> None:
        self.choices = n_uavs + len(_ANCHORS)
        space = Space((_SIDE, _SIDE), self.hard, _WALLS)
        scenario = task_scenario(
            self.name,
            sensors(space.anchors(_ANCHORS), 0.05, drift, _RADIUS, space.walls),
            arena=space.arena(n_uavs),
            horizon=horizon,
            motion=Roam(2.0, space.over()),
            network=Network(
                _RADIUS,
                space.walls,
                links="chosen",
                interference=_RADIUS,
                max_neighbours=max(16, n_uavs),
            ),
            prior=Prior(2.0),
        )
        super().__init__(scenario, n_uavs, task, _RADIUS, 2.0)

    def targets_of(self, n: int) -> Int64[Tensor, "n C"]:
        """Whom each UAV calls by each choice but the first: a UAV, or N + m for anchor m."""
        every = torch.arange(n + len(self.anchors), device=self.anchors.device)
        uavs = (every[:n, None] + every[1:n]) % n
        return torch.cat((uavs, every[n:].expand(n, -1)), -1)

    def commands(self, memory: TaskMemory, action: Float32[Tensor, "B n"]) -> Commands:
        choice = action.long()
        target = self.targets_of(self.n_agents).expand(len(choice), -1, -1)
        calls = target.gather(2, (choice - 1).clamp_min(0).unsqueeze(-1))[..., 0]
        return Commands(calls=torch.where(choice > 0, calls, SILENT))

    def estimate(
        self, memory: TaskMemory, action: Float32[Tensor, "B n"]
    ) -> tuple[TaskMemory, Float32[Tensor, "B N A"]]:
        memory.more["called"] = action.to(torch.float32)
        return memory, memory.action

    def start(self, blank: Float32[Tensor, "B N"]) -> dict[str, Tensor]:
        assert self.choices is not None
        each = blank.unsqueeze(-1).repeat(1, 1, self.choices - 1)
        names = ("gain", "team_gain", "distance")
        return {"called": blank.clone(), **{name: each.clone() for name in names}}

    def keep(self, memory: TaskMemory, observation: Observation) -> TaskMemory:
        """Predicted gains (m²) of each call, the UAV's own and the team's."""
        n, b = self.n_agents, len(memory.position)
        p, joint = memory.position, memory.joint
        gains = torch.cat((range_gains(p, joint), anchor_gains(p, joint, self.anchors)), 2)
        place = torch.cat((p, self.anchors.expand(b, -1, -1)), 1)
        distance = (p.unsqueeze(2) - place.unsqueeze(1)).norm(dim=-1)
        target = self.targets_of(n).expand(b, -1, -1)
        distance = distance.gather(2, target)
        own = gains.diagonal(dim1=1, dim2=3).transpose(1, 2)  # [B, i, target]
        inside = (distance <= self.radius).to(p.dtype)
        if self.scenario.strangers:
            inside[..., : n - 1] = 0.0
        memory.more["gain"] = own.gather(2, target) * inside
        memory.more["team_gain"] = gains.sum(-1).gather(2, target) * inside
        memory.more["distance"] = distance
        return memory

    def allowed(self, memory: TaskMemory) -> Bool[Tensor, "B n C"]:
        inside = memory.more["distance"] <= self.radius
        return torch.cat((torch.ones_like(inside[..., :1]), inside), -1)

    def extras(self, memory: TaskMemory) -> dict[str, Float32[Tensor, "B n F"]]:
        """Where agents know what they heard, there are no ranks, and calls are of those heard."""
        n, gain = self.n_agents, memory.more["gain"]
        i = torch.arange(n, device=gain.device)
        success = memory.seen.any(-1)
        turn = (memory.step - i) % n == 0
        flags = 2 * torch.stack((success, turn), -1).to(gain.dtype) - 1
        others = (i[:, None] + i) % n
        called = (memory.more["called"] > 0)[:, others]
        found = {"gain": log_gain(gain)}
        if self.messages:
            heard = memory.seen[:, i[:, None], others]
            called = called & (heard | (others == i[:, None]))
        else:
            ranks = rank(own_sigma(memory.joint)), rank(gain.amax(-1))
            found["ranks"] = torch.stack(ranks, -1)
        return {**found, "success": flags, "called": 2 * called.to(gain.dtype) - 1}

    def secrets(self, memory: TaskMemory) -> list[Float32[Tensor, "B F"]]:
        return [log_gain(memory.more["gain"]).flatten(1)]

    def own_reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        return memory, -self.cost(memory, world) / MOST_ERROR


class ScheduleHard(Schedule):
    """``schedule-v0`` in three dimensions: UAVs roam over two walls of 12 m, which hide anchors."""

    name = "schedule-hard-v0"
    hard = True
