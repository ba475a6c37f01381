"""Manoeuvres of a formation over an open court: a figure of eight, then a breathing circle."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import phases, uav_keys, uniform
from coloc_env.motion.fit import at_most, interval, only_3d, positive
from coloc_env.motion.frames import level_flight
from coloc_env.motion.layers import layers
from coloc_env.motion.timing import cycles, minimum_jerk, seconds


@dataclass(frozen=True)
class Court(Motion):
    """A ring of UAVs that turns at a constant rate; its centre flies a figure of eight (Gerono's
    lemniscate), then stays while the ring expands and contracts twice, and so on in turn.

    Each manoeuvre takes ``period`` s along a minimum-jerk law, so all is smooth where one follows
    the other. UAVs fly in layers, swinging up and down. Drawn per world: the figure's direction,
    the ring's phase and sense, how layers are dealt out; per UAV: the phase of its swing. The yaw
    is along the ring's tangent. With the defaults ten UAVs stay below 8.5 m/s and 2.5 m/s².
    """

    centre: tuple[float, float]  # m
    half_length: float = 25.0  # of the figure of eight, m
    radius: tuple[float, float] = (8.0, 24.0)  # of the ring, smallest and largest, m
    rate: float = 0.12  # rad/s, at which it turns
    period: float = 60.0  # s
    height: tuple[float, float] = (6.0, 14.0)  # lowest and highest layer, m
    swing: float = 1.0  # m up and down

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "half_length", "rate", "period")
        only_3d(self, arena)
        small, large = interval(self, "radius")
        for axis, middle in enumerate(self.centre):
            room = min(middle - arena.low[axis], arena.high[axis] - middle)
            at_most(self, "radius[1]", large, room, arena)
            at_most(self, "half_length", self.half_length, room - small, arena)
        u = uniform(keys, "motion.court", 3)
        own = uniform(uav_keys(keys, arena.n_uavs), "motion.court.swing", 1)[..., 0]
        turn = 2 * math.pi * u[:, :2]
        return {
            "heading": torch.stack((turn[:, 0].cos(), turn[:, 0].sin()), -1),
            "phase": turn[:, 1:] + 2 * math.pi * phases(keys, arena.n_uavs, arena.n_uavs),
            "sense": (u[:, 2:] - 0.5).sign(),
            "height": layers(self, keys, self.height, self.swing, arena),
            "swing": 2 * math.pi * own,
        }

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        time = seconds(steps, arena.dt)
        share = 2 * cycles(time / (2 * self.period))[1]
        (cx, cy), (cvx, cvy) = self._centre(share, carry["heading"])
        radius, spread = self._radius(share - 1)
        sense = carry["sense"].unsqueeze(1)
        angle = carry["phase"].unsqueeze(1) + sense * self.rate * time
        cosine, sine, around = angle.cos(), angle.sin(), sense * self.rate * radius
        lift = 2 * math.pi * 3 / self.period  # the swing's rate, rad/s
        rise = lift * time + carry["swing"].unsqueeze(1)
        position = (
            cx + radius * cosine,
            cy + radius * sine,
            carry["height"].unsqueeze(1) + self.swing * rise.sin(),
        )
        velocity = (
            cvx + spread * cosine - around * sine,
            cvy + spread * sine + around * cosine,
            lift * self.swing * rise.cos(),
        )
        return level_flight(position, velocity, (-sense * sine, sense * cosine), 3), carry

    def _centre(
        self, share: Tensor, heading: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Place and velocity of the ring's centre, a share of the figure of eight on."""
        turns, rate = minimum_jerk(share)
        angle, rate = 2 * math.pi * turns, 2 * math.pi / self.period * rate
        cosine, sine = angle.cos(), angle.sin()
        along, across = self.half_length * sine, self.half_length * sine * cosine
        ahead = self.half_length * rate * cosine
        aside = self.half_length * rate * (1 - 2 * sine * sine)
        x, y = heading[:, None, :1], heading[:, None, 1:]
        middle = self.centre[0] + x * along - y * across, self.centre[1] + y * along + x * across
        return middle, (x * ahead - y * aside, y * ahead + x * aside)

    def _radius(self, share: Tensor) -> tuple[Tensor, Tensor]:
        """Radius of the ring (m) and its rate (m/s), a share of its two breaths on."""
        breaths, rate = minimum_jerk(share)
        angle, (small, large) = 4 * math.pi * breaths, self.radius
        half = 0.5 * (large - small)
        change = 4 * math.pi / self.period * half * rate * angle.sin()
        return small + half * (1 - angle.cos()), change
