"""The swarm's motion: random target velocities, followed with a lag, between reflecting walls."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.boxes import assigned, reflected, rooms, walls
from coloc_env.motion.draws import fold_each, uav_keys, uniform
from coloc_env.motion.fit import inside, positive
from coloc_env.motion.frames import columns, unit, yaw_attitude

_FASTEST = 50.0


@dataclass(frozen=True)
class RandomVelocity(Motion):
    """Each UAV's velocity follows a target, speed uniform in [0, v_max], direction uniform.

    The target is redrawn in a step with probability dt / ``interval``; the velocity follows with
    a first-order lag, integrated exactly. With an infinite ``interval`` the first target is kept:
    straight lines at constant speed, but for the walls. Start positions are uniform in the arena;
    the velocity starts on its target. The x axis turns towards the horizontal velocity with the
    same lag, and slower at lower speed, so that it stays where it is at rest.

    Walls reflect by unfolding: the motion goes straight on through mirror images of the arena, and
    is folded back, which mirrors position, velocity, target and heading at once, however many walls
    a step meets. The carry is the unfolded state at the next step to be sampled.

    ``boxes``: each UAV flies in one of these instead of the whole arena, and is reflected at its
    walls; which one is drawn in proportion to their volumes.
    """

    v_max: float | None = None  # m/s; None: 50, in small rooms half the shortest side per lag
    interval: float = 10.0  # s, mean time between targets; inf: never another
    lag: float = 3.0  # s
    boxes: tuple[Box, ...] = ()

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "v_max", "lag")
        if not (arena.dt < self.lag and arena.dt < self.interval):
            raise ValueError(
                f"RandomVelocity: lag = {self.lag:g} s and interval = {self.interval:g} s must be "
                f"longer than the step of {arena.dt:g} s"
            )
        inside(self, "boxes", self.boxes, arena)
        own = uav_keys(keys, arena.n_uavs)
        spaces = rooms(self.boxes, arena)
        box = assigned(spaces, own)
        low, high = walls(spaces, box)
        velocity = self._targets(uniform(own, "motion.first_target", 3), arena)
        return {
            "keys": own,
            "box": box,
            "position": low + (high - low) * uniform(own, "motion.start", arena.dim),
            "velocity": velocity,
            "target": velocity.clone(),
            "ahead": torch.stack(unit(velocity[..., 0], velocity[..., 1]), -1),
        }

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        drawn = uniform(fold_each(carry["keys"], steps.unsqueeze(-1)), "motion.target", 4)
        renewed = drawn[..., 3:] < arena.dt / self.interval
        targets = self._targets(drawn, arena)
        position, velocity, target, ahead = (
            carry[name] for name in ("position", "velocity", "target", "ahead")
        )
        kept = math.exp(-arena.dt / self.lag)
        gain = arena.dt / self.lag / self._v_max(arena)
        path = []
        for k in range(steps.shape[1]):
            path.append((position, velocity, ahead))
            target = torch.where(renewed[:, k], targets[:, k], target)
            excess = velocity - target
            position = position + (arena.dt * target + self.lag * (1 - kept) * excess)
            velocity = target + kept * excess
            turned = ahead + gain * velocity[..., :2]  # never 0: the gain times v_max is below 1
            x, y = turned.unbind(-1)
            ahead = turned / (x * x + y * y).sqrt().unsqueeze(-1)
        spaces = rooms(self.boxes, arena)
        low, high = (wall.unsqueeze(-3) for wall in walls(spaces, carry["box"]))
        truth = _folded(low, high, *(torch.stack(each, 1) for each in zip(*path, strict=True)))
        state = {"position": position, "velocity": velocity, "target": target, "ahead": ahead}
        return truth, {"keys": carry["keys"], "box": carry["box"], **state}

    def _targets(self, u: Float64[Tensor, "*s n"], arena: Arena) -> Float64[Tensor, "*s d"]:
        """Target velocities from uniform numbers: speed, azimuth and, in 3-D, sine of elevation."""
        speed, azimuth = self._v_max(arena) * u[..., 0], 2 * math.pi * u[..., 1]
        cosine, sine = azimuth.cos(), azimuth.sin()
        if arena.dim == 2:
            return columns((speed * cosine, speed * sine), speed)
        up = 2 * u[..., 2] - 1
        level = speed * (1 - up * up).sqrt()
        return columns((level * cosine, level * sine, speed * up), speed)

    def _v_max(self, arena: Arena) -> float:
        spaces = (zip(room.low, room.high, strict=True) for room in rooms(self.boxes, arena))
        shortest = min(high - low for space in spaces for low, high in space)
        return min(_FASTEST, 0.5 * shortest / self.lag) if self.v_max is None else self.v_max


def _folded(
    low: Float64[Tensor, "R 1 N d"],
    high: Float64[Tensor, "R 1 N d"],
    position: Float64[Tensor, "R K N d"],
    velocity: Float64[Tensor, "R K N d"],
    ahead: Float64[Tensor, "R K N 2"],
) -> Kinematics:
    """Fold an unbounded path into its box: every second image of each axis is mirrored."""
    place, sense = reflected(low, high, position)
    x, y = (sense[..., :2] * ahead).unbind(-1)
    return Kinematics(place, sense * velocity, yaw_attitude(x, y, position.shape[-1]))
