"""What tasks have in common: an estimator in the loop, what agents see of it, rewards by the truth.

A task is an action mode (``coloc_env.envs.actions``): a memory that goes from step to step, and
pure functions of it. What agents see is made of estimates alone; rewards are of the truth.
"""

import copy
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float, Float32, Int64
from tensordict import TensorClass, TensorDict
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.registry import make
from coloc_env.commands import Commands
from coloc_env.envs.actions import ActionMode, Leaves
from coloc_env.observation import Observation
from coloc_env.options import require_known
from coloc_env.scenario import DisplacementDriven, Scenario
from coloc_env.sensors import AnchorRanging, Displacement, RangeNoise, Ranging, Sensor
from coloc_env.sensors.base import Leaf
from coloc_env.world import World

ESTIMATOR = "ekf_joint:second_order=true:iterations=1"
NOISE = RangeNoise(0.1, per_metre=0.01)
MOST_ERROR = 10.0  # m: larger errors count as this
_SIGMAS = (0.05, 20.0)  # m: what log σ is scaled by


class TaskMemory(TensorClass):
    """The estimator's belief, and what it says at the step last observed (m, m/s; world frame).

    ``joint`` [B, N, N, d, d]: covariances (m²) between all UAVs' positions, 0 where the estimator
    keeps none. ``more``: what a task keeps beside.
    """

    belief: Any
    action: Float32[Tensor, "B N A"]
    position: Float[Tensor, "B N d"]
    velocity: Float[Tensor, "B N d"]
    joint: Float[Tensor, "B N N d d"]
    seen: Bool[Tensor, "B N M"]
    step: Int64[Tensor, "B N"]
    more: Any


@dataclass(frozen=True)
class Seen:
    """All that a policy may use, for B worlds at once: the agents' flat ``observation`` [B, n, F],
    ``mask`` [B, n, choices] of what they may choose (None: anything), and, for heuristics, what the
    estimator says. ``random``: where a policy's own random numbers come from."""

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
    def sigma(self) -> Float[Tensor, "B N"]:
        """Root of the mean variance of each position per axis (m)."""
        return own_sigma(self.memory.joint)


Policy = Callable[[Seen], Tensor]


