"""The posterior Cramér–Rao bound of a scenario, on the very worlds that localizers are scored on.

Tichavský, Muravchik, Nehorai, "Posterior Cramér–Rao bounds for discrete-time nonlinear filtering",
IEEE Trans. Signal Processing 46(5), 1998; Van Trees, "Detection, Estimation, and Modulation Theory
I", 1968, section 2.4. With process noise entering linearly their recursion reads

    J₀⁻ = P₀⁻¹        J_k⁻ = (F J_{k−1}⁻¹ Fᵀ + Q)⁻¹        J_k = J_k⁻ + Σ Hᵀ R⁻¹ H

over the joint error state of the team, all cross-information included: the bound of a team that
knows all its measurements at once, messages, their losses and delays aside.

**Which bound this is.** F, Q and H are taken at the truth of each world and J⁻¹, not J, is averaged
over worlds. Each world's J⁻¹ is the covariance of the optimal filter of the problem linearised at
its truth, so

- for linear Gaussian models it is exact and attained;
- else it holds up to what curvature does within the posterior: tight once errors are small against
  distances and a radian, not to be taken to the letter while the prior is still broad;
- of noise that is not Gaussian only the Fisher information enters: the bound holds, but a filter
  with few measurements per step does not reach it;
- IMU and odometry readings are inputs of known statistics, and their noise is process noise; with
  ``ConstantVelocity`` the process noise is the model's, though true motion is scripted;
- measurements count where the world's masks say that they arrived, and what visibility itself tells
  of the position is left out; late ones count as if measured when they arrive; which measurement
  belongs to which landmark is known (see ``information``).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from coloc_env.bounds.information import SHARED, own_information, shared_information
from coloc_env.bounds.process import ErrorModel, error_model, prior_covariance, true_sensors
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation, action_width
from coloc_env.scenario import Scenario
from coloc_env.sensors import Imu, Odometry
from coloc_env.world import World

_NUMBERS = 2**24  # of joint matrices held at once: 128 MiB


@dataclass(frozen=True, eq=False)
class Bound:
    """Bounds of the position's mean squared error (m²) per run, step and UAV, where it is
    ``scored``; ``dt`` is the step in s."""

    mse: Float64[Tensor, "R K N"]
    scored: Bool[Tensor, "R K N"]
    dt: float

    @property
    def position(self) -> Float64[Tensor, "K N"]:
        """Bound of the root mean square over runs, in m; NaN where no run is scored."""
        return (self._kept.sum(0) / self.scored.sum(0)).sqrt()

    @property
    def rmse(self) -> float:
        """Bound of the root mean square over runs, steps and UAVs, in m."""
        return self.rmse_after(0.0)

    def rmse_after(self, seconds: float) -> float:
        """The same from ``seconds`` on."""
        late = torch.arange(self.mse.shape[1]) * self.dt >= seconds - 1e-9
        return float((self._kept[:, late].sum() / self.scored[:, late].sum()).sqrt())

    @property
    def _kept(self) -> Float64[Tensor, "R K N"]:
        return torch.where(self.scored, self.mse, 0.0)


def posterior_bound(
    scenario: Scenario,
    runs: int = 20,
    seed: int = 0,
    steps: int | None = None,
    cooperative: bool = True,
) -> Bound:
    """The bound over the worlds seeded ``seed`` … ``seed + runs − 1``.

    ``steps``: how many of the scenario's (default: all). ``cooperative=False`` leaves out whatever
    is measured between UAVs.
    """
    steps = scenario.horizon if steps is None else steps
    if runs < 1 or not 1 <= steps <= scenario.horizon:
        raise ValueError(
            f"posterior_bound: runs={runs}, steps={steps} is not allowed: at least one run, and "
            f"steps from 1 to {scenario.horizon}"
        )
    model = error_model(scenario)
    joint = scenario.arena.n_uavs * model.pose().shape[1]
    at_once = max(1, _NUMBERS // joint**2)
    blocks = [
        _bound(scenario, model, range(first, min(first + at_once, seed + runs)), steps, cooperative)
        for first in range(seed, seed + runs, at_once)
    ]
    mse, scored = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    return Bound(mse, scored, scenario.arena.dt)


def _bound(
    scenario: Scenario, model: ErrorModel, seeds: range, steps: int, cooperative: bool
) -> tuple[Float64[Tensor, "B K N"], Bool[Tensor, "B K N"]]:
    """Position MSE bounds of some worlds, and where they are scored.

    T teams of n UAVs: those of the worlds, or, not cooperative, each UAV its own.
    """
    n_uavs, dim = scenario.arena.n_uavs, scenario.arena.dim
    n = n_uavs if cooperative else 1
    teams = len(seeds) * n_uavs // n
    prior = torch.block_diag(*n * [prior_covariance(model, scenario)])
    covariance = prior.expand(teams, -1, -1)
    before: Kinematics | None = None
    mse, scored = [], []
    for truth, seen, counts in _worlds(scenario, seeds, steps):
        if before is not None:
            f, q = model.transition(before, truth)
            covariance = predict(covariance, _by_team(f, n), _by_team(q, n))
        own, shared = _gained(scenario, model, truth, seen, cooperative)
        covariance = update(covariance, _by_team(own, n), shared)
        variance = covariance.diagonal(dim1=1, dim2=2).reshape(len(seeds), n_uavs, -1)
        mse.append(variance[..., :dim].sum(-1))
        scored.append(counts)
        before = truth
    return torch.stack(mse, 1), torch.stack(scored, 1)


def _worlds(
    scenario: Scenario, seeds: range, steps: int
) -> Iterator[tuple[Kinematics, Observation, Bool[Tensor, "B N"]]]:
    """Truth, observation and who is scored, step by step."""
    world = World(scenario, len(seeds))
    seen = world.reset(list(seeds))
    idle = torch.zeros(len(seeds), scenario.arena.n_uavs, action_width(scenario))
    for _ in range(steps):
        yield world.truth, seen, world.score(idle)[1]
        world.advance(idle)
        seen = world.observation()


def _gained(
    scenario: Scenario, model: ErrorModel, truth: Kinematics, seen: Observation, cooperative: bool
) -> tuple[Float64[Tensor, "B N E E"], Float64[Tensor, "B m m"] | None]:
    """``Σ Hᵀ R⁻¹ H`` of a step: blocks of single UAVs, and the team's matrix (None: there is none).

    IMU and odometry drive the process, and count there.
    """
    pose = model.pose()
    size, n = pose.shape[1], truth.position.shape[1]
    own = truth.position.new_zeros(*truth.position.shape[:2], size, size)
    shared = None
    for sensor in true_sensors(scenario):
        if isinstance(sensor, SHARED):
            if cooperative:
                information = shared_information(sensor, truth, seen)
                joint = torch.einsum("de,bidjf,fg->biejg", pose, information, pose)
                joint = joint.reshape(-1, n * size, n * size)
                shared = joint if shared is None else shared + joint
        elif not isinstance(sensor, Imu | Odometry):
            own = own + pose.mT @ own_information(sensor, truth, seen) @ pose
    return own, shared


def predict(
    covariance: Float64[Tensor, "T m m"],
    f: Float64[Tensor, "T n E E"],
    q: Float64[Tensor, "T n E E"],
) -> Float64[Tensor, "T m m"]:
    """``F P Fᵀ + Q`` for block-diagonal F and Q; Q may be singular."""
    blocks = f.shape[1:3]
    half = (f @ covariance.unflatten(1, blocks)).flatten(1, 2)
    whole = f @ half.mT.unflatten(1, blocks)
    _diagonal(whole.unflatten(-1, blocks)).add_(q)
    return whole.flatten(1, 2)


def update(
    covariance: Float64[Tensor, "T m m"],
    own: Float64[Tensor, "T n E E"],
    shared: Float64[Tensor, "T m m"] | None,
) -> Float64[Tensor, "T m m"]:
    """``(P⁻¹ + I)⁻¹`` for information I in blocks of single UAVs and of the team."""
    information = _inverse(covariance)
    _diagonal(information.unflatten(1, own.shape[1:3]).unflatten(-1, own.shape[1:3])).add_(own)
    return _inverse(information if shared is None else information + shared)


def _inverse(x: Float64[Tensor, "T m m"]) -> Float64[Tensor, "T m m"]:
    """Inverse of positive definite matrices; raises LinAlgError for others."""
    return torch.cholesky_inverse(torch.linalg.cholesky(x))


def _diagonal(x: Float64[Tensor, "T n E n E"]) -> Float64[Tensor, "T n E E"]:
    """A view of the diagonal blocks."""
    return x.diagonal(dim1=1, dim2=3).movedim(-1, 1)


def _by_team(x: Float64[Tensor, "B N E E"], n: int) -> Float64[Tensor, "T n E E"]:
    return x.reshape(-1, n, *x.shape[2:])
