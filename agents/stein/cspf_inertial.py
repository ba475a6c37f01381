"""The collaborative Stein particle filter of a team that moves by its IMUs (CSPF paper, Algorithm 1
with equations 28 and 29 for every UAV)."""

import math
from typing import Any

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from agents.particle.belief import normal
from agents.stein import inertial_window as windows
from agents.stein.cspf import SteinBelief, SteinFilter
from agents.stein.estimate import Manifold
from agents.stein.galilean import Galilean, RelativeStates, imu_increments, propagate
from agents.stein.inertial_target import InertialTarget, inertial_target
from agents.stein.inertial_window import InertialNoise, InertialWindow
from agents.stein.likelihood import Scale
from agents.stein.match_window import Matches, MatchWindow
from agents.stein.odometry import Motion
from coloc_env.geometry import unrotate
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, Inertial
from coloc_env.sensors import Imu, RelativePose, Sensor

_NUMBERS = 10  # of an increment, and of a state
_BYTES = 4  # of a number
_WIDE = 4.0  # times the noise of matches: see ``_targets``


class InertialSteinFilter(SteinFilter):
    """``cspf`` with IMUs in place of odometry; options as it has them, but ``variant``.

    A particle holds each UAV's pose *and velocity* relative to UAV 0 (``galilean``). Every UAV
    pre-integrates its IMU and sends the increments; holders move all particles by them. A match in
    the window says something of velocities, too, the more the older it is. What is left of the
    IMUs' biases is noise, not a state.
    """

    serves = (RelativePose, Imu)
    moved_by = Imu

    def __init__(self, believed: Believed, **options: Any) -> None:
        super().__init__(believed, **options)
        if self.across or self.literal:
            raise ValueError("variant is not allowed in a team with IMUs: only settled")
        imu, motion = believed.sensor(Imu), believed.process
        assert imu is not None
        assert isinstance(motion, Inertial)
        self.group, self.states = Galilean, Manifold(RelativeStates.plus, RelativeStates.minus)
        self.noise = InertialNoise(
            (self.matches.std, self.matches.turn_std),
            *(imu.accel_std, imu.gyro_std, motion.accel_bias, motion.gyro_bias),
            believed.arena.dt,
        )
        self.velocity_std = math.sqrt(2) * believed.prior.velocity_spread

    def diagnostics(self, belief: SteinBelief) -> dict[str, Float[Tensor, "B N"]]:
        """``bytes`` that each UAV sends in a step, float32 numbers: its increments once, and its
        dual variables of everybody over each of its edges in each iteration."""
        edges = belief.started.sum(-1) * self.iterations * belief.step.shape[1]
        sent = _BYTES * _NUMBERS * (1 + edges * self.consensus)
        return super().diagnostics(belief) | {"bytes": sent.to(torch.float32)}

    def _noise_of(self, sensor: Sensor) -> list[float]:
        assert isinstance(sensor, Imu)
        return [sensor.accel_std] * 3 + [sensor.gyro_std] * 3

    def _nothing(self, shape: torch.Size, like: Tensor) -> InertialWindow:
        return windows.empty(shape, self.window, like)

    def _initial_particles(
        self, key: Int64[Tensor, "B H"], origin: Float64[Tensor, "B H P"]
    ) -> Float64[Tensor, "B H N m 10"]:
        """Poses that may be any, velocities as the prior has them; nothing but zero for UAV 0."""
        pose, n = super()._initial_particles(key, origin), key.shape[1]
        draws = normal(key, "cspf.velocity", 3 * n, self.particles).double()
        velocity = self.velocity_std * draws.unflatten(-1, (n, 3)).transpose(2, 3)
        first = torch.arange(n, device=key.device) == 0
        return torch.cat((pose, torch.where(first[:, None, None], 0.0, velocity)), -1)

    def _increments(
        self, observation: Observation, dt: Float64[Tensor, "B N"]
    ) -> Float64[Tensor, "B N 11"]:
        return imu_increments(observation, dt)

    def _edges(
        self, belief: SteinBelief, motion: Motion, dt: Float64[Tensor, "B H"]
    ) -> Float64[Tensor, "B H R N 10"]:
        """The dual variables, as far from the moved estimate as they were, in its body frame: what
        multipliers have accumulated in attitude would turn gravity, were they moved as a UAV is."""
        kept = RelativeStates.minus(belief.edges, belief.estimate.unsqueeze(2))
        moved = propagate(belief.estimate, motion.moved, dt)
        return RelativeStates.plus(moved.unsqueeze(2), kept)

    def _predict(
        self, belief: SteinBelief, motion: Motion, dt: Float64[Tensor, "B H"]
    ) -> Float64[Tensor, "B H N m 10"]:
        """Equation 29, each particle with noise of its own in every increment; a single one
        without noise."""
        d = motion.moved.unsqueeze(2)
        if self.particles > 1:
            steps = motion.steps.double().sqrt()[:, :, None, :, None]
            white = self._drawn(belief, 6)
            white = steps * white * white.new_tensor(self.std)  # of Δv and Δφ
            shift = 0.5 * self.believed.arena.dt * white[..., :3]
            d = Galilean.perturb(d, torch.cat((shift, white), -1))
        return propagate(belief.x.transpose(2, 3), d, dt.unsqueeze(2)).transpose(2, 3)

    def _remembered(
        self, window: MatchWindow, motion: Motion, dt: Float64[Tensor, "B H"], new: Matches
    ) -> InertialWindow:
        assert isinstance(window, InertialWindow)
        return windows.insert(windows.propagate(window, motion, dt, self.noise), new, self.noise)

    def _targets(
        self, window: MatchWindow, scale: Scale, agents: int, active: Bool[Tensor, "B H R"]
    ) -> list[InertialTarget]:
        """Each iteration's: all but the last with matches of at least ``_WIDE`` times their noise,
        so that those are not taken for wrong which a prediction over a gap has missed."""
        assert isinstance(window, InertialWindow)
        match = self.noise.match
        wide = Scale(
            scale.position.clamp_min(_WIDE * match[0]), scale.turn.clamp_min(_WIDE * match[1])
        )
        ahead, last = (
            inertial_target(
                window,
                each,
                agents,
                match=match,
                outliers=self.outliers,
                volume=self.volume,
                velocity_std=self.velocity_std,
                uniform=tuple(self.uniform),
                pull=self.pull,
            )
            for each in (wide, scale)
        )
        return [ahead] * (self.iterations - 1) + [last]

    def _speed(
        self,
        before: SteinBelief,
        after: SteinBelief,
        observation: Observation,
        dt: Float64[Tensor, "B N"],
    ) -> Float64[Tensor, "B N 3"]:
        """Relative to UAV 0 as estimated, UAV 0's own by the frame that results are stated in."""
        own = torch.arange(dt.shape[1], device=dt.device)
        state = after.estimate[:, own, own]
        shift = after.origin[..., :3] - before.origin[..., :3]
        here = unrotate(after.origin[..., 3:], shift) / self.believed.arena.dt
        velocity = state[..., 7:] + here * (dt > 0).unsqueeze(-1)
        return unrotate(state[..., 3:7], velocity)
