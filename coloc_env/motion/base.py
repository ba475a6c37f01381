"""Where the truth's motion comes from: one seam for scripted, random and recorded motion.

A ``Motion`` gives position, velocity and attitude at any window of steps. Its carry holds what one
world drew at reset (and, for motions that integrate, their state at the next step to sample), as
tensors with a leading row dimension, so that rows can be reset alone.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Bool, Float64, Int64
from torch import Tensor

Carry = dict[str, Tensor]
Box = tuple[tuple[float, ...], tuple[float, ...]]  # lowest and highest corner, m


@dataclass(frozen=True)
class Kinematics:
    """True motion over a window: R worlds, K steps, N UAVs, d dimensions, float64.

    ``position`` in metres and ``velocity`` in m/s in the world frame; ``attitude`` is a unit
    quaternion wxyz, body to world (d = 3), or a heading in rad (d = 2). ``valid`` marks where a
    recording has truth to score against (None: everywhere), ``carried`` the steps at which a UAV
    was put somewhere else (None: never).
    """

    position: Float64[Tensor, "R K N d"]
    velocity: Float64[Tensor, "R K N d"]
    attitude: Float64[Tensor, "R K N a"]
    valid: Bool[Tensor, "R K N"] | None = None
    carried: Bool[Tensor, "R K N"] | None = None


@dataclass(frozen=True)
class Arena:
    """What a motion may know of its scenario: the box it flies in (m), team size and step (s).

    ``origin``: where the zero of all positions is in the frame that was recorded (m), for files;
    empty: there is no other frame. ``start``: the stamp of step 0, ns since 1970 or the recording's
    zero, for files.
    """

    dim: int
    n_uavs: int
    dt: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    origin: tuple[float, ...] = ()
    start: int = 0

    @property
    def centre(self) -> tuple[float, ...]:
        return tuple(0.5 * (a + b) for a, b in zip(self.low, self.high, strict=True))


class Motion(ABC):
    """Base of all motions: frozen dataclasses whose fields are the motion's settings.

    A ``steered`` one takes the team's command for the step k → k + 1: its carry holds it under
    ``command`` [R, N, d], of which no component beyond ±``largest`` has any effect.
    """

    steered: ClassVar[bool] = False

    @property
    def largest(self) -> float:
        """The largest component of a command that has any effect; 0 where nothing is steered."""
        return 0.0

    @abstractmethod
    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        """What R worlds draw at reset, from their row keys; every tensor has leading size R."""

    @abstractmethod
    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        """Truth at ``steps`` (consecutive along K, going on where the last call ended)."""
