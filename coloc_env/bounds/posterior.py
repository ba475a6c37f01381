"""The posterior Cramér–Rao bound of a scenario, on the very worlds that localizers are scored on.

Tichavský, Muravchik, Nehorai, "Posterior Cramér–Rao bounds for discrete-time nonlinear filtering",
IEEE Trans. Signal Processing 46(5), 1998; Van Trees, "Detection, Estimation, and Modulation Theory
I", 1968, section 2.4. With process noise that enters linearly their recursion reads

    J₀⁻ = P₀⁻¹      J_k⁻ = (F J_{k−1}⁻¹ Fᵀ + Q)⁻¹      J_k = J_k⁻ + E Σ Hᵀ R⁻¹ H

over the joint error state of the team, all cross-information included: the bound of a team that
pools all its measurements at once, whatever the radio loses or delays of its messages.

**Which bound this is.** The one conditional on each world (its map, the masks that say which
measurements arrived, its IMU, INS or odometry readings), its J⁻¹ averaged over worlds. F and Q are
taken at the truth. The expectation is over what the past leaves open (conditional bound: Zuo, Niu,
Varshney, IEEE Trans. Signal Processing 59(1), 2011): states spread by (J⁻)⁻¹ about an estimate that
is itself so spread about the truth, hence the truth moved by N(0, 2 (J⁻)⁻¹). One antithetic pair of
draws a step, functions of seed and step, stands for it. At the truth alone there would be no bound
while the posterior is broad: in a level formation ranges would hold nothing on heights, though they
rule out large errors.

- For linear Gaussian models it is exact and attained. Else it holds as far as the posterior is near
  a Gaussian of covariance J⁻¹, and is tight once that is small against distances and a radian.
- Of noise that is not Gaussian only the Fisher information enters: the bound holds, but a filter
  with few measurements per step does not reach it. Which ranges are NLOS is known where that lasts.
- IMU, INS and odometry noise, of known statistics, is process noise, and so is what missing samples
  of a recording leave unknown. With ``ConstantVelocity`` the
  process noise is the model's: scripted motion is smoother, and a filter may do better than that.
- Biases of ranges and heights are states of their own, Gauss–Markov as they are drawn.
- Landmarks that nobody knows are states, too (see ``landmarks``); of landmarks without names, those
  that are seen count as known: the bound holds, and nobody who has to find them out need reach it.
- The information that visibility itself holds is left out; a delayed measurement counts as if made
  when it arrives; the landmark that a false match shows is known (see ``information``); a uniform
  prior is taken as a Gaussian (see ``process``).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.bounds.biases import LinkBiases, predicted, updated
from coloc_env.bounds.expected import expected_information
from coloc_env.bounds.information import informs_of_motion
from coloc_env.bounds.landmarks import LandmarkStates, known_landmarks
from coloc_env.bounds.process import ErrorModel, error_model, prior_covariance, true_sensors
from coloc_env.bounds.recursion import predict, update
from coloc_env.bounds.worlds import seeds_of, worlds
from coloc_env.motion import Kidnapped, Kinematics
from coloc_env.scenario import Scenario


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
    if isinstance(scenario.motion, Kidnapped):
        raise ValueError("posterior_bound: no bound is known for a team that is kidnapped")
    steps = scenario.horizon if steps is None else steps
    model = error_model(scenario)
    biases, landmarks = LinkBiases.of(scenario, cooperative), LandmarkStates.of(scenario)
    scenario = known_landmarks(scenario)
    joint = scenario.arena.n_uavs * model.pose().shape[1] + biases.count + landmarks.count
    blocks = [
        _bound(scenario, model, biases, landmarks, seeds, steps, cooperative)
        for seeds in seeds_of("posterior_bound", scenario, runs, seed, steps, joint)
    ]
    mse, scored = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    return Bound(mse, scored, scenario.arena.dt)


def _bound(
    scenario: Scenario,
    model: ErrorModel,
    biases: LinkBiases,
    landmarks: LandmarkStates,
    seeds: Int64[Tensor, "B"],
    steps: int,
    cooperative: bool,
) -> tuple[Float64[Tensor, "B K N"], Bool[Tensor, "B K N"]]:
    """Position MSE bounds of some worlds, and where they are scored.

    Teams are those of the worlds or, not cooperative, single UAVs: T teams of n.
    """
    pose, dim = model.pose(), scenario.arena.dim
    n = scenario.arena.n_uavs if cooperative else 1
    states = (len(seeds), scenario.arena.n_uavs, pose.shape[1])
    sensors = [s for s in true_sensors(scenario) if cooperative or not s.between_uavs]
    sensors = [s for s in sensors if s is not landmarks.sensor]
    velocity = model.velocity() if any(map(informs_of_motion, sensors)) else None
    beside = torch.block_diag(biases.prior, landmarks.prior)
    kept = torch.cat((biases.kept, beside.new_ones(landmarks.count)))
    prior = torch.block_diag(*n * [prior_covariance(model, scenario)], beside)
    covariance = prior.expand(states[0] * states[1] // n, -1, -1)
    size = n * states[2]  # of a team's errors; its biases and landmarks follow
    before: Kinematics | None = None
    mse, scored = [], []
    for step, (truth, seen, counts) in enumerate(worlds(scenario, seeds, steps)):
        if before is not None:
            f, q = model.transition(before, truth, seen)
            moved = predict(covariance[:, :size, :size], _by_team(f, n), _by_team(q, n))
            covariance = predicted(covariance, moved, _by_team(f, n), kept, beside)
        root = torch.linalg.cholesky(covariance)
        keys = noise.fold(noise.row_keys(seeds), step)
        white = noise.normal(keys, "bound", states[1] * states[2]).double()
        drawn = (2**0.5 * root[:, :size, :size] @ white.reshape(len(root), -1, 1)).view(states)
        own, shared = expected_information(sensors, truth, seen, drawn, pose, velocity)
        if len(beside):
            parts = []
            if biases.count:
                parts.append(biases.information(truth, seen, drawn, pose, n))
            if landmarks.count:
                of_map, across, coordinates = landmarks.information(truth, seen, pose, n)
                own = own + of_map
                parts.append((across, coordinates))
            cross, each = (torch.cat(part, -1) for part in zip(*parts, strict=True))
            covariance = updated(root, _by_team(own, n), shared, (cross, each))
        else:
            covariance = update(root, _by_team(own, n), shared)
        variance = covariance.diagonal(dim1=1, dim2=2)[:, :size].reshape(states)
        mse.append(variance[..., :dim].sum(-1))
        scored.append(counts)
        before = truth
    return torch.stack(mse, 1), torch.stack(scored, 1)


def _by_team(x: Float64[Tensor, "B N E E"], n: int) -> Float64[Tensor, "T n E E"]:
    return x.reshape(-1, n, *x.shape[2:])