class Task(ActionMode):
    """Base of all tasks: ``scenario``, ``n_agents`` UAVs that act, and an ``estimator`` by name.

    ``policies``: heuristics by name, ``random`` and ``idle`` among them; ``best``: the best one
    that is known.
    """

    rewards = True
    whole = True
    policies: ClassVar[Mapping[str, Policy]]
    best: ClassVar[str]
    team_reward: ClassVar[bool] = True

    def __init__(
        self, scenario: Scenario, n_agents: int, estimator: str, radius: float, v_max: float
    ) -> None:
        super().__init__(scenario.believed)
        self.name, self.scenario, self._n = scenario.name, scenario, n_agents
        self.estimator: Localizer[Any] = make(estimator, scenario)
        self.radius, self.v_max = radius, v_max
        anchors = self.believed.sensor(AnchorRanging)
        places = anchors.anchors if anchors else ()
        self.anchors = torch.tensor(places).view(len(places), self.dim)
        low, high = self.believed.arena.low, self.believed.arena.high
        self.low, self.high = torch.tensor(low), torch.tensor(high)
        self._size: int | None = None

    meaning = "a velocity in units of the top speed, within [-1, 1]"

    @property
    def n_agents(self) -> int:
        return self._n

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": self.name}

    @property
    def leaves(self) -> dict[str, Leaf]:
        if self._size is None:
            world = World(self.scenario)
            observation = world.reset(0)
            memory = self.reset(observation)
            self._size = self.observe(memory, observation)[1]["observation"].shape[-1]
        mask = {} if self.choices is None else {"action_mask": Leaf(self.choices, 0.0, 1.0)}
        return {"observation": Leaf(self._size, -1.0, 1.0), **mask}

    def policy(self, name: str) -> Policy:
        """A heuristic by name; ValueError, with all there are, for an unknown one."""
        require_known(f"policy of {self.name}", [name], self.policies)
        return self.policies[name]

    def without_cooperation(self) -> "Task":
        """The same task for UAVs that cannot range each other."""
        alone = copy.copy(self)
        alone.scenario = replace(self.scenario, strangers=self._n)
        alone.believed = alone.scenario.believed
        return alone

    # ---------------------------------------------------------------- the estimator in the loop

    def reset(self, observation: Observation) -> TaskMemory:
        b, n = observation.batch_size
        d = self.dim
        prior = observation["prior"]
        blank = prior.new_zeros(b, n)
        return TaskMemory(
            belief=self.estimator.reset(observation),
            action=prior.new_zeros(b, n, 3 * d),
            position=prior[..., :d],
            velocity=prior.new_zeros(b, n, d),
            joint=prior.new_zeros(b, n, n, d, d),
            seen=prior.new_zeros(b, n, n + len(self.anchors), dtype=torch.bool),
            step=torch.full((b, n), -1, dtype=torch.int64),
            more=TensorDict(self.start(blank), batch_size=[b, n]),
            batch_size=[b, n],
        )

    def start(self, blank: Float32[Tensor, "B N"]) -> dict[str, Tensor]:
        """What the task keeps beside the estimates, at first; [B, N, …] each."""
        return {}

    @torch.no_grad()
    def observe(self, memory: TaskMemory, observation: Observation) -> tuple[TaskMemory, Leaves]:
        belief, estimate = self.estimator.step(memory.belief, observation)
        masks = [observation["range_mask"] > 0]
        if len(self.anchors):
            masks.append(observation["anchor_range_mask"] > 0)
        memory = memory.replace(
            belief=belief,
            action=estimate.action(),
            position=estimate.position.to(torch.float32),
            velocity=estimate.velocity.to(torch.float32),
            joint=joint_covariance(belief, estimate).to(torch.float32),
            seen=torch.cat(masks, -1),
            step=memory.step + 1,
        )
        memory = self.keep(memory)
        features = torch.cat((*self.common(memory), *self.extras(memory)), -1)
        leaves = {"observation": features.nan_to_num(0.0).clamp(-1.0, 1.0)}
        if self.choices is not None:
            leaves["action_mask"] = self.allowed(memory).to(torch.float32)
        return memory, leaves

    def keep(self, memory: TaskMemory) -> TaskMemory:
        """The memory with what the task keeps of the step."""
        return memory

    def extras(self, memory: TaskMemory) -> list[Float32[Tensor, "B n F"]]:
        """What agents see beside the estimates, within [−1, 1]."""
        return []

    def allowed(self, memory: TaskMemory) -> Bool[Tensor, "B n C"]:
        """Which choices an agent has."""
        raise NotImplementedError

    def estimate(
        self, memory: TaskMemory, action: Float32[Tensor, "B n a"]
    ) -> tuple[TaskMemory, Float32[Tensor, "B N A"]]:
        return memory, memory.action

    def commands(self, memory: TaskMemory, action: Float32[Tensor, "B n a"]) -> Commands:
        """Velocities for the UAVs that act, 0 for the others."""
        still = action.new_zeros(len(action), self.believed.arena.n_uavs, self.dim)
        still[:, : self._n] = self.v_max * action.clamp(-1.0, 1.0)
        return Commands(motion=still)

    def reference(self, memory: TaskMemory) -> Float32[Tensor, "B N d"]:
        return memory.position

    @abstractmethod
    def reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]: ...

    def error(self, memory: TaskMemory, world: World) -> Float32[Tensor, "B N"]:
        """True error (m) of the estimates, at most 10 m; that also where they are not finite."""
        apart = memory.position - world.now.target
        error = (apart * apart).sum(-1).sqrt()
        return torch.where(error.isfinite(), error, MOST_ERROR).clamp(max=MOST_ERROR)

    # ---------------------------------------------------------------- what agents see

    def common(self, memory: TaskMemory) -> list[Float32[Tensor, "B n F"]]:
        """Own estimate, neighbours (the nearest first), targets, anchors, time and number."""
        n, b = self._n, len(memory.position)
        position, velocity = memory.position, memory.velocity / self.v_max
        own = position[:, :n]
        p = memory.joint.diagonal(dim1=1, dim2=2).movedim(-1, 1)
        sigmas = log_sigmas(p)
        shape = torch.stack((p[..., 0, 0] - p[..., 1, 1], 2 * p[..., 0, 1]), -1)
        shape = shape / p.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True).clamp_min(1e-9)
        parts = [
            2 * (own - self.low) / (self.high - self.low) - 1,
            velocity[:, :n],
            sigmas[:, :n],
            shape[:, :n],
        ]
        i = torch.arange(n)
        others = (i[:, None] + torch.arange(1, n)) % n
        apart = own[:, others] - own.unsqueeze(2)  # [B, n, n − 1, d]
        order = (apart * apart).sum(-1).argsort(-1) if n > 1 else None
        reach = memory.seen[:, :n][:, i[:, None], others].to(own.dtype).unsqueeze(-1)
        about = (apart / (2 * self.radius), apart / 10, sigmas[:, :n, :1][:, others], reach)
        neighbours = torch.cat((*about, velocity[:, others]), -1)
        if order is not None:
            neighbours = neighbours.gather(2, order.unsqueeze(-1).expand_as(neighbours))
        parts.append(neighbours.flatten(2))
        total = self.believed.arena.n_uavs
        if total > n:
            apart = position[:, None, n:] - own.unsqueeze(2)
            seen = memory.seen[:, :n, n:total].to(own.dtype).unsqueeze(-1)
            spread = sigmas[:, None, n:, :1].expand(*apart.shape[:-1], 1)
            targets = (apart / (2 * self.radius), apart / 10, spread, seen)
            parts.append(torch.cat(targets, -1).flatten(2))
        if len(self.anchors):
            apart = self.anchors - own.unsqueeze(2)
            near = memory.seen[:, :n, total:].to(own.dtype).unsqueeze(-1)
            parts.append(torch.cat((apart / (2 * self.radius), near), -1).flatten(2))
        time = 2 * memory.step[:, :n].to(own.dtype) / max(self.scenario.horizon - 1, 1) - 1
        number = (2 * i / max(n - 1, 1) - 1).to(own.dtype).expand(b, n)
        parts.append(torch.stack((time, number), -1))
        return parts


