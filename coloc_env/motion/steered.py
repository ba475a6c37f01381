"""Steered motion: UAVs that follow their team's commands, within limits and walls."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, get_args

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.draws import points, uav_keys
from coloc_env.motion.fit import inside, positive
from coloc_env.motion.frames import unit, yaw_attitude
from coloc_env.motion.kidnapped import Kidnapped
from coloc_env.options import Group, Quantity

Control = Literal["velocity", "acceleration"]
PositiveAcceleration = Annotated[float, Quantity("m/s²", above=0.0)]


@dataclass(frozen=True)
class Steered(Motion):
    """Each UAV moves as it is commanded: over the step k → k + 1 its acceleration is constant,

        p' = p + ½ (v + v') dt,    v' = v + a dt,    |a| ≤ a_max,    |v'| ≤ v_max,

    with a = (c − v) / dt for a command c of velocity (m/s), and a = c for one of acceleration
    (m/s²), each cut to its limit. At a wall of the arena a UAV stops: the part of its velocity that
    points there becomes 0. The x axis of its body points along its horizontal velocity, and stays
    where it is at rest. At step 0 UAVs are at rest, uniform in the ``start`` box (m; None: the
    arena).

    The carry holds position, velocity and direction at the last step sampled, and the command that
    goes on to hold until another is given; the first is 0.
    """

    steered: ClassVar[bool] = True

    control: Control = "velocity"
    v_max: float = 3.0  # m/s
    a_max: float = 1.5  # m/s²
    start_box: Box | None = None  # m

    @property
    def largest(self) -> float:
        """The largest component of a command that has any effect (m/s or m/s²)."""
        return self.v_max if self.control == "velocity" else self.a_max

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "v_max", "a_max")
        if self.control not in get_args(Control):
            raise ValueError(
                f"Steered: control={self.control!r} is not allowed: velocity, acceleration"
            )
        low, high = self.start_box or (arena.low, arena.high)
        inside(self, "start_box", ((low, high),), arena)
        position = points(uav_keys(keys, arena.n_uavs), "motion.steered", low, high)
        still = torch.zeros_like(position)
        ahead = still[..., :2].clone()
        ahead[..., 0] = 1.0
        return {"position": position, "velocity": still, "ahead": ahead, "command": still.clone()}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        position, velocity, ahead = carry["position"], carry["velocity"], carry["ahead"]
        low, high = (position.new_tensor(x) for x in (arena.low, arena.high))
        path = []
        for step in steps.unbind(1):
            moves = (step > 0)[:, None, None]
            faster = self._velocity(velocity, carry["command"], arena.dt)
            free = position + 0.5 * arena.dt * (velocity + faster)
            place = torch.minimum(torch.maximum(free, low), high)
            faster = torch.where(place == free, faster, 0.0)
            x, y = unit(faster[..., 0], faster[..., 1])
            turned = torch.stack((x, y), -1)
            moving = (faster[..., :2] != 0).any(-1, keepdim=True)
            position = torch.where(moves, place, position)
            velocity = torch.where(moves, faster, velocity)
            ahead = torch.where(moves & moving, turned, ahead)
            path.append((position, velocity, ahead))
        places, speeds, noses = (torch.stack(each, 1) for each in zip(*path, strict=True))
        attitude = yaw_attitude(noses[..., 0], noses[..., 1], arena.dim)
        state = {"position": position, "velocity": velocity, "ahead": ahead}
        return Kinematics(places, speeds, attitude), {**state, "command": carry["command"]}

    def _velocity(
        self, velocity: Float64[Tensor, "R N d"], command: Float64[Tensor, "R N d"], dt: float
    ) -> Float64[Tensor, "R N d"]:
        """v' within the limits."""
        if self.control == "velocity":
            change = within(command, self.v_max) - velocity
        else:
            change = command * dt
        return within(velocity + within(change, self.a_max * dt), self.v_max)


def within(vector: Float64[Tensor, "*s d"], most: float) -> Float64[Tensor, "*s d"]:
    """A vector, shortened to the length ``most`` if it is longer."""
    squared = vector[..., 0] * vector[..., 0]
    for part in vector.unbind(-1)[1:]:
        squared = squared + part * part
    length = squared.sqrt()
    return vector * torch.where(length > most, most / length.clamp_min(1e-300), 1.0).unsqueeze(-1)


@dataclass(frozen=True)
class ControlOptions(Group):
    """``control``: what steers the UAVs. ``none``: the scenario's own motion; ``velocity``,
    ``acceleration``: the team's commands, up to ``v_max`` and ``a_max``."""

    title: ClassVar[str] = "control"

    control: Literal["none", "velocity", "acceleration"] = "none"
    a_max: PositiveAcceleration = 1.5

    def of(self, motion: Motion, v_max: float) -> Motion:
        """The motion, or one that is steered, from a start anywhere in the arena."""
        if self.control == "none":
            return motion
        if isinstance(motion, Kidnapped):
            raise ValueError(f"control={self.control} is not allowed with kidnap_at")
        return Steered(self.control, v_max, self.a_max)
