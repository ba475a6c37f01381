"""What tasks have in common: an estimator in the loop, what agents see of it, rewards by the truth.

A task is an action mode (``coloc_env.envs.actions``): a memory that goes from step to step, and
pure functions of it. What agents see is made of estimates alone; rewards are of the truth.
"""

import copy
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Bool, Float32
from tensordict import TensorDict
from torch import Tensor

from agents.localizer import Localizer
from agents.registry import make_inner
from agents.tasks.memory import TaskMemory, joint_covariance, own_covariance, total_sigma
from agents.tasks.observation import (
    ABOUT,
    AGED,
    Others,
    common,
    free,
    hear,
    log_sigmas,
    remembered,
    unheard,
)
from agents.tasks.options import SteeredTaskOptions, TaskOptions
from agents.tasks.rules import Policy
from coloc_env.commands import Commands
from coloc_env.envs.action_mode import ActionMode, Leaves
from coloc_env.motion import Box
from coloc_env.observation import Observation
from coloc_env.options import require_known
from coloc_env.scenario import DisplacementDriven, Scenario
from coloc_env.sensors import AnchorRanging, Displacement, RangeNoise, Ranging, Sensor
from coloc_env.sensors.base import Leaf
from coloc_env.world import World

NOISE = RangeNoise(0.1, per_metre=0.01)
MOST_ERROR = 10.0  # m: larger errors count as this
_MEANINGS = {
    "velocity": "a velocity in units of the top speed, within [-1, 1]",
    "acceleration": "an acceleration in units of the largest, within [-1, 1]",
}


