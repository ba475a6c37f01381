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
from coloc_env.motion.obstacles import stopped
from coloc_env.options import Group, Metres, Quantity

Control = Literal["velocity", "acceleration"]
PositiveAcceleration = Annotated[float, Quantity("m/s²", above=0.0)]
Jerk = Annotated[float, Quantity("m/s³", above=0.0)]


@dataclass(frozen=True)
class Steered(Motion):
    """Each UAV moves as it is commanded: over the step k → k + 1 its acceleration is constant,

        p' = p + ½ (v + v') dt,    v' = v + a dt,    |a| ≤ a_max,    |v'| ≤ v_max,

    with a = (c − v) / dt for a command c of velocity (m/s), and a = c for one of acceleration
    (m/s²), each cut to its limit; with ``j_max`` (m/s³), a changes by at most j_max dt a step. At
    the arena's edges, and at ``walls``, solid boxes (m), a UAV stops: the part of its velocity that
    points there becomes 0. The x axis of its body points along its horizontal velocity, and stays
    where it is at rest. At step 0 UAVs are at rest, uniform in the ``start`` box (m; None: the
    arena).

    UAVs that are to ``keep_apart`` (m; 0: no matter) brake in time: towards another UAV each goes
    no faster than it can still stop in half of what is between them beyond that distance.

    The carry holds position, velocity, change of velocity and direction at the last step sampled,
    and the command that goes on to hold until another is given; the first is 0.
    """

    steered: ClassVar[bool] = True

    control: Control = "velocity"
    v_max: float = 3.0  # m/s
    a_max: float = 1.5  # m/s²
    start_box: Box | None = None  # m
    walls: tuple[Box, ...] = ()  # m
    j_max: float | None = None  # m/s³
    keep_apart: float = 0.0  # m

    @property
    def largest(self) -> float:
        """The largest component of a command that has any effect (m/s or m/s²)."""
        return self.v_max if self.control == "velocity" else self.a_max

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "v_max", "a_max", "j_max")
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
        none = {name: still.clone() for name in ("velocity", "change", "command")}
        return {"position": position, "ahead": ahead, **none}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        position, velocity, ahead = carry["position"], carry["velocity"], carry["ahead"]
        change = carry["change"]
        low, high = (position.new_tensor(x) for x in (arena.low, arena.high))
        path = []
        for step in steps.unbind(1):
            moves = (step > 0)[:, None, None]
            faster = self._velocity(velocity, carry["command"], change, arena.dt)
            if self.keep_apart:
                slower = self._apart(position, velocity, faster, arena.dt)
                faster = velocity + within(slower - velocity, self.a_max * arena.dt)
            free = position + 0.5 * arena.dt * (velocity + faster)
            place = torch.minimum(torch.maximum(free, low), high)
            if self.walls:
                place = stopped(position, place, self.walls)
            changed = torch.where(place == free, faster - velocity, 0.0)  # without what walls take
            faster = torch.where(place == free, faster, 0.0)
            x, y = unit(faster[..., 0], faster[..., 1])
            turned = torch.stack((x, y), -1)
            moving = (faster[..., :2] != 0).any(-1, keepdim=True)
            position = torch.where(moves, place, position)
            change = torch.where(moves, changed, change)
            velocity = torch.where(moves, faster, velocity)
            ahead = torch.where(moves & moving, turned, ahead)
            path.append((position, velocity, ahead))
        places, speeds, noses = (torch.stack(each, 1) for each in zip(*path, strict=True))
        attitude = yaw_attitude(noses[..., 0], noses[..., 1], arena.dim)
        state = {"position": position, "velocity": velocity, "change": change, "ahead": ahead}
        return Kinematics(places, speeds, attitude), {**state, "command": carry["command"]}

    def _velocity(
        self,
        velocity: Float64[Tensor, "R N d"],
        command: Float64[Tensor, "R N d"],
        before: Float64[Tensor, "R N d"],
        dt: float,
    ) -> Float64[Tensor, "R N d"]:
        """v' within the limits, ``before`` being the last change of velocity."""
        if self.control == "velocity":
            change = within(command, self.v_max) - velocity
        else:
            change = command * dt
        change = within(change, self.a_max * dt)
        if self.j_max is not None:
            change = before + within(change - before, self.j_max * dt**2)
        return within(velocity + change, self.v_max)

    def _apart(
        self,
        position: Float64[Tensor, "R N d"],
        velocity: Float64[Tensor, "R N d"],
        faster: Float64[Tensor, "R N d"],
        dt: float,
    ) -> Float64[Tensor, "R N d"]:
        """v' cut so that each UAV can stop before it is ``keep_apart`` from another.

        Towards another at a distance D with gap g = D − keep_apart, the way of this step and that
        of stopping must fit into half of it: ½ (v + v') dt + ½ v' dt + v'² / 2a ≤ ½ g.
        """
        for j in range(position.shape[1]):
            apart = position[:, j : j + 1] - position
            distance = apart.norm(dim=-1, keepdim=True)
            way = apart / distance.clamp_min(1e-9)
            room = distance - self.keep_apart - dt * (velocity * way).sum(-1, keepdim=True)
            most = self.a_max * ((dt**2 + room.clamp_min(0.0) / self.a_max).sqrt() - dt)
            excess = ((faster * way).sum(-1, keepdim=True) - most).clamp_min(0.0)
            faster = faster - excess * way
        return faster


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
    ``acceleration``: the team's commands, up to ``v_max`` and ``a_max``, accelerations changing by
    up to ``j_max`` (none: at once). UAVs brake so as not to come within ``keep_apart`` of each
    other (0: they do not care); walls stop them."""

    title: ClassVar[str] = "control"

    control: Literal["none", "velocity", "acceleration"] = "none"
    a_max: PositiveAcceleration = 1.5
    j_max: Jerk | None = None
    keep_apart: Metres = 0.0

    def of(self, motion: Motion, v_max: float, walls: tuple[Box, ...] = ()) -> Motion:
        """The motion, or one that is steered, from a start anywhere in the arena."""
        if self.control == "none":
            return motion
        if isinstance(motion, Kidnapped):
            raise ValueError(f"control={self.control} is not allowed with kidnap_at")
        return Steered(
            self.control,
            v_max,
            self.a_max,
            walls=walls,
            j_max=self.j_max,
            keep_apart=self.keep_apart,
        )
