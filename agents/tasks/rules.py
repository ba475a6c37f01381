"""What heuristics have in common: what they see, and how they go somewhere."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from agents.tasks.memory import TaskMemory, own_sigma
from agents.tasks.space import CRUISE

if TYPE_CHECKING:
    from agents.tasks.task import Task


@dataclass(frozen=True)
class Seen:
    """All that a policy may use, for B worlds at once: the agents' flat ``observation`` [B, n, F],
    ``mask`` [B, n, choices] of what they may choose (None: anything), and, for heuristics, what the
    estimator says of everybody, whatever the task's ``telemetry``. ``random``: where a policy's own
    random numbers come from."""

    task: "Task"
    observation: Float32[Tensor, "B n F"]
    mask: Bool[Tensor, "B n C"] | None
    memory: TaskMemory
    random: torch.Generator

    @property
    def position(self) -> Float[Tensor, "B N d"]:
        """Estimated positions (m)."""
        return self.memory.position

    @property
    def plane(self) -> Float[Tensor, "B N 2"]:
        """Estimated positions (m), seen from above."""
        return self.memory.position[..., :2]

    @property
    def sigma(self) -> Float[Tensor, "B N"]:
        """Root of the mean variance of each position per axis (m)."""
        return own_sigma(self.memory.joint)


Policy = Callable[[Seen], Tensor]


def random_policy(seen: Seen) -> Tensor:
    """Actions at random, uniform."""
    b, n = seen.observation.shape[:2]
    if seen.task.choices is None:
        return 2 * torch.rand(b, n, seen.task.width, generator=seen.random) - 1
    assert seen.mask is not None
    weights = seen.mask.to(torch.float32).flatten(0, 1)
    return torch.multinomial(weights, 1, generator=seen.random).view(b, n)


def idle(seen: Seen) -> Tensor:
    """Nothing: no motion, no call."""
    b, n = seen.observation.shape[:2]
    if seen.task.choices is None:
        return steer(seen, torch.zeros(b, n, seen.task.width))
    return torch.zeros(b, n, dtype=torch.int64)


def towards(seen: Seen, goal: Float[Tensor, "B n g"], slow: float = 1.0) -> Float[Tensor, "B n d"]:
    """Actions that take agents to goals (m) at top speed, or slower where they are near; goals in
    the plane: over the walls."""
    own = seen.position[:, : seen.task.n_agents]
    if goal.shape[-1] < own.shape[-1]:
        goal = torch.cat((goal, torch.full_like(goal[..., :1], CRUISE)), -1)
    apart = goal - own
    length = (apart * apart).sum(-1, keepdim=True).sqrt().clamp_min(1e-6)
    speed = (length / slow).clamp(max=seen.task.v_max) / seen.task.v_max
    return steer(seen, apart / length * speed)


def steer(seen: Seen, velocity: Float[Tensor, "B n d"]) -> Float[Tensor, "B n d"]:
    """Actions that bring about velocities (in units of the top speed)."""
    task = seen.task
    if task.control == "velocity":
        return velocity
    now = seen.memory.velocity[:, : task.n_agents]
    wanted = (task.v_max * velocity - now) / task.scenario.arena.dt  # m/s²
    return (wanted / task.scale).clamp(-1.0, 1.0)