def task_scenario(
    name: str,
    believed: tuple[Sensor, ...],
    **more: Any,
) -> Scenario:
    """A scenario whose team knows its sensors, and moves by displacements."""
    return Scenario(
        name=name,
        sensors=believed,
        believed_sensors=believed,
        process=DisplacementDriven(),
        **more,
    )


def joint_covariance(belief: Any, estimate: Estimate) -> Float[Tensor, "B N N d d"]:
    """Covariances between all positions: a joint filter's, or each UAV's own on the diagonal."""
    own = estimate.covariance
    b, n, d = own.shape[:3]
    whole = getattr(belief, "covariance", None)
    if n > 1 and whole is not None and whole.shape[-1] == n * whole.shape[-2]:
        return whole.unflatten(-1, (n, -1))[:, :, :d, :, :d].transpose(2, 3)
    joint = own.new_zeros(b, n, n, d, d)
    joint.diagonal(dim1=1, dim2=2).copy_(own.movedim(1, -1))
    return joint


def own_sigma(joint: Float[Tensor, "B N N d d"]) -> Float[Tensor, "B N"]:
    """Root of each UAV's mean variance per axis (m)."""
    own = joint.diagonal(dim1=1, dim2=2).diagonal(dim1=1, dim2=2)  # [B, N, d]
    return own.mean(-1).clamp_min(0.0).sqrt()


def log_sigmas(p: Float[Tensor, "B N 2 2"]) -> Float[Tensor, "B N 2"]:
    """log σ along the major and the minor axis, 0.05 … 20 m as −1 … 1."""
    half, trace = 0.5 * (p[..., 0, 0] - p[..., 1, 1]), 0.5 * (p[..., 0, 0] + p[..., 1, 1])
    root = (half**2 + p[..., 0, 1] ** 2).sqrt()
    variance = torch.stack((trace + root, trace - root), -1).clamp_min(1e-12)
    low, high = (torch.tensor(x).log() for x in _SIGMAS)
    return 2 * (0.5 * variance.log() - low) / (high - low) - 1


def sensors(
    anchors: tuple[tuple[float, ...], ...],
    still: float,
    moving: float,
    radius: float | None,
    blind: int = 0,
    walk: float = 1.0,
) -> tuple[Sensor, ...]:
    """Displacements, ranges between UAVs and to anchors: what every task's team measures."""
    return (
        Displacement(still, moving, blind, walk),
        Ranging(NOISE),
        AnchorRanging(anchors, NOISE, radius=radius),
    )


# ---------------------------------------------------------------- policies


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
        return torch.zeros(b, n, seen.task.width)
    return torch.zeros(b, n, dtype=torch.int64)


def towards(seen: Seen, goal: Float[Tensor, "B n d"], slow: float = 1.0) -> Float[Tensor, "B n d"]:
    """Actions that take agents to goals (m) at top speed, or slower where they are near."""
    apart = goal - seen.position[:, : seen.task.n_agents]
    length = (apart * apart).sum(-1, keepdim=True).sqrt().clamp_min(1e-6)
    speed = (length / slow).clamp(max=seen.task.v_max) / seen.task.v_max
    return apart / length * speed
