"""The Cramér–Rao bound of a snapshot: the information in one step's measurements alone.

    J = Σ Hᵀ R⁻¹ H      E ‖p̂_i − p_i‖² ≥ tr (J⁻¹)_ii

for every unbiased estimator (Kay, "Fundamentals of Statistical Signal Processing: Estimation
Theory", 1993, section 3.7), with no prior, no motion and nothing of the steps before. J is over the
poses of the whole team, at the truth; for noise that is not Gaussian it is the mixture's (see
``mixture``). A UAV that is given its position has it as a measurement, with its noise. Attitude is
unknown only where the posterior bound has it among its states (see ``process``).

**Who is localizable.** Where J is singular its null space holds the motions that no measurement
sees: parts of the team that no anchor ties down, or with too few links. A UAV's position has a
finite bound if and only if none of these motions moves it, and then the pseudoinverse gives it
(Stoica, Marzetta, "Parameter estimation problems with singular information matrices", IEEE Trans.
Signal Processing 49(1), 2001). That is decided on J with each UAV's positions, and attitudes, in
units of what it would know of them if it knew all the others', so that no unit or scale matters.
Parts of the team without a link between them are blocks of J and do not touch each other.

- It is local: a UAV with ranges to three anchors counts as localizable, though its mirror image in
  their plane explains them as well. An estimator that starts anywhere knows no better.
- A geometry that is nearly singular has a finite bound of any size; beyond 10⁶ times those units
  it counts as singular.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from coloc_env.bounds.expected import about_states, pose_information
from coloc_env.bounds.posterior import Bound
from coloc_env.bounds.process import ErrorModel, error_model, true_sensors
from coloc_env.bounds.recursion import add
from coloc_env.bounds.worlds import seeds_of, worlds
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.sensors import AnchorRanging, Ranging, Sensor

_NULL = 1e-12  # eigenvalues of J, with a UAV's own of about 1, that are 0: rounding leaves 1e-14
_MOVED = 1e-12  # squared shares in the unit motions of the null space that are rounding


@dataclass(frozen=True, eq=False)
class SnapshotBound(Bound):
    """Bounds of the position's mean squared error (m²), ∞ for whoever is not localizable."""

    @property
    def localizable(self) -> Bool[Tensor, "R K N"]:
        return self.mse.isfinite()

    @property
    def share_localizable(self) -> float:
        """Of all that is scored; NaN if nothing is."""
        return float(self.localizable[self.scored].double().mean())

    @property
    def rmse_localizable(self) -> float:
        """Bound of the root mean square over runs, steps and the UAVs that are localizable, in m;
        NaN if none is."""
        return float(self.mse[self.scored & self.localizable].mean().sqrt())


def snapshot_bound(
    scenario: Scenario, runs: int = 20, seed: int = 0, steps: int | None = None
) -> SnapshotBound:
    """The bound of each step's snapshot over the worlds seeded ``seed`` … ``seed + runs − 1``.

    ``steps``: how many of the scenario's (default: all). Raises ValueError for impossible ``runs``
    or ``steps``, NotImplementedError for a sensor of unknown information.
    """
    steps = scenario.horizon if steps is None else steps
    pose = _pose(error_model(scenario))
    joint = scenario.arena.n_uavs * pose.shape[1]
    blocks = [
        _bound(scenario, pose, seeds, steps)
        for seeds in seeds_of("snapshot_bound", scenario, runs, seed, steps, joint)
    ]
    mse, scored = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    return SnapshotBound(mse, scored, scenario.arena.dt)


def _bound(
    scenario: Scenario, pose: Float64[Tensor, "D P"], seeds: Int64[Tensor, "B"], steps: int
) -> tuple[Float64[Tensor, "B K N"], Bool[Tensor, "B K N"]]:
    """Position MSE bounds of some worlds, and where they are scored."""
    sensors = [_in_itself(sensor) for sensor in true_sensors(scenario)]
    mse, scored = [], []
    for truth, seen, counts in worlds(scenario, seeds, steps):
        mse.append(position_mse(sensors, truth, seen, pose))
        scored.append(counts)
    return torch.stack(mse, 1), torch.stack(scored, 1)


def position_mse(
    sensors: list[Sensor], truth: Kinematics, seen: Observation, pose: Float64[Tensor, "D P"]
) -> Float64[Tensor, "B N"]:
    """``tr (J⁻¹)_ii`` in m² for what arrived in one step; ``pose`` picks what of it is unknown."""
    dim, size = truth.position.shape[-1], pose.shape[1]
    own, shared = about_states(pose, *pose_information(sensors, truth, seen))
    nothing = own.new_zeros(len(own), *2 * (own.shape[1] * size,))
    variance = error_variance(add(nothing, own, shared), dim, size)
    return variance.unflatten(1, (-1, size))[..., :dim].sum(-1)


def error_variance(
    information: Float64[Tensor, "B m m"], dim: int, size: int
) -> Float64[Tensor, "B m"]:
    """``diag J⁻¹``, ∞ for what the null space of J moves; of each ``size`` unknowns in a row the
    first ``dim`` and the others share a unit."""
    unit = _units(information, dim, size)
    scaled = information / (unit.unsqueeze(1) * unit.unsqueeze(2))
    root, failed = torch.linalg.cholesky_ex(scaled)
    sound = failed == 0
    variance = torch.full_like(unit, torch.inf)
    variance[sound] = torch.cholesky_inverse(root[sound]).diagonal(dim1=1, dim2=2)
    doubtful = ~(variance.sum(1) < 0.1 / _NULL)  # the trace of J⁻¹ is above 1/λ for each λ of J
    if doubtful.any():
        variance[doubtful] = _pseudoinverse(scaled[doubtful])
    return variance / unit**2


def _pseudoinverse(scaled: Float64[Tensor, "B m m"]) -> Float64[Tensor, "B m"]:
    """Its diagonal; ∞ where the null space has a part."""
    values, vectors = torch.linalg.eigh(scaled)
    null = (values < _NULL).unsqueeze(1)
    squares = vectors**2
    variance = (squares / values.unsqueeze(1)).masked_fill(null, 0.0).sum(2)
    moved = squares.masked_fill(~null, 0.0).sum(2)
    return variance.masked_fill(moved > _MOVED, torch.inf)


def _units(information: Float64[Tensor, "B m m"], dim: int, size: int) -> Float64[Tensor, "B m"]:
    """1/m for the positions, 1/rad for the attitudes of each UAV: the root of its mean own
    information, 1 where it has none."""
    own = information.diagonal(dim1=1, dim2=2).unflatten(1, (-1, size))
    means = [
        part.mean(-1, keepdim=True).expand_as(part)
        for part in (own[..., :dim], own[..., dim:])
        if part.shape[-1]
    ]
    mean = torch.cat(means, -1).flatten(1)
    return torch.where(mean > 0, mean, 1.0).sqrt()


def _pose(model: ErrorModel) -> Float64[Tensor, "D P"]:
    """``pose`` without the states that no sensor sees in one step, velocities and biases."""
    pose = model.pose()
    return pose[:, pose.any(0)]


def _in_itself(sensor: Sensor) -> Sensor:
    """The sensor without what earlier steps show: which ranges are NLOS for long."""
    if isinstance(sensor, Ranging | AnchorRanging):
        return replace(sensor, noise=replace(sensor.noise, nlos_time=None))
    return sensor
