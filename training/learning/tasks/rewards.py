"""Rewards to train on: the task's own, or one that says more about what an action was worth.

Scores are always the task's own. A reward here may use the truth, as the task's own does.
"""

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from agents.tasks.gains import directions
from agents.tasks.survey import cell_of
from agents.tasks.task import MOST_ERROR, Task, TaskMemory, own_sigma
from coloc_env.channel import Channel
from coloc_env.commands import SILENT
from coloc_env.sensors import Displacement
from coloc_env.world import World


class Reward(ABC):
    """A reward of a task; it keeps what it needs from step to step, [B, …] each."""

    tasks: ClassVar[tuple[str, ...]] = ()  # whom it is for; none: for all

    def __init__(self, task: Task) -> None:
        if self.tasks and task.name not in self.tasks:
            name = next(key for key, one in REWARDS.items() if one is type(self))
            raise ValueError(f"reward={name} is for {', '.join(self.tasks)}, not for {task.name}")
        self.task = task

    def start(self, memory: TaskMemory) -> None:
        """An episode starts, in all worlds."""

    @abstractmethod
    def __call__(
        self, own: Float32[Tensor, "B n 1"], memory: TaskMemory, world: World
    ) -> Float32[Tensor, "B n 1"]:
        """The reward of the step that led here, beside the task's ``own``."""


class Own(Reward):
    """The task's."""

    def __call__(self, own: Tensor, memory: TaskMemory, world: World) -> Tensor:
        return own


class Sigma(Reward):
    """Minus the standard deviation that the filter states in place of the true error, of what the
    task's own reward is about: less noise, and nothing that the policy cannot see."""

    def __call__(self, own: Tensor, memory: TaskMemory, world: World) -> Tensor:
        sigma = (self.task.dim**0.5 * own_sigma(memory.joint)).clamp(max=MOST_ERROR)
        value = -sigma / MOST_ERROR
        n = self.task.n_agents
        if value.shape[1] > n:
            value = value[:, n:].mean(1, keepdim=True).expand(-1, n)
        return value.unsqueeze(-1)


class Soft(Reward):
    """New ground counts by how likely the filter thinks an error below 1 m, 1 − exp(−1/tr P), in
    place of whether it is: a reward that grows smoothly as positions become better known."""

    def start(self, memory: TaskMemory) -> None:
        self.best: Tensor | None = None

    def __call__(self, own: Tensor, memory: TaskMemory, world: World) -> Tensor:
        n = self.task.n_agents
        place = world.now.target[:, :n]
        variance = self.task.dim * own_sigma(memory.joint)[:, :n].square()
        known = 1 - (-1 / variance.clamp_min(1e-6)).exp()
        if self.task.name == "convoy-v0":
            team = self._ground(place[..., 0], known) / self.task.v_max
        else:
            team = 100.0 * self._cells(place, known)
        return team[:, None, None].expand(-1, n, 1)

    def _ground(self, x: Float[Tensor, "B n"], known: Float[Tensor, "B n"]) -> Float[Tensor, "B"]:
        """New ground in x (m), the mean over UAVs."""
        before = x if self.best is None else self.best
        self.best = torch.maximum(before, x)
        return ((self.best - before) * known).mean(-1)

    def _cells(
        self, place: Float[Tensor, "B n d"], known: Float[Tensor, "B n"]
    ) -> Float[Tensor, "B"]:
        """Newly known share of cells, each as well as it has been known at best."""
        before = known.new_zeros(len(place), 100) if self.best is None else self.best
        self.best = before.scatter_reduce(1, cell_of(place), known, "amax")
        return (self.best - before).mean(-1)


class Difference(Reward):
    """What a UAV's call was worth to the team: the mean σ (m) had it been silent, minus the mean σ
    (difference rewards, Wolpert & Tumer 2002).

    Both are predicted from the covariance before the step: exchanges succeed as the channel has
    them, and each takes its part off the covariance, one after another.
    """

    tasks = ("schedule-v0",)

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        moves = task.believed.sensor(Displacement)
        assert moves is not None
        speed = task.v_max * task.believed.arena.dt
        self.added = moves.still**2 + moves.moving**2 * speed  # m², of odometry in a step

    def start(self, memory: TaskMemory) -> None:
        self.before = memory.joint

    def __call__(self, own: Tensor, memory: TaskMemory, world: World) -> Tensor:
        n = self.task.n_agents
        calls = self.task.commands(memory, memory.more["called"]).calls  # [B, n]
        assert calls is not None
        silenced = torch.where(torch.eye(n, dtype=torch.bool), SILENT, calls.unsqueeze(1))
        each = torch.cat((calls.unsqueeze(1), silenced), 1)  # [B, 1 + n, n]
        value = self._sigmas(each, self.before, world.now.target)
        self.before = memory.joint
        return (value[:, 1:] - value[:, :1]).unsqueeze(-1)

    def _sigmas(
        self,
        calls: Int64[Tensor, "B S n"],
        joint: Float[Tensor, "B n n d d"],
        place: Float[Tensor, "B n d"],
    ) -> Float[Tensor, "B S"]:
        """Mean σ (m) of the team after the exchanges of each of S sets of calls."""
        b, s, n = calls.shape
        places = torch.cat((place, self.task.anchors.expand(b, -1, -1)), 1)
        rows = torch.arange(b).repeat_interleave(s)
        flat = calls.flatten(0, 1)
        called = flat.clamp_min(0)
        succeeds = _exchanged(flat, places[rows], n, self.task.radius)
        d, m = self.task.dim, len(self.task.anchors)
        p = joint.transpose(2, 3).reshape(b, n * d, n * d) + self.added * torch.eye(n * d)
        p = torch.nn.functional.pad(p, (0, m * d, 0, m * d))[rows]  # anchors: no variance
        unit, _, variance = directions(places, places)
        every = torch.arange(len(rows))
        for i in range(n):
            u, r = unit[rows, i, called[:, i]], variance[rows, i, called[:, i]]
            h = torch.zeros(len(rows), n + m, d)
            h[:, i] = u
            h[every, called[:, i]] -= u
            h = h.flatten(1) * succeeds[:, i, None]
            ph = (p @ h.unsqueeze(-1))[..., 0]
            residual = (h * ph).sum(-1) + r
            p = p - ph.unsqueeze(-1) * ph.unsqueeze(-2) / residual[:, None, None]
        own = p.diagonal(dim1=-2, dim2=-1)[:, : n * d].unflatten(-1, (n, d)).sum(-1)
        return own.clamp(0.0, MOST_ERROR**2).sqrt().mean(-1).view(b, s)


def _exchanged(
    calls: Int64[Tensor, "R n"], place: Float[Tensor, "R M d"], n: int, radius: float
) -> Bool[Tensor, "R n"]:
    """Whose calls succeed on the channel, and reach whom they call."""
    channel = Channel(calls, place[:, :n].double(), radius)
    ways = torch.cat((channel.chosen(), channel.to_anchors(place[:, n:].double())), -1)
    called = calls.clamp_min(0).unsqueeze(-1)
    target = place.gather(1, called.expand(-1, -1, place.shape[-1]))
    near = (place[:, :n] - target).norm(dim=-1) <= radius
    return (calls >= 0) & near & ways.gather(-1, called)[..., 0]


REWARDS: dict[str, type[Reward]] = {
    "own": Own,
    "sigma": Sigma,
    "soft": Soft,
    "difference": Difference,
}
