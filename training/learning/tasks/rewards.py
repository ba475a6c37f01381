"""Difference rewards: what each UAV's call was worth to its team."""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from agents.tasks.gains import directions
from agents.tasks.memory import TaskMemory
from agents.tasks.task import MOST_ERROR, Task
from coloc_env.channel import Channel
from coloc_env.commands import SILENT
from coloc_env.sensors import Displacement
from coloc_env.world import World


class Difference:
    """What a UAV's call was worth to the team: the mean σ (m) had it been silent, minus the mean σ
    (difference rewards, Wolpert & Tumer 2002), where calls are chosen.

    Both are predicted from the covariance before the step: exchanges succeed as the channel has
    them, and each takes its part off the covariance, one after another. Raises ValueError for a
    task without such calls.
    """

    def __init__(self, task: Task) -> None:
        moves = task.believed.sensor(Displacement)
        if not hasattr(task, "targets_of") or moves is None:
            raise ValueError(f"difference=true is for calls that UAVs choose; {task.name} has none")
        self.task = task
        speed = task.v_max * task.believed.arena.dt
        self.added = moves.still**2 + moves.moving**2 * speed  # m², of odometry in a step

    def start(self, memory: TaskMemory) -> None:
        """An episode starts, in all worlds."""
        self.before = memory.joint

    def __call__(self, memory: TaskMemory, world: World) -> Float[Tensor, "B n 1"]:
        """Of the calls of the step that led here."""
        n = self.task.n_agents
        calls = self.task.commands(memory, memory.more["called"]).calls  # [B, n]
        assert calls is not None
        alone = torch.eye(n, dtype=torch.bool, device=calls.device)
        silenced = torch.where(alone, SILENT, calls.unsqueeze(1))
        each = torch.cat((calls.unsqueeze(1), silenced), 1)  # [B, 1 + n, n]
        value = self.sigmas(each, self.before, world.now.target)
        self.before = memory.joint
        return (value[:, 1:] - value[:, :1]).unsqueeze(-1)

    def sigmas(
        self,
        calls: Int64[Tensor, "B S n"],
        joint: Float[Tensor, "B n n d d"],
        place: Float[Tensor, "B n d"],
    ) -> Float[Tensor, "B S"]:
        """Mean σ (m) of the team after the exchanges of each of S sets of calls, from a covariance
        before the step and positions after it."""
        b, s, n = calls.shape
        places = torch.cat((place, self.task.anchors.expand(b, -1, -1)), 1)
        rows = torch.arange(b, device=place.device).repeat_interleave(s)
        flat = calls.flatten(0, 1)
        called = flat.clamp_min(0)
        succeeds = _exchanged(flat, places[rows], n, self.task.radius)
        d, m = self.task.dim, len(self.task.anchors)
        added = self.added * torch.eye(n * d, device=place.device)
        p = joint.transpose(2, 3).reshape(b, n * d, n * d) + added
        p = torch.nn.functional.pad(p, (0, m * d, 0, m * d))[rows]  # anchors: no variance
        unit, _, variance = directions(places, places)
        every = torch.arange(len(rows), device=place.device)
        for i in range(n):
            u, r = unit[rows, i, called[:, i]], variance[rows, i, called[:, i]]
            h = place.new_zeros(len(rows), n + m, d)
            h[:, i] = u
            h[every, called[:, i]] -= u
            h = h.flatten(1) * succeeds[:, i, None]
            ph = (p @ h.unsqueeze(-1))[..., 0]  # P hᵀ
            innovation = (h * ph).sum(-1) + r  # S = h P hᵀ + R
            p = p - ph.unsqueeze(-1) * ph.unsqueeze(-2) / innovation[:, None, None]
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
