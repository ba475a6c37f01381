"""``pose_graph`` of a team that moves by its IMUs: a sliding window of the whole team's poses and
velocities with pre-integrated IMU factors (Forster et al. 2017), solved by GTSAM."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from agents.factor_graph.pose_graph import PoseGraph, PoseGraphBelief
from agents.localizer import Estimate
from agents.stein.galilean import Galilean, imu_increments, propagate
from agents.tensorclasses import build
from coloc_env.geometry import (
    Se3,
    quaternion_conjugate,
    quaternion_product,
    rotate,
    unrotate,
)
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, Inertial
from coloc_env.sensors import Imu, RelativePose, Sensor

_EXACT = 1e-3  # m, rad, m/s: of what is fixed
_LEAST = 1e-4  # m/s², rad/s: standard deviation of a bias that is believed to be zero
_WINDOW = 50  # steps
_REWEIGHTED = 10  # times, for an initial estimate


class InertialPoseGraph(PoseGraph):
    """``pose_graph`` over the last 50 steps, with IMU factors between them and a bias of each IMU.

    The window's frame falls with gravity, which is then the same nothing for all, and UAV 0's last
    pose and velocity are fixed in it (see ``galilean``). Velocities are less UAV 0's.
    """

    serves = (RelativePose, Imu)
    moved_by = Imu

    def __init__(self, believed: Believed, **options: Any) -> None:
        super().__init__(believed, **options)
        motion, gtsam, dt = believed.process, self.gtsam, believed.arena.dt
        assert isinstance(motion, Inertial)
        accel, gyro = (size / dt for size in (self.std[0], self.std[-1]))
        self.params = gtsam.PreintegrationParams(np.zeros(3))  # no gravity in a frame that falls
        self.params.setAccelerometerCovariance(np.eye(3) * accel**2 * dt)
        self.params.setGyroscopeCovariance(np.eye(3) * gyro**2 * dt)
        self.params.setIntegrationCovariance(np.eye(3) * 1e-6)
        biases = [max(motion.accel_bias, _LEAST)] * 3 + [max(motion.gyro_bias, _LEAST)] * 3
        self.bias = gtsam.noiseModel.Diagonal.Sigmas(np.array(biases))
        self.velocity_std = math.sqrt(2) * believed.prior.velocity_spread

    def _noise_of(self, sensor: Sensor) -> list[float]:
        assert isinstance(sensor, Imu)
        return [sensor.accel_std] * 3 + [sensor.gyro_std] * 3

    def reset(self, observation: Observation) -> PoseGraphBelief:
        empty = super().reset(observation)
        still = torch.zeros_like(empty.estimate[..., :3])
        return empty.replace(
            track=empty.track[..., :6], estimate=torch.cat((empty.estimate, still), -1)
        )

    def step(
        self, belief: PoseGraphBelief, observation: Observation
    ) -> tuple[PoseGraphBelief, Estimate]:
        dt = (belief.step > 0).double() * self.believed.arena.dt
        ends, pose, mask = self._measured(observation)
        imu = observation["imu"].double()
        imu = torch.where(imu.isfinite().all(-1, keepdim=True), imu, 0.0)

        def append(steps: Tensor, new: Tensor) -> Tensor:
            return torch.cat((steps, new.unsqueeze(2)), 2)[:, :, -_WINDOW:]

        after = build(
            PoseGraphBelief,
            belief.step.shape,
            track=append(belief.track, imu),
            ends=append(belief.ends, ends),
            matches=append(belief.matches, pose),
            mask=append(belief.mask, mask),
            estimate=propagate(belief.estimate, imu_increments(observation, dt), dt[:, 0]),
            covariance=belief.covariance,
            step=belief.step + 1,
        )
        if int(after.step.max()) % self.every == 0 and after.track.shape[2] > 1:
            solved = [self._solved(row) for row in after.to("cpu").unbind(0)]  # where GTSAM works
            estimate, covariance = (
                torch.stack(part).to(imu.device) for part in zip(*solved, strict=True)
            )
            after = after.replace(estimate=estimate, covariance=covariance)
        origin, state = observation["reference"].double(), after.estimate
        speed = unrotate(state[..., 3:7], state[..., 7:])
        return after, self.world_estimate(state[..., :7], after.covariance, origin, speed)

    # ---------------------------------------------------------------- one world's graph

    def _solved(
        self, row: PoseGraphBelief
    ) -> tuple[Float64[Tensor, "N 10"], Float64[Tensor, "N 3 3"]]:
        """States relative to UAV 0's last one, and the covariances of their positions."""
        gtsam, (n, steps, _) = self.gtsam, row.track.shape
        uav = torch.arange(n)[:, None, None]
        once = row.mask & (row.ends[..., 0] == uav)
        at, (first, second) = once.nonzero()[:, 1], row.ends[once].unbind(-1)
        pose = row.matches[once]
        place, velocity = self._initial(row.track, first, second, at, pose)
        graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
        speeds, biases = n * steps, 2 * n * steps  # where their keys begin
        exact, bias = gtsam.noiseModel.Isotropic.Sigma, gtsam.imuBias.ConstantBias()
        here, last = self._to_gtsam(place[0, -1]), velocity[0, -1].numpy()
        for j in range(n):
            key = (j + 1) * steps - 1
            at_once = exact(6, _EXACT) if j == 0 else self._noise([v**0.5 for v in self.uniform])
            moving = exact(3, _EXACT if j == 0 else self.velocity_std)
            graph.add(gtsam.PriorFactorPose3(key, here, at_once))
            graph.add(gtsam.PriorFactorVector(speeds + key, last, moving))
            graph.add(gtsam.PriorFactorConstantBias(biases + j, bias, self.bias))
            initial.insert(biases + j, bias)
            for k in range(steps):
                initial.insert(j * steps + k, self._to_gtsam(place[j, k]))
                initial.insert(speeds + j * steps + k, velocity[j, k].numpy())
            for a, b in pairwise(range(j * steps, (j + 1) * steps)):
                between = gtsam.PreintegratedImuMeasurements(self.params, bias)
                sample = row.track[j, b - j * steps].numpy()
                between.integrateMeasurement(sample[:3], sample[3:], self.believed.arena.dt)
                keys = (a, speeds + a, b, speeds + b, biases + j)
                graph.add(gtsam.ImuFactor(*keys, between))
        known, match = graph.size(), self._match_noise()
        for i, j, k, each in zip(first.tolist(), second.tolist(), at.tolist(), pose, strict=True):
            ends = i * steps + k, j * steps + k
            graph.add(gtsam.BetweenFactorPose3(*ends, self._to_gtsam(each), match))
        values, graph = self._optimized(graph, initial, known)
        now = [(j + 1) * steps - 1 for j in range(n)]
        found = torch.stack([self._from_gtsam(values, key) for key in now])
        speed = torch.from_numpy(np.stack([values.atVector(speeds + key) for key in now]))
        apart = unrotate(found[:1, 3:].expand(n, -1), speed - speed[:1])
        marginals = gtsam.Marginals(graph, values)
        covariance = np.stack([marginals.marginalCovariance(key)[3:, 3:] for key in now])
        state = torch.cat((Se3.between(found[:1].expand_as(found), found), apart), -1)
        return state, torch.from_numpy(covariance)

    def _initial(
        self,
        imu: Float64[Tensor, "N T 6"],
        first: Int64[Tensor, "C"],
        second: Int64[Tensor, "C"],
        at: Int64[Tensor, "C"],
        pose: Float64[Tensor, "C 7"],
    ) -> tuple[Float64[Tensor, "N T 7"], Float64[Tensor, "N T 3"]]:
        """Poses (m) and velocities (m/s) by the IMUs: attitudes at the window's start as most
        matches agree on them, the rest by least squares, reweighted to absolute values."""
        n, steps, dt = imu.shape[0], imu.shape[1], self.believed.arena.dt
        moved, held = [Galilean.identity(imu).expand(n, -1)], torch.full((1, n), dt).to(imu)
        for k in range(1, steps):
            one = imu_increments(Observation({"imu": imu[None, :, k]}), held)[0]
            moved.append(Galilean.compose(moved[-1], one))
        since = torch.stack(moved, 1)  # [N, T, 11]
        turn = since[..., 6:10]
        back = quaternion_conjugate(turn[second, at])
        began = quaternion_product(quaternion_product(turn[first, at], pose[:, 3:]), back)
        turned = torch.cat((torch.zeros_like(pose[:, :3]), began), -1)
        start = self._layout(first.tolist(), second.tolist(), turned, n)[:, 3:]  # [N, 4]
        wide = start.unsqueeze(1).expand(-1, steps, -1)
        attitude = quaternion_product(wide, turn)
        shift, gain = rotate(wide, since[..., :3]), rotate(wide, since[..., 3:6])
        # p_j(k) = p_j + v_j t_k + shift_j(k), so each match is linear in p and v at the start.
        measured = rotate(attitude[first, at], pose[:, :3]) - shift[second, at] + shift[first, at]
        uav = torch.arange(1, n)
        ends = (second.unsqueeze(-1) == uav).double() - (first.unsqueeze(-1) == uav).double()
        rows = torch.cat((ends, ends * (dt * at.double()).unsqueeze(-1)), -1)
        weight = torch.ones_like(rows[:, :1])
        ridge = 1e-6 * torch.eye(2 * (n - 1), dtype=rows.dtype)
        for _ in range(_REWEIGHTED):
            found = torch.linalg.solve(
                rows.mT @ (weight * rows) + ridge, rows.mT @ (weight * measured)
            )
            off = (rows @ found - measured).norm(dim=-1, keepdim=True)
            weight = 1 / off.clamp_min(self.matches.std)
        place, velocity = torch.nn.functional.pad(found.unflatten(0, (2, -1)), (0, 0, 1, 0))
        time = dt * torch.arange(steps, dtype=rows.dtype).unsqueeze(-1)
        position = place.unsqueeze(1) + velocity.unsqueeze(1) * time + shift
        return torch.cat((position, attitude), -1), velocity.unsqueeze(1) + gain
