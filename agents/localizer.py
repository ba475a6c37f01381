"""The Localizer protocol and its estimates."""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import ClassVar, Generic, Self, TypeVar

import torch
from jaxtyping import Bool, Float, Float32
from tensordict import TensorClass
from torch import Tensor

from agents.models.measurements import MODELS
from agents.models.process import Process, drives, make_process
from agents.parts import move
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import Sensor, UnlabelledLandmarks

_HUGE = 1e30  # m; what lies beyond counts as infinite


class Estimate(TensorClass):
    """Each UAV's estimate of its own state at the step observed; world frame, batch (B, N).

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


def finite_action(
    estimate: Estimate, before: Float32[Tensor, "B N A"]
) -> tuple[Float32[Tensor, "B N A"], Bool[Tensor, "B N"]]:
    """The action, the one before where numbers are not finite, and where they are."""
    action = estimate.action()
    finite = (action.abs() < _HUGE).all(-1) & estimate.covariance.isfinite().all(-1).all(-1)
    return torch.where(finite.unsqueeze(-1), action, before), finite


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
    associates: ClassVar[bool] = False
    """Whether it finds out which landmark is seen where measurements do not say."""
    serves: ClassVar[tuple[type[Sensor], ...] | None] = None
    """Sensors that it makes use of, beside what drives the motion model; None: every sensor that
    has a measurement model."""

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

    def to(self, device: str | torch.device) -> Self:
        """Move networks and constants to a device, in place; beliefs and observations decide where
        everything else is computed."""
        move(self, device)
        return self

    @classmethod
    def ignores(cls, believed: Believed) -> list[str]:
        """Sensors of a team whose measurements the localizer would ignore."""
        served = tuple(MODELS) if cls.serves is None else cls.serves
        return [
            type(sensor).__name__
            for sensor in believed.sensors
            if sensor.informs
            and not drives(believed, sensor)
            and not (isinstance(sensor, served) and cls._names(sensor))
        ]

    @classmethod
    def _names(cls, sensor: Sensor) -> bool:
        """Whether it knows, or finds out, what a sensor saw."""
        return cls.associates or not isinstance(sensor, UnlabelledLandmarks)

    @property
    def exchanges(self) -> bool:
        """Whether UAVs look at what linked neighbours measured, which messages do not carry: one
        localizer must then act for the whole team."""
        return False

    def mean(self, belief: Belief) -> Float[Tensor, "B N S"]:
        """The mean state of a belief, as ``agents.models.process`` lays states out."""
        raise ValueError(f"{self.name} has no mean state")

    def attitude(self, belief: Belief) -> Float[Tensor, "B N a"] | None:
        """The attitudes of a belief's mean state (quaternion wxyz, body to world, or heading in
        rad); None where they are not estimated."""
        try:
            motion = self._motion
            return motion.attitude(self.mean(belief)) if motion.attitude_size else None
        except ValueError:
            return None

    @cached_property
    def _motion(self) -> Process:
        """The believed motion model, which lays mean states out."""
        return make_process(self.believed)

    def shifted(self, belief: Belief, offset: Float[Tensor, "B N d"]) -> Belief:
        """The belief with its position shifted by ``offset`` (m), as sure of it as before."""
        raise ValueError(f"{self.name} cannot be corrected from outside")

    def advance(self, belief: Belief, observation: Observation) -> Belief:
        """The belief that ``step`` returns, without the estimate: cheaper where it can be."""
        return self.step(belief, observation)[0]

    def gaussian(
        self, belief: Belief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        """Mean state and error covariance (float64) after the observation was used."""
        raise ValueError(f"{self.name} gives no Gaussian to restart another filter from")

    def restart_from(
        self,
        belief: Belief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> Belief:
        """The belief with the UAVs marked in ``rows`` restarted from a Gaussian, which has taken
        the last observation into account."""
        raise ValueError(f"{self.name} cannot be restarted from outside")

    def team(self, belief: Belief) -> Float[Tensor, "B N N P"] | None:
        """Each UAV's estimate of everybody's pose relative to UAV 0's (position in m, quaternion or
        heading in rad), where a method estimates that."""
        return None

    def diagnostics(self, belief: Belief) -> dict[str, Float[Tensor, "B N"]]:
        """A method's own figures at this step (particles, effective sample size, …)."""
        return {}
