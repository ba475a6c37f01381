"""The Localizer protocol, its estimates, and the registry of localizers by name."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Generic, TypeVar

import torch
from jaxtyping import Bool, Float
from tensordict import TensorClass
from torch import Tensor

from coloc_env import options
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, Scenario


class Estimate(TensorClass):
    """What each UAV says of its own state at the step observed; world frame, batch (B, N).

    ``position`` (m), ``velocity`` (m/s), ``covariance`` of the position (m²).
    """

    position: Float[Tensor, "B N d"]
    velocity: Float[Tensor, "B N d"]
    covariance: Float[Tensor, "B N d d"]

    def action(self) -> Float[Tensor, "B N A"]:
        """The environment's action ``[position, velocity, log-std]``, float32."""
        variance = self.covariance.diagonal(dim1=-2, dim2=-1)
        log_std = 0.5 * variance.clamp_min(1e-12).log()
        return torch.cat((self.position, self.velocity, log_std), -1).to(torch.float32)


Belief = TypeVar("Belief")


class Localizer(ABC, Generic[Belief]):
    """An estimator as pure functions of belief and observation, for all UAVs of all worlds.

    A belief is a tensorclass of batch (B, N) that holds all there is, the key of the UAV's own
    random numbers and its step count included; the localizer itself holds settings only. UAV i's
    part of a belief is computed from UAV i's observation and belief alone, or from what its
    ``links`` let through (``centralized`` localizers, which are references, aside).
    """

    name: ClassVar[str]
    centralized: ClassVar[bool] = False

    def __init__(self, believed: Believed) -> None:
        self.believed = believed

    @abstractmethod
    def reset(self, observation: Observation) -> Belief:
        """The belief before the first observation is used: the prior that it carries."""

    @abstractmethod
    def step(self, belief: Belief, observation: Observation) -> tuple[Belief, Estimate]:
        """Predict to the observation's step (the first time: not at all), then use it.

        Pure: neither argument is written to.
        """

    @property
    def exchanges(self) -> bool:
        """Whether UAVs look at what linked neighbours measured, which messages do not carry: one
        localizer must then act for the whole team."""
        return False

    def mean(self, belief: Belief) -> Float[Tensor, "B N S"]:
        """The mean state of a belief, as ``agents.models.process`` lays states out."""
        raise ValueError(f"{self.name} has no mean state")

    def moved(self, belief: Belief, offset: Float[Tensor, "B N d"]) -> Belief:
        """The belief with its position shifted by ``offset`` (m), as sure of it as before."""
        raise ValueError(f"{self.name} cannot be corrected from outside")

    def watch(self, belief: Belief, observation: Observation) -> Belief:
        """``step`` for one whose estimate is not asked for: cheaper where it can be."""
        return self.step(belief, observation)[0]

    def gaussian(
        self, belief: Belief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        """Mean state and error covariance (float64) after the observation was used or watched."""
        raise ValueError(f"{self.name} gives no Gaussian to restart another filter from")

    def restarted(
        self,
        belief: Belief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> Belief:
        """The belief with the UAVs marked in ``rows`` begun anew from a Gaussian, which has taken
        the last observation into account."""
        raise ValueError(f"{self.name} cannot be restarted from outside")

    def team(self, belief: Belief) -> Float[Tensor, "B N N P"] | None:
        """What each UAV says of everybody's pose relative to UAV 0's (position in m, quaternion or
        heading in rad), where a method estimates that."""
        return None

    def diagnostics(self, belief: Belief) -> dict[str, Float[Tensor, "B N"]]:
        """A method's own figures at this step (particles, effective sample size, …)."""
        return {}


Factory = Callable[..., Localizer]
LOCALIZERS: dict[str, Factory] = {}
_SUITED: dict[str, Factory] = {}
_L = TypeVar("_L", bound=Factory)


def register(name: str, suited: Callable[[Factory], Factory] | None = None) -> Callable[[_L], _L]:
    """Register a localizer: a callable of ``believed`` and keyword-only options. ``suited`` makes
    of it one that builds what fits the team."""

    def add(factory: _L) -> _L:
        LOCALIZERS[name] = factory
        if suited is not None:
            _SUITED[name] = suited(factory)
        return factory

    return add


def options_of(name: str) -> dict[str, inspect.Parameter]:
    """Option names of a localizer with their types and defaults."""
    options.require_known("agent", [name], sorted(LOCALIZERS))
    return options.parameters(LOCALIZERS[name])


def make(name: str, scenario: Scenario | Believed, **chosen: Any) -> Localizer:
    """Build a localizer for what the scenario's team believes (or for those beliefs).

    ``name`` may carry options as on the command line (``"ekf:robust=huber"``). Raises ValueError,
    in one line that names what is allowed, for an unknown name or option.
    """
    name, *texts = name.split(":")
    known = options_of(name)
    for text in texts:
        key, value = options.parse(name, text, known)
        if key in chosen:
            raise ValueError(f"{name}: {key} is given twice")
        chosen[key] = value
    options.check(name, chosen, known)
    believed = scenario if isinstance(scenario, Believed) else scenario.believed
    try:
        return _SUITED.get(name, LOCALIZERS[name])(believed, **chosen)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(name) else f"{name}: {text}") from error
