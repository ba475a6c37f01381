"""A circle in bursts."""

import math
from dataclasses import dataclass

from jaxtyping import Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.curves import circle
from coloc_env.motion.draws import phases
from coloc_env.motion.fit import altitude, at_most, half_extents, positive
from coloc_env.motion.timing import StopAndGoLaw, seconds


@dataclass(frozen=True)
class StopAndGo(Motion):
    """A circle about the arena's centre on which each UAV stops, in its own turn, and goes on.

    UAV i is 2π i / N ahead on the average, and i / N of a cycle in its stops. The yaw stays on the
    circle's tangent while it rests. Peak tangential acceleration 1.875 ``speed`` / ``ramp``.
    """

    speed: float = 0.5  # horizontal, m/s, while going
    radius: float | None = None  # m; None: half of what fits
    go: float = 6.0  # s at full speed
    stop: float = 3.0  # s at rest
    ramp: float = 1.0  # s from rest to speed and back
    height: float | None = None  # m; None: mid-room
    height_amplitude: float = 0.3  # m, once a turn
    margin: float = 0.5  # m kept from the walls

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "speed", "radius", "go", "stop", "ramp")
        widest = min(half_extents(self, arena, self.margin)[:2])
        at_most(self, "radius", self._radius(arena), widest, arena)
        altitude(self, arena, self.height, self.height_amplitude)
        return {"phase": phases(keys, arena.n_uavs, arena.n_uavs)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        law = StopAndGoLaw(self.go, self.ramp, self.stop)
        share = carry["phase"].unsqueeze(1)
        cycle, distance, pace, _ = law.at(seconds(steps, arena.dt) / law.period + share)
        radius = self._radius(arena)
        rate = self.speed / radius
        phase = rate * (law.travel * (cycle - share) + distance) + 2 * math.pi * share
        height = altitude(self, arena, self.height, self.height_amplitude)
        return circle(phase, rate * pace, radius, arena, height, self.height_amplitude), carry

    def _radius(self, arena: Arena) -> float:
        fitted = 0.5 * min(half_extents(self, arena, self.margin)[:2])
        return fitted if self.radius is None else self.radius
