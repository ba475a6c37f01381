"""A team that parts, passes a building on both sides, and meets again behind it."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.draws import uav_keys, uniform
from coloc_env.motion.fit import inside, only_3d, positive
from coloc_env.motion.frames import level_flight, unit
from coloc_env.motion.layers import layers
from coloc_env.motion.timing import alternating, cycles, minimum_jerk, seconds


@dataclass(frozen=True)
class Split(Motion):
    """Two sub-teams, the first half of the UAVs and the rest, fly along x past a building, one on
    each side, and back again, ``period`` s each way (minimum-jerk).

    They start together, ``approach`` m before the building, part on the way (minimum-jerk in x,
    over ``ramp`` m), are ``clearance`` m from its walls when they pass it, and meet behind it.
    Within its sub-team a UAV keeps its place along the track and beside it, up to a wobble, in a
    layer of its own. Drawn per world: which sub-team goes which side; per UAV: rate and phase of
    its wobble. The nose points along the track, on the way back to the rear. With the defaults and
    a building of 100 × 24 m UAVs stay below 5 m/s and 1.5 m/s².
    """

    building: Box  # m
    approach: float = 45.0  # m
    ramp: float = 30.0  # m
    clearance: float = 12.0  # m
    gap: float = 6.0  # from the building's middle to each sub-team, where they are together, m
    length: float = 12.0  # of a sub-team along its track, m
    wobble: float = 0.8  # m
    period: float = 100.0  # s
    height: tuple[float, float] = (6.0, 14.0)  # lowest and highest layer, m

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "approach", "ramp", "clearance", "gap", "length", "period")
        only_3d(self, arena)
        inside(self, "building", (self.building,), arena)
        inside(self, "approach", (self._space(),), arena)
        n, per_team = arena.n_uavs, (arena.n_uavs + 1) // 2
        number = torch.arange(n, device=keys.device)
        second, place = number >= per_team, number.remainder(per_team).to(torch.float32)
        toss = uniform(keys, "motion.split", 1) - 0.5
        drawn = uniform(uav_keys(keys, n), "motion.split.wobble", 4)
        return {
            "side": toss.sign() * torch.where(second, -1.0, 1.0),
            "along": (self.length * ((place + 0.5) / per_team - 0.5)).expand(len(keys), -1),
            "rate": 0.2 + 0.3 * drawn[..., :2],
            "phase": 2 * math.pi * drawn[..., 2:],
            "height": layers(self, keys, self.height, 0.0, arena),
        }

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        time = seconds(steps, arena.dt)
        leg, fraction = cycles(time / self.period)
        covered, pace = minimum_jerk(fraction)
        first, last = self._ends()
        forth = alternating(leg)
        middle = 0.5 * (first + last) + forth * (last - first) * (covered - 0.5)
        wave = carry["rate"].unsqueeze(1) * time.unsqueeze(-1) + carry["phase"].unsqueeze(1)
        sway = self.wobble * wave.sin()
        swaying = self.wobble * carry["rate"].unsqueeze(1) * wave.cos()
        x = middle + carry["along"].unsqueeze(1) + sway[..., 0]
        vx = forth * (last - first) / self.period * pace + swaying[..., 0]
        off, slope = self._track(x)
        side = carry["side"].unsqueeze(1)
        position = (
            x,
            self._line() + side * off + sway[..., 1],
            carry["height"].unsqueeze(1),
        )
        velocity = (vx, side * slope * vx + swaying[..., 1], 0.0)
        ahead = unit(torch.ones_like(x), side * slope)
        return level_flight(position, velocity, ahead, 3), carry

    def _track(
        self, x: Float64[Tensor, "R K N"]
    ) -> tuple[Float64[Tensor, "R K N"], Float64[Tensor, "R K N"]]:
        """Distance (m) of the track from the building's middle line at x, and its slope."""
        low, high = self.building[0][0], self.building[1][0]
        margin = self.length / 2 + self.wobble
        out, out_rate = minimum_jerk((x - (low - margin - self.ramp)) / self.ramp)
        back, back_rate = minimum_jerk((x - (high + margin)) / self.ramp)
        wide = self._widest() - self.gap
        return self.gap + wide * (out - back), wide / self.ramp * (out_rate - back_rate)

    def _widest(self) -> float:
        """The track's largest distance from the building's middle line (m)."""
        return 0.5 * (self.building[1][1] - self.building[0][1]) + self.clearance

    def _line(self) -> float:
        return 0.5 * (self.building[0][1] + self.building[1][1])

    def _ends(self) -> tuple[float, float]:
        """Where the team's middle turns round (m)."""
        return self.building[0][0] - self.approach, self.building[1][0] + self.approach

    def _space(self) -> Box:
        """The box that nobody leaves."""
        reach, side = 0.5 * self.length + self.wobble, self._widest() + self.wobble
        first, last = self._ends()
        low = (first - reach, self._line() - side, self.height[0])
        return low, (last + reach, self._line() + side, self.height[1])