class Task(ActionMode):
    """Base of all tasks: ``scenario``, ``n_agents`` UAVs that act, and options.

    ``policies``: heuristics by name, ``random`` and ``idle`` among them; ``best``: the best one
    that is known. ``planners``: makers of policies that search, far slower. ``sampled``: policies
    that learn are to be scored by actions drawn from them, not by the most probable ones.
    ``shared``: what is rewarded is nobody's own. ``about``: what the task's own parts of the
    observation are. ``hard``: in space, with walls.
    """

    rewards = True
    whole = True
    policies: ClassVar[Mapping[str, Policy]]
    planners: ClassVar[Mapping[str, Callable[[], Policy]]] = {}
    best: ClassVar[str]
    sampled: ClassVar[bool] = False
    shared: ClassVar[bool] = False
    hard: ClassVar[bool] = False
    about: ClassVar[Mapping[str, str]] = {}
    meaning = ""

    def __init__(
        self,
        scenario: Scenario,
        n_agents: int,
        chosen: TaskOptions,
        radius: float,
        v_max: float,
        a_max: float = 0.0,
    ) -> None:
        super().__init__(scenario.believed)
        self.scenario, self._n, self.chosen = scenario, n_agents, chosen
        self.flat = chosen.obs == "flat"
        if self.shared and chosen.credit == "own":
            raise ValueError(f"{self.name}: credit='own' is not allowed: rewards are the team's")
        self.estimator: Localizer[Any] = make_inner(chosen.estimator, scenario)
        self.radius, self.v_max, self.a_max = radius, v_max, a_max
        self.control = chosen.control if isinstance(chosen, SteeredTaskOptions) else "velocity"
        self.scale = v_max if self.control == "velocity" else a_max
        self.meaning = type(self).meaning if self.choices else _MEANINGS[self.control]
        anchors = self.believed.sensor(AnchorRanging)
        places = anchors.anchors if anchors else ()
        self.anchors = torch.tensor(places).view(len(places), self.dim)
        low, high = self.believed.arena.low, self.believed.arena.high
        self.low, self.high = torch.tensor(low), torch.tensor(high)
        i = torch.arange(n_agents)
        self.ring = (i[:, None] + torch.arange(1, n_agents)) % n_agents
        self.numbers = 2 * i / max(n_agents - 1, 1) - 1
        self._widths: dict[str, int] | None = None

    @property
    def n_agents(self) -> int:
        return self._n

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": self.name}

    @property
    def messages(self) -> bool:
        """Whether agents know of others only what they heard."""
        return self.chosen.telemetry == "messages"

    @property
    def widths(self) -> dict[str, int]:
        """How many numbers each part of an observation has, in order."""
        if self._widths is None:
            observation = World(self.scenario, device=self.low.device).reset(0)
            memory = self._estimated(self.reset(observation), observation)
            self._widths = {name: x.shape[-1] for name, x in self.parts(memory).items()}
        return self._widths

    @property
    def leaves(self) -> dict[str, Leaf]:
        mask = {} if self.choices is None else {"action_mask": Leaf(self.choices, 0.0, 1.0)}
        widths = self.widths
        if self.flat:
            widths = {"observation": sum(widths.values())}
        return {name: Leaf(width, -1.0, 1.0) for name, width in widths.items()} | mask

    def describe(self) -> dict[str, str]:
        """What each part of an observation is."""
        texts = ABOUT | dict(self.about)
        aged = AGED if self.messages else ""
        heard = ("neighbours", "targets")
        return {name: texts[name] + (aged if name in heard else "") for name in self.widths}

    def policy(self, name: str) -> Policy:
        """A heuristic or planner by name; ValueError, with all there are, for an unknown one."""
        require_known(f"policy of {self.name}", [name], (*self.policies, *self.planners))
        return self.planners[name]() if name in self.planners else self.policies[name]

    def with_options(self, **more: Any) -> Self:
        """The same task in the same scenario with other values of options that change no world:
        ``reward``, ``credit``, ``obs``."""
        other = copy.copy(self)
        other.chosen = replace(self.chosen, **more)
        other.flat = other.chosen.obs == "flat"
        return other

    def without_cooperation(self) -> Self:
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
        more = self.start(blank)
        if self.messages:
            more |= unheard(self, prior)
        return TaskMemory(
            belief=self.estimator.reset(observation),
            action=prior.new_zeros(b, n, 3 * d),
            position=prior[..., :d],
            velocity=prior.new_zeros(b, n, d),
            joint=prior.new_zeros(b, n, n, d, d),
            seen=prior.new_zeros(b, n, n + len(self.anchors), dtype=torch.bool),
            step=prior.new_full((b, n), -1, dtype=torch.int64),
            more=TensorDict(more, batch_size=[b, n]),
            batch_size=[b, n],
        )

    def start(self, blank: Float32[Tensor, "B N"]) -> dict[str, Tensor]:
        """What the task keeps beside the estimates, at first; [B, N, …] each."""
        return {}

    @torch.no_grad()
    def observe(self, memory: TaskMemory, observation: Observation) -> tuple[TaskMemory, Leaves]:
        memory = self._estimated(memory, observation)
        found = {
            name: part.nan_to_num(0.0).clamp(-1.0, 1.0) for name, part in self.parts(memory).items()
        }
        leaves = found
        if self.flat:
            leaves = {"observation": torch.cat(list(found.values()), -1)}
        if self.choices is not None:
            leaves["action_mask"] = self.allowed(memory).to(torch.float32)
        return memory, leaves

    def _estimated(self, memory: TaskMemory, observation: Observation) -> TaskMemory:
        """The memory after an observation."""
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
        if self.messages:
            memory.more.update(hear(self, memory, observation))
        return self.keep(memory, observation)

    def keep(self, memory: TaskMemory, observation: Observation) -> TaskMemory:
        """The memory with what the task keeps of the step."""
        return memory

    def others(self, memory: TaskMemory) -> Others:
        """What each agent knows of everybody."""
        return (remembered if self.messages else free)(self, memory)

    def parts(self, memory: TaskMemory) -> dict[str, Float32[Tensor, "B n F"]]:
        """All that agents see, by name."""
        return common(self, memory) | self.extras(memory)

    def extras(self, memory: TaskMemory) -> dict[str, Float32[Tensor, "B n F"]]:
        """What agents see beside the estimates, about −1 … 1."""
        return {}

    def allowed(self, memory: TaskMemory) -> Bool[Tensor, "B n C"]:
        """Which choices an agent has."""
        raise NotImplementedError

    def estimate(
        self, memory: TaskMemory, action: Float32[Tensor, "B n a"]
    ) -> tuple[TaskMemory, Float32[Tensor, "B N A"]]:
        return memory, memory.action

    def commands(self, memory: TaskMemory, action: Float32[Tensor, "B n a"]) -> Commands:
        """Velocities (accelerations) for the UAVs that act, 0 for the others."""
        still = action.new_zeros(len(action), self.believed.arena.n_uavs, self.dim)
        still[:, : self._n] = self.scale * action.clamp(-1.0, 1.0)
        return Commands(motion=still)

    def reference(self, memory: TaskMemory) -> Float32[Tensor, "B N d"]:
        return memory.position

    # ---------------------------------------------------------------- what is privileged

    def reward(self, memory: TaskMemory, world: World) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        memory, own = self.own_reward(memory, world)
        if self.chosen.credit == "team":
            own = own.mean(-1, keepdim=True).expand(-1, self._n)
        return memory, own

    @abstractmethod
    def own_reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        """Each UAV's own reward of the step that led here, whose mean is the team's."""

    def error(self, memory: TaskMemory, world: World) -> Float32[Tensor, "B N"]:
        """True error (m) of the estimates, at most 10 m; that also where they are not finite."""
        apart = memory.position - world.now.target
        return _cut((apart * apart).sum(-1).sqrt())

    def cost(self, memory: TaskMemory, world: World) -> Float32[Tensor, "B N"]:
        """What rewards count as the error (m): the true one, or the estimator's own σ; up to 10."""
        if self.chosen.reward == "sigma":
            return _cut(total_sigma(memory.joint))
        return self.error(memory, world)

    def known(self, memory: TaskMemory, world: World, within: float) -> Float32[Tensor, "B N"]:
        """1 where the true error is below ``within`` m, else 0; where rewards are the estimator's
        σ, how likely that is to it: 1 − exp(−within² / σ²), σ² all axes together (in the plane, of
        a circular Gaussian)."""
        if self.chosen.reward == "sigma":
            squared = total_sigma(memory.joint).clamp_min(1e-6) ** 2
            return 1 - (-(within**2) / squared).exp()
        return (self.error(memory, world) < within).to(torch.float32)

    def state(self, memory: TaskMemory, world: World) -> Float32[Tensor, "B S"]:
        """What a critic may know, within [−1, 1]: every UAV's true position in the arena, velocity
        / top speed, error / 10 m and log σ; the time; what the task adds."""
        truth = world.truth
        position = 2 * (world.now.target - self.low) / (self.high - self.low) - 1
        each = torch.cat(
            (
                position,
                truth.velocity.to(torch.float32) / self.v_max,
                (memory.position - world.now.target) / MOST_ERROR,
                log_sigmas(own_covariance(memory.joint)),
            ),
            -1,
        )
        time = 2 * memory.step[:, :1].to(torch.float32) / self.scenario.horizon - 1
        whole = torch.cat((each.flatten(1), time, *self.secrets(memory)), -1)
        return whole.nan_to_num(0.0).clamp(-1.0, 1.0)

    def state_bounds(self, scenario: Scenario) -> tuple[list[float], list[float]]:
        world = World(self.scenario, device=self.low.device)
        observation = world.reset(0)
        memory = self._estimated(self.reset(observation), observation)
        size = self.state(memory, world).shape[-1]
        return [-1.0] * size, [1.0] * size

    def secrets(self, memory: TaskMemory) -> list[Float32[Tensor, "B F"]]:
        """What the task adds to the state, about −1 … 1."""
        return []


def _cut(error: Float32[Tensor, "B N"]) -> Float32[Tensor, "B N"]:
    return torch.where(error.isfinite(), error, MOST_ERROR).clamp(max=MOST_ERROR)


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


def sensors(
    anchors: tuple[tuple[float, ...], ...],
    still: float,
    moving: float,
    radius: float | None,
    walls: tuple[Box, ...] = (),
    blind: int = 0,
    walk: float = 1.0,
) -> tuple[Sensor, ...]:
    """Displacements, ranges between UAVs and to anchors: what every task's team measures."""
    return (
        Displacement(still, moving, blind, walk),
        Ranging(NOISE),
        AnchorRanging(anchors, NOISE, radius=radius, walls=walls),
    )
