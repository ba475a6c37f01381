"""Single-agent visual-inertial Stein particle filter (CSPF paper, section 6).

Particles on SE(3) × velocity × biases. They are predicted by the pre-integrated IMU (equations 28
and 29) and moved by SVGD with Gauss–Newton steps (equations 15 and 17) to the posterior: the
predicted Gaussian times a mixture of right and mistaken landmarks.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.filter import gaussian_estimate
from agents.localizer import Estimate, Localizer
from agents.models import preintegration
from agents.models.measurements import Block, LandmarkVectors, no_neighbours
from agents.models.preintegration import Preintegrated
from agents.models.process import InertialProcess
from agents.particle.belief import normal, own_keys
from agents.particle.sampling import from_prior
from agents.stein.estimate import Manifold, map_estimate
from agents.stein.landmarks import LandmarkFit, fit_landmarks
from agents.stein.likelihood import Scale
from agents.stein.update import kernel, mean_over, stein_step
from agents.tensorclasses import build
from coloc_env import noise
from coloc_env.geometry import Se3, concat, rotate, unrotate
from coloc_env.observation import Observation
from coloc_env.options import OpenShare, PositiveCount, PositiveShare, Ratio
from coloc_env.scenario import Believed, Inertial
from coloc_env.sensors import Imu, Landmarks

_POSE = (0, 1, 2, 6, 7, 8)  # of the error: position and attitude
_REST = (3, 4, 5, 9, 10, 11, 12, 13, 14)  # velocity and biases
_KNOWN = 1e-9  # m/s², rad/s: deviation of a bias that is believed to be zero
_TINY = 1e-16  # keeps the covariance of increments over no time regular


class SteinViBelief(TensorClass):
    """Particles, estimate and covariance (states and errors as ``InertialProcess`` lays them out,
    biases included), the share of inliers among the landmarks seen, the UAV's own random key and
    steps taken; batch (B, N)."""

    x: Float64[Tensor, "B N m 16"]
    state: Float64[Tensor, "B N 16"]
    covariance: Float64[Tensor, "B N 15 15"]
    inliers: Float64[Tensor, "B N"]
    key: Int64[Tensor, "B N"]
    step: Int64[Tensor, "B N"]


class SteinViFilter(Localizer[SteinViBelief]):
    """Stein particles of one UAV by IMU and landmarks, each UAV for itself.

    ``particles``, and ``iterations`` a step. At the first iteration the prediction's variance is
    added to that of each landmark, ``anneal`` times its deviation at each further one. ``pace`` and
    ``repulsion`` of the Stein step; ``outliers``: believed share ε of mistaken landmarks.
    """

    name = "stein_vi"
    serves = (Landmarks, Imu)

    def __init__(
        self,
        believed: Believed,
        *,
        particles: PositiveCount = 20,
        iterations: PositiveCount = 3,
        anneal: PositiveShare = 0.2,
        pace: PositiveShare = 0.8,
        repulsion: Ratio = 1.0,
        outliers: OpenShare = 0.1,
        seed: int = 0,
    ) -> None:
        super().__init__(believed)
        imu, landmarks = believed.sensor(Imu), believed.sensor(Landmarks)
        motion = believed.process
        if imu is None or landmarks is None or not isinstance(motion, Inertial):
            raise NotServed("a team with an IMU, landmarks and inertial motion is needed")
        known = max(motion.accel_bias, _KNOWN), max(motion.gyro_bias, _KNOWN)
        motion = replace(motion, accel_bias=known[0], gyro_bias=known[1])
        process = self.process = InertialProcess(believed.arena.dt, imu, motion)
        self.imu, self.model = imu, LandmarkVectors(landmarks)
        self.walk = [motion.accel_walk] * 3 + [motion.gyro_walk] * 3
        self.particles, self.iterations, self.seed = particles, iterations, seed
        self.anneal, self.pace, self.repulsion, self.outliers = anneal, pace, repulsion, outliers
        sides = [b - a for a, b in zip(believed.arena.low, believed.arena.high, strict=True)]
        self.volume = min(math.prod(sides), 4 / 3 * math.pi * landmarks.radius**3)
        self._states = Manifold(process.boxplus, process.boxminus)

    def reset(self, observation: Observation) -> SteinViBelief:
        state, covariance = self.process.initial(observation["prior"].double())
        key = own_keys(observation, self.seed)
        return SteinViBelief(
            x=from_prior(self.process, self.believed, state, covariance, key, self.particles),
            state=state,
            covariance=covariance,
            inliers=torch.ones_like(state[..., 0]),
            key=key,
            step=torch.zeros_like(key),
            batch_size=key.shape,
        )

    def step(
        self, belief: SteinViBelief, observation: Observation
    ) -> tuple[SteinViBelief, Estimate]:
        x, prior, covariance = self._predict(belief, observation)
        leaves = ("landmarks", "landmark_mask", "landmark_map")
        sightings = Observation({name: observation[name].unsqueeze(2) for name in leaves})
        block = self._block(prior, observation)
        inner = covariance[..., _POSE, :][..., _POSE].unsqueeze(-3)
        added = (block.jacobian @ inner * block.jacobian).sum((-2, -1)) / 3  # H P Hᵀ
        for iteration in range(self.iterations):
            variance = block.variance[..., 0] + self.anneal ** (2 * iteration) * added
            x, estimate = self._iterate(x, prior, covariance, variance, sightings)
        last = self._fit_landmarks(self._block(estimate, observation), variance)
        posterior = covariance - covariance[..., _POSE] @ _solved(
            last.information, covariance, last.information @ covariance[..., _POSE, :]
        )
        posterior = 0.5 * (posterior + posterior.mT)
        count = block.mask.double().sum(-1)
        after = build(
            SteinViBelief,
            belief.step.shape,
            x=x,
            state=estimate,
            covariance=posterior,
            inliers=torch.where(count > 0, last.inliers.sum(-1) / count.clamp_min(1), 1.0),
            key=belief.key,
            step=belief.step + 1,
        )
        return after, gaussian_estimate(self.process, estimate, posterior)

    def mean(self, belief: SteinViBelief) -> Float64[Tensor, "B N S"]:
        return belief.state

    def diagnostics(self, belief: SteinViBelief) -> dict[str, Tensor]:
        return {"inlier_share": belief.inliers}

    def _predict(
        self, belief: SteinViBelief, observation: Observation
    ) -> tuple[Float64[Tensor, "B N m 16"], Float64[Tensor, "B N 16"], Float64[Tensor, "B N E E"]]:
        """Particles, estimate and covariance at the observation's step: one window of samples for
        all, each particle with its own bias (equation 44 of Forster et al.) and noise."""
        window = self._window(belief, observation)
        state = belief.state.unsqueeze(2)
        navigation, added = preintegration.transition(state[..., :10], window)
        walk = added.new_tensor(self.walk) * window.duration.sqrt().unsqueeze(-1)
        f = torch.eye(15, dtype=added.dtype, device=added.device)[9:].expand(
            *added.shape[:-2], 6, 15
        )
        f = torch.cat((navigation, f), -2)
        covariance = f @ belief.covariance.unsqueeze(2) @ f.mT
        covariance[..., :9, :9] += added
        covariance[..., 9:, 9:] += torch.diag_embed(walk**2)
        prior = self._moved(state, window, window.increments)

        key = noise.fold(belief.key, belief.step)
        draws = normal(key, "stein_vi.step", 15, self.particles).double()
        tiny = _TINY * torch.eye(9, dtype=added.dtype, device=added.device)
        jitter = (torch.linalg.cholesky_ex(window.covariance + tiny).L @ draws[..., :9, None])[
            ..., 0
        ]
        jitter = torch.where(window.duration.unsqueeze(-1) > 0, jitter, 0.0)
        increments = preintegration.perturb(window.corrected(belief.x[..., 10:]), jitter)
        x = self._moved(belief.x, window, increments)
        x = concat((x[..., :10], x[..., 10:] + walk * draws[..., 9:]))
        return x, prior[:, :, 0], covariance[:, :, 0]

    def _window(self, belief: SteinViBelief, observation: Observation) -> Preintegrated:
        """The step's samples, or their mean where there is only that, pre-integrated for all
        particles [B, N, 1] without the estimate's bias; over no time in the first step."""
        dt = (belief.step > 0).double() * self.process.dt
        samples, held = preintegration.samples_in(observation, dt)
        whiter = held.shape[-1] ** 0.5  # the mean over a step is less noisy than a sample
        window = preintegration.preintegrate(
            samples.unsqueeze(2),
            held.unsqueeze(2),
            belief.state[..., 10:].unsqueeze(2),
            whiter * self.imu.accel_std,
            whiter * self.imu.gyro_std,
        )
        if "imu_unknown" not in observation:
            return window
        unknown = observation["imu_unknown"].double().unbind(-1)
        added = self.process.strapdown_noise(*unknown)[..., :9, :9]
        return replace(window, covariance=window.covariance + added.unsqueeze(2))

    @staticmethod
    def _moved(
        x: Float64[Tensor, "B N m 16"], window: Preintegrated, increments: Tensor
    ) -> Float64[Tensor, "B N m 16"]:
        moved = preintegration.predict(x[..., :10], increments, window.duration)
        return concat((moved, x[..., 10:]))

    def _block(self, x: Float64[Tensor, "*s 16"], observation: Observation) -> Block:
        """Residuals of the landmarks and their derivatives by the pose's error alone."""
        block = self.model.linearize(self.process, x, observation, no_neighbours(x[..., :3]))
        return replace(block, jacobian=block.jacobian[..., _POSE])

    def _fit_landmarks(self, block: Block, variance: Float64[Tensor, "*s L"]) -> LandmarkFit:
        return fit_landmarks(block, variance, self.outliers, self.volume)

    def _iterate(
        self,
        x: Float64[Tensor, "B N m 16"],
        prior: Float64[Tensor, "B N 16"],
        covariance: Float64[Tensor, "B N 15 15"],
        variance: Float64[Tensor, "B N L"],
        sightings: Observation,
    ) -> tuple[Float64[Tensor, "B N m 16"], Float64[Tensor, "B N 16"]]:
        """One Stein step to N(prior, P) times the landmarks' mixture, and the estimate: the mean of
        the Gauss–Newton targets around the best particle.

        A particle's Gauss–Newton step is H⁻¹ (P⁻¹ d + g), d = prior ⊟ x, H = P⁻¹ + A, where A and
        g, of the landmarks, are of the pose alone. So it is d + P_:p (I + A P_pp)⁻¹ (g − A d_p).
        The kernel and its repulsion are of the pose, too; velocity and biases follow the pose as
        the prior has them correlated, G = P_rp P_pp⁻¹.
        """
        process = self.process
        found = self._fit_landmarks(self._block(x, sightings), variance.unsqueeze(2))
        to_prior = process.boxminus(prior.unsqueeze(2).expand_as(x), x).contiguous()
        wide = covariance.unsqueeze(2)
        gradient = found.gradient - (found.information @ to_prior[..., _POSE, None])[..., 0]
        solved = _solved(found.information, wide, gradient.unsqueeze(-1))
        steps = to_prior + (wide[..., _POSE] @ solved)[..., 0]
        whitened = _solve(wide, to_prior.unsqueeze(-1))[..., 0]
        log_density = found.log_density - 0.5 * (to_prior * whitened).sum(-1)
        near = kernel(Se3, _pose_of(x).unsqueeze(2), self._scale(covariance, found))
        attitude = x[..., 6:10]
        pose = steps[..., _POSE]
        body = concat((unrotate(attitude, pose[..., :3]), pose[..., 3:])).unsqueeze(-2)
        phi = stein_step(near, body, torch.ones_like(body[..., :2]), self.repulsion)[..., 0, :]
        pose = concat((rotate(attitude, phi[..., :3]), phi[..., 3:]))
        inner = covariance[..., _POSE, :][..., _POSE]
        gain = _solve(inner, covariance[..., _POSE, :][..., _REST])
        alone = to_prior[..., _REST] - to_prior[..., _POSE] @ gain
        rest = mean_over(near, alone) + pose @ gain
        delta = concat((pose[..., :3], rest[..., :3], pose[..., 3:], rest[..., 3:]))
        targets = process.boxplus(x, steps).unsqueeze(2)
        estimate = map_estimate(self._states, targets, log_density, near.k)
        return process.boxplus(x, self.pace * delta), estimate[:, :, 0]

    def _scale(self, covariance: Float64[Tensor, "B N 15 15"], found: LandmarkFit) -> Scale:
        """The posterior's standard deviations of position and attitude, as units of the kernel."""
        inner = covariance[..., _POSE, :][..., _POSE]
        information = found.information.mean(2)
        posterior = inner - inner @ _solved(information, covariance, information @ inner)
        variance = posterior.diagonal(dim1=-2, dim2=-1)
        return Scale(variance[..., :3].mean(-1).sqrt(), variance[..., 3:].mean(-1).sqrt())


def _solved(
    information: Float64[Tensor, "*s 6 6"], covariance: Tensor, right: Float64[Tensor, "*s 6 k"]
) -> Float64[Tensor, "*s 6 k"]:
    """(I + A P_pp)⁻¹ ``right``."""
    inner = covariance[..., _POSE, :][..., _POSE]
    eye = torch.eye(6, dtype=inner.dtype, device=inner.device)
    return _solve(eye + information @ inner, right)


def _solve(a: Float64[Tensor, "*s e e"], b: Float64[Tensor, "*s e k"]) -> Tensor:
    """A⁻¹ B; a UAV whose numbers are NaN keeps them, and raises no error for the others."""
    result: Tensor = torch.linalg.solve_ex(a, b)[0]
    return result


def _pose_of(x: Float64[Tensor, "*s 16"]) -> Float64[Tensor, "*s 7"]:
    return concat((x[..., :3], x[..., 6:10]))
