"""Scenarios: what is true, and what the team believes, as separate frozen fields."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from typing import Any, ClassVar, Literal, TypeVar, get_args

from coloc_env.motion import Arena, Motion
from coloc_env.network import Links, Network
from coloc_env.options import Group, Metres, PositiveSpeed, Radians, Share, Uavs
from coloc_env.reference import SatelliteReference
from coloc_env.sensors import Sensor, Sight
from coloc_env.sensors.base import Layout, require

Reward = Literal["error", "squared", "team", "log_score"]
REWARDS: tuple[str, ...] = get_args(Reward)
PriorKind = Literal["gaussian", "uniform"]


@dataclass(frozen=True)
class Prior:
    """What each UAV knows about its own start.

    Gaussian about the truth with these standard deviations (m, m/s, rad), one draw per UAV and
    world; with ``kind="uniform"`` nothing of the position but that it lies in the arena, and with
    ``max_speed`` (m/s) nothing of the velocity but that each component lies within ± that.
    ``target_std``: of the positions of targets, in m (None: as of UAVs). ``yaw="uniform"``: nothing
    is known of the heading, and the mean attitude's is 0 (``attitude_std`` is that of roll and
    pitch).
    """

    position_std: float = 2.0
    velocity_std: float = 0.2
    attitude_std: float = 0.05
    kind: PriorKind = "gaussian"
    max_speed: float | None = None
    target_std: float | None = None
    yaw: PriorKind = "gaussian"

    def __post_init__(self) -> None:
        kinds = get_args(PriorKind)
        for name in ("kind", "yaw"):
            require(getattr(self, name) in kinds, self, name, f"one of {', '.join(kinds)}")
        for name in ("position_std", "velocity_std", "attitude_std"):
            require(getattr(self, name) >= 0, self, name, "a standard deviation ≥ 0")
        bounded = self.max_speed is None or (self.kind == "uniform" and 0 < self.max_speed < inf)
        require(bounded, self, "max_speed", "a speed > 0, with kind='uniform'")

    @property
    def velocity_spread(self) -> float:
        """Standard deviation (m/s) of the velocity about its prior mean."""
        return self.velocity_std if self.max_speed is None else self.max_speed / 3**0.5


@dataclass(frozen=True)
class PriorOptions(Group):
    """What each UAV knows of its start. ``prior=gaussian``: the truth give or take ``prior_std`` m
    per axis; ``uniform``: only that it is in the arena, and that no component of its velocity
    exceeds ``max_speed`` (none: its velocity, as in a Gaussian prior).
    """

    title: ClassVar[str] = "prior"

    prior: PriorKind = "gaussian"
    prior_std: Metres = 2.0
    max_speed: PositiveSpeed | None = None

    def at_start(self, velocity_std: float = 0.2, attitude_std: float = 0.05) -> Prior:
        """The prior; standard deviations in m/s and rad of what the options do not say."""
        speed = self.max_speed if self.prior == "uniform" else None
        return Prior(self.prior_std, velocity_std, attitude_std, self.prior, speed)


@dataclass(frozen=True)
class AttitudePriorOptions(PriorOptions):
    """Its attitude is known give or take ``prior_attitude_std`` rad per axis; with
    ``prior_yaw=uniform`` that is of roll and pitch, and its heading may be any.
    """

    title: ClassVar[str] = "prior"

    prior_attitude_std: Radians = 0.05
    prior_yaw: PriorKind = "gaussian"

    def with_attitude(self) -> Prior:
        """The prior, with what the options say of the attitude."""
        return replace(self.at_start(attitude_std=self.prior_attitude_std), yaw=self.prior_yaw)


@dataclass(frozen=True)
class TeamOptions(Group):
    """``n_uavs``: how many UAVs there are; each fails in an episode with probability
    ``failure_rate``, at any step. ``reward``: minus the position ``error``, its square
    (``squared``), the ``team``'s mean error, or the ``log_score`` of estimate and covariance.
    """

    title: ClassVar[str] = "team"

    n_uavs: Uavs = 6
    failure_rate: Share = 0.0
    reward: Reward = "error"


@dataclass(frozen=True)
class Inertial:
    """Strapdown integration of the IMU; bias standard deviations > 0 make the biases states.

    ``accel_walk`` (m/s² per √s) and ``gyro_walk`` (rad/s per √s): random walk of the biases.
    """

    accel_bias: float = 0.0
    gyro_bias: float = 0.0
    accel_walk: float = 0.0
    gyro_walk: float = 0.0


@dataclass(frozen=True)
class Wheeled:
    """Dead reckoning in the plane from odometry."""


@dataclass(frozen=True)
class ConstantVelocity:
    """Velocity driven by white acceleration (``accel_std``, m/s² over one second's square root)
    and pulled to zero with time constant ``damping`` s (None: not at all).

    ``held``: the acceleration stays the same over each step instead, N(0, accel_std²) m/s².
    """

    accel_std: float = 1.0
    damping: float | None = None
    held: bool = False

    def __post_init__(self) -> None:
        require(self.accel_std >= 0, self, "accel_std", "a standard deviation ≥ 0")
        require(self.damping is None or self.damping > 0, self, "damping", "a time in s > 0")
        require(not self.held or self.damping is None, self, "held", "without damping")


@dataclass(frozen=True)
class InsDriven:
    """Dead reckoning with the velocity that the INS measures.

    Its error counts as white, of variance ``std² + bias_share · bias²`` per axis (m²/s², std and
    bias those of the believed ``Ins``): a bias that lasts adds up faster than white noise of the
    same size does.
    """

    bias_share: float = 2.0

    def __post_init__(self) -> None:
        require(0 <= self.bias_share < inf, self, "bias_share", "a number ≥ 0")


@dataclass(frozen=True)
class DisplacementDriven:
    """Dead reckoning with the displacements that odometry measures."""


Process = Inertial | Wheeled | ConstantVelocity | InsDriven | DisplacementDriven
S = TypeVar("S", bound=Sensor)


@dataclass(frozen=True)
class Believed:
    """All that localizers may know: geometry, time step, motion and noise models, never the truth.

    Positions of landmarks and anchors come in the observation's map leaves. ``largest_command``:
    where motion is steered, the largest component of a command (m/s or m/s²) that has any effect.
    ``links``: who exchanges with whom (see ``Network``).
    """

    arena: Arena
    slots: int
    process: Process
    sensors: tuple[Sensor, ...]
    prior: Prior
    message_delay: int = 0
    largest_command: float = 0.0
    links: Links = "all"

    def sensor(self, kind: type[S]) -> S | None:
        """The believed model of a sensor type, or None if the team has no such sensor."""
        return next((s for s in self.sensors if isinstance(s, kind)), None)


@dataclass(frozen=True, eq=False)
class Scenario:
    """One task: a world to simulate (or replay) and what its team believes.

    ``failure_rate``: probability that a UAV fails, at a uniformly drawn step, during an episode;
    ``failures``: ((uav, step), …) for failures at given steps. ``reward``: one of ``REWARDS``.
    ``anchor_uavs``: the first so many UAVs know where they are and are not scored. ``reference``:
    what is to be reported beside the truth as if it were the truth (None: nothing). ``targets``:
    the last so many UAVs are passive: others range to them, they range neither anchors nor each
    other. ``strangers``: the first so many UAVs do not range each other. ``tuned_on``: sequences of
    recordings on which constants of the scenario were chosen, so that no score on them is one on
    data unseen.
    """

    name: str
    arena: Arena
    horizon: int
    motion: Motion
    sensors: tuple[Sensor, ...]
    network: Network
    prior: Prior
    process: Process
    believed_sensors: tuple[Sensor, ...]
    believed_prior: Prior | None = None
    failure_rate: float = 0.0
    failures: tuple[tuple[int, int], ...] = ()
    reward: Reward = "error"
    anchor_uavs: int = 0
    reference: SatelliteReference | None = None
    targets: int = 0
    strangers: int = 0
    tuned_on: tuple[str, ...] = ()
    overrides: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require(self.horizon >= 1, self, "horizon", "at least one step")
        require(self.arena.n_uavs >= 1, self.arena, "n_uavs", "at least one UAV")
        require(self.reward in REWARDS, self, "reward", f"one of {', '.join(REWARDS)}")
        require(0 <= self.failure_rate <= 1, self, "failure_rate", "a probability in [0, 1]")
        known = all(0 <= uav < self.arena.n_uavs and step >= 1 for uav, step in self.failures)
        require(known, self, "failures", "((uav index, step ≥ 1), …)")
        fewer = 0 <= self.anchor_uavs < self.arena.n_uavs
        require(fewer, self, "anchor_uavs", f"from 0 to fewer than the {self.arena.n_uavs} UAVs")
        fewer = 0 <= self.targets < self.arena.n_uavs
        require(fewer, self, "targets", f"from 0 to fewer than the {self.arena.n_uavs} UAVs")
        free = self.network.links == "all" or self.network.dense(self.arena.n_uavs)
        require(free, self.network, "links", "in teams with a slot for every UAV")

    @cached_property
    def layout(self) -> Layout:
        """What fixes the widths of observation leaves."""
        return Layout(self.arena, self.network.slots(self.arena.n_uavs))

    @cached_property
    def sight(self) -> Sight:
        """What stands in the way of the sensors' signals; nothing where no sensor minds."""
        found = (getattr(sensor, "sight", None) for sensor in self.sensors)
        return next((sight for sight in found if sight is not None), Sight())

    @property
    def commanded(self) -> bool:
        """Whether the world takes commands: its steps can then not be sensed ahead."""
        return self.motion.steered or self.network.links != "all"

    @cached_property
    def believed(self) -> Believed:
        """What localizers are built from."""
        return Believed(
            arena=self.arena,
            slots=self.layout.slots,
            process=self.process,
            sensors=self.believed_sensors,
            prior=self.believed_prior or self.prior,
            message_delay=self.network.delay,
            largest_command=self.motion.largest,
            links=self.network.links,
        )

    @property
    def agents(self) -> list[str]:
        """Agent ids, ``uav_0`` first."""
        return [f"uav_{i}" for i in range(self.arena.n_uavs)]
