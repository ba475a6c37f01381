"""The posterior bound against closed forms, automatic differentiation, Stone Soup and sampling."""

import datetime
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.linalg import solve_discrete_are
from scipy.stats import exponnorm, norm
from torch import Tensor

from coloc_env import noise
from coloc_env.bounds import Bound, posterior_bound, range_information, worlds
from coloc_env.bounds.expected import expected_information
from coloc_env.bounds.information import (
    motion_information,
    own_information,
    shared_information,
)
from coloc_env.bounds.mixture import error_density
from coloc_env.bounds.process import error_model, prior_covariance, strapdown_jacobians
from coloc_env.geometry import (
    quaternion_exp,
    quaternion_product,
    rotate,
    rotate_by,
    rotation_between,
    unrotate,
)
from coloc_env.motion import Aggressive, Arena, Carry, Kinematics, Motion, RandomVelocity
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.scenario import (
    ConstantVelocity,
    Inertial,
    InsDriven,
    Prior,
    Process,
    Scenario,
    Wheeled,
)
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import (
    GRAVITY,
    AnchorRanging,
    ArrivalAngles,
    Height,
    Imu,
    Ins,
    LandmarkBearings,
    Landmarks,
    Odometry,
    OpticalFlow,
    PositionFix,
    RangeNoise,
    Ranging,
    RecordedSensor,
    Sensor,
    Tdoa,
    UavBearings,
)
from coloc_env.series import Series
from coloc_env.world import World

N = 3
TAGS = (((0.2, 0.1, -0.1), (-0.3, 0.0, 0.1)),) * N
PLANE_TAGS = (((0.2, 0.1), (-0.3, 0.0)),) * N
ANCHORS = ((0.0, 0.0, 0.0), (10.0, 8.0, 4.0), (0.0, 8.0, 1.0))
PLANE_ANCHORS = ((0.0, 0.0), (10.0, 8.0))
CORNERS = ((1.0, 1.0, 1.0), (9.0, 2.0, 3.0), (4.0, 7.0, 2.0), (8.0, 7.0, 0.5))


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def scenario(
    *sensors: Sensor,
    dim: int = 3,
    process: Process | None = None,
    prior: Prior | None = None,
    n: int = N,
    **settings: object,
) -> Scenario:
    """Some UAVs in a box of 10 × 8 × 4 m with these sensors."""
    chosen = {
        "name": "test",
        "arena": Arena(dim, n, 0.1, (0.0,) * dim, (10.0, 8.0, 4.0)[:dim]),
        "horizon": 1000,
        "motion": Aggressive() if dim == 3 else RandomVelocity(),
        "network": Network(),
        "prior": prior or Prior(),
        "process": process or ConstantVelocity(),
        "believed_sensors": sensors,
    }
    return Scenario(sensors=sensors, **(chosen | settings))


def first_step(task: Scenario) -> tuple[Kinematics, Observation]:
    world = World(task)
    seen = world.reset(5)
    return world.truth, seen


@dataclass(frozen=True)
class Standing(Motion):
    """UAVs that stay where they are, unrotated."""

    positions: tuple[tuple[float, ...], ...]

    def start(self, keys: Tensor, arena: Arena) -> Carry:
        return {}

    def advance(self, carry: Carry, steps: Tensor, arena: Arena) -> tuple[Kinematics, Carry]:
        place = torch.tensor(self.positions, dtype=torch.float64).repeat(*steps.shape, 1, 1)
        attitude = torch.zeros(*place.shape[:3], 4 if arena.dim == 3 else 1, dtype=torch.float64)
        attitude[..., 0] = float(arena.dim == 3)
        return Kinematics(place, torch.zeros_like(place), attitude), carry


def standing(*positions: tuple[float, ...]) -> Standing:
    return Standing(positions)


# ---------------------------------------------------------------- closed forms


@pytest.mark.parametrize("damping", [None, 2.0])
def test_steady_state_solves_the_riccati_equation(damping: float | None) -> None:
    """Ranges to anchors at the horizon measure the coordinates themselves."""
    far = 1e7
    axes = ((far, 0.0, 0.0), (0.0, far, 0.0), (0.0, 0.0, far))
    process = ConstantVelocity(accel_std=0.7, damping=damping)
    task = scenario(AnchorRanging(axes, RangeNoise(std=0.3)), process=process, n=2)
    bound = posterior_bound(task, runs=2, steps=200)

    dt, rate = 0.1, 1 / damping if damping else 1e-9
    kept = np.exp(-rate * dt)
    f = np.array([[1, (1 - kept) / rate], [0, kept]])
    pushes = 0.7 * np.array([(1 - np.exp(-rate * (s := np.linspace(0, dt, 20001)))) / rate,
                             np.exp(-rate * s)])  # fmt: skip
    q = np.trapezoid(pushes[:, None] * pushes[None], s, axis=-1)
    h, r = np.array([[1.0, 0.0]]), np.array([[0.3**2]])
    before = solve_discrete_are(f.T, h.T, q, r)
    after = before[0, 0] - before[0, 0] ** 2 / (before[0, 0] + r[0, 0])
    assert bound.position[-1].numpy() == pytest.approx(np.sqrt(3 * after), rel=1e-5)


def test_a_range_between_two_uavs_counts_once() -> None:
    """J = [[a + λ, −λ], [−λ, a + λ]] along the link, a = 1/σ₀² and λ = 1/σ²; nothing across."""
    prior = Prior(position_std=1e-3)
    task = scenario(
        Ranging(RangeNoise(std=2e-3)), prior=prior, n=2, motion=standing((3, 4, 1), (6, 4, 1))
    )
    a, link = 1e6, 2.5e5
    along = (a + link) / ((a + link) ** 2 - link**2)
    expected = np.sqrt(along + 2 / a)
    assert posterior_bound(task, 2, steps=1).position.numpy() == pytest.approx(expected, rel=1e-5)
    alone = posterior_bound(task, 2, steps=1, cooperative=False).position.numpy()
    assert alone == pytest.approx(np.sqrt(3 / a))


def test_nothing_measured_leaves_the_prior_and_what_motion_adds() -> None:
    task = scenario(process=ConstantVelocity(accel_std=0.5), prior=Prior(2.0, 0.3))
    variance = 2.0**2 + (0.3 * 5.0) ** 2 + 0.5**2 * 5.0**3 / 3
    bound = posterior_bound(task, 1, steps=51)
    assert bound.position[-1].numpy() == pytest.approx(np.sqrt(3 * variance))
    uniform = posterior_bound(replace(task, prior=Prior(kind="uniform")), 1, steps=1)
    assert uniform.rmse == pytest.approx(np.sqrt((10**2 + 8**2 + 4**2) / 12))


@pytest.mark.parametrize(
    ("anchors", "tight"),
    [(((1.0, 1.0), (9.0, 1.0), (5.0, 7.0)), 0.8), (((2.0, 4.0), (8.0, 4.5)), 0.3)],
)
def test_bound_holds_while_the_prior_is_broad(anchors: tuple, tight: float) -> None:
    """One step: the exact posterior's mean variance, on a grid. Two anchors leave two places open,
    of which no bound on curvature knows."""
    std, runs = 0.3, 200
    prior = Prior(position_std=2.0)
    task = scenario(AnchorRanging(anchors, RangeNoise(std=std)), dim=2, prior=prior, n=1)
    world = World(task, runs)
    seen = world.reset(0)
    prior_mean = seen["prior"][:, 0, :2].double()
    axis = torch.linspace(-8.0, 8.0, 129, dtype=torch.float64)
    grid = prior_mean[:, None] + torch.cartesian_prod(axis, axis)
    apart = (grid.unsqueeze(2) - torch.tensor(anchors, dtype=torch.float64)).norm(dim=-1)
    likelihood = -0.5 * (((apart - seen["anchor_ranges"].double()) / std) ** 2).sum(-1)
    weights = (likelihood - 0.5 * ((grid - prior_mean[:, None]) / 2.0).square().sum(-1)).softmax(-1)
    mean = weights.unsqueeze(1) @ grid
    best = float((weights * (grid - mean).square().sum(-1)).sum(-1).mean().sqrt())
    assert tight * best < posterior_bound(task, runs, steps=1).rmse < best


# ---------------------------------------------------------------- against Stone Soup


@pytest.mark.parametrize("damping", [None, 3.0])
def test_agrees_with_stone_soup(damping: float | None) -> None:
    """Ranges to anchors some way off, so that curvature plays no part."""
    pytest.importorskip("stonesoup")
    from stonesoup.metricgenerator.pcrbmetric import PCRBMetric
    from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
    from stonesoup.models.transition import linear
    from stonesoup.types.array import StateVector
    from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
    from stonesoup.types.state import GaussianState

    class Places(list):
        """Anchors as its recursion indexes them, each a column vector."""

        shape = (2, 3)

        def __getitem__(self, key: tuple[slice, int]) -> StateVector:
            return StateVector(super().__getitem__(key[1]))

    anchors, steps = ((-400.0, 0.0), (300.0, 500.0), (100.0, -600.0)), 60
    process = ConstantVelocity(accel_std=0.4, damping=damping)
    prior = Prior(position_std=0.05, velocity_std=0.2)
    task = scenario(
        AnchorRanging(anchors, RangeNoise(std=0.15)), dim=2, process=process, prior=prior, n=1
    )
    world, start = World(task), datetime.datetime(2026, 1, 1)
    world.reset(7)
    states = []
    for step in range(steps + 1):
        p, v = world.truth.position[0, 0], world.truth.velocity[0, 0]
        moment = start + datetime.timedelta(seconds=0.1 * (step + 1))
        states.append(GroundTruthState([p[0], v[0], p[1], v[1]], timestamp=moment))
        world.advance(torch.zeros(1, 1, 6))
    # Their recursion first measures at the second state, ours at the first.
    still = GroundTruthState(states[0].state_vector, timestamp=start)
    axis = linear.ConstantVelocity(0.4**2)
    if damping is not None:
        axis = linear.OrnsteinUhlenbeck(0.4**2, 1 / damping)
    transition = linear.CombinedLinearGaussianTransitionModel([axis, axis])
    f = transition.matrix(time_interval=datetime.timedelta(seconds=0.1))
    q = transition.covar(time_interval=datetime.timedelta(seconds=0.1))
    first = np.diag([0.05**2, 0.2**2, 0.05**2, 0.2**2])
    back = np.linalg.inv(f)
    metric = PCRBMetric._compute_pcrb_single(
        prior=GaussianState(still.state_vector, back @ (first - q) @ back.T),
        transition_model=transition,
        measurement_model=CartesianToBearingRange(4, (0, 2), np.diag([1e12, 0.15**2])),
        groundtruth=GroundTruthPath([still, *states]),
        sensor_locations=Places(anchors),
        irf_overall=1.0,
        position_mapping=(0, 2),
        velocity_mapping=None,
    )
    ours = posterior_bound(task, runs=1, seed=7, steps=steps + 1).position[:, 0].numpy()
    assert ours == pytest.approx(metric["position_RMSE"][1:], rel=1e-5)


# ---------------------------------------------------------------- information of the sensors


def predicted_landmarks(s: Landmarks, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    points = seen["landmark_map"][0].double().unflatten(-1, (-1, p.position.shape[-1]))
    expected = unrotate(p.attitude[0].unsqueeze(1), points - p.position[0].unsqueeze(1))
    mask = seen["landmark_mask"][0].double().unsqueeze(-1)
    return expected, (mask / s.std**2).expand_as(expected)


def predicted_height(s: Height, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    return p.position[0, :, 2:], seen["height_mask"][0].double() / s.std**2


def predicted_fix(s: PositionFix, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    mask = seen["position_fix_mask"][0].double()
    std = torch.tensor(s.axis_std(p.position.shape[-1]), dtype=torch.float64)
    return p.position[0], mask / std**2


def predicted_differences(s: Tdoa, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    anchors = torch.tensor(s.anchors, dtype=torch.float64)
    far = (tag_places(p, s.tags).unsqueeze(2) - anchors).norm(dim=-1)
    expected = torch.stack([far[..., n] - far[..., m] for m, n in s.pairs], -1).flatten(1)
    return expected.repeat(1, s.depth), seen["tdoa_mask"][0].double() * mixed(s)


def mixed(s: Tdoa) -> float:
    """∫ p′² / p of (1 − q) N(0, σ²) + q N(0, τ²), by quadrature."""
    if not s.tail:
        return 1 / s.std**2
    parts = ((1 - s.tail, s.std), (s.tail, s.tail_std))

    def slope(e: float) -> float:
        each = [share * norm.pdf(e, 0, std) for share, std in parts]
        down = sum(p * e / std**2 for p, (_, std) in zip(each, parts, strict=True))
        return float(down**2 / sum(each))

    return float(2 * quad(slope, 0, 8 * s.std)[0] + 2 * quad(slope, 8 * s.std, 8 * s.tail_std)[0])


def predicted_angles(s: ArrivalAngles, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    mask = seen["arrival_angle_mask"][0].double().unflatten(-1, (s.depth, N))
    std = torch.tensor((s.azimuth_std, s.elevation_std), dtype=torch.float64)
    expected, weights = [], []
    for i, j, d in product(range(N), range(N), range(s.depth)):
        if i != j:
            v = unrotate(p.attitude[0, i], p.position[0, j] - p.position[0, i])
            expected.append(torch.stack((torch.atan2(v[1], v[0]), torch.asin(v[2] / v.norm()))))
            weights.append(mask[i, d, j] / std**2)
    return torch.stack(expected), torch.stack(weights)


def tag_places(p: Kinematics, tags: tuple) -> Tensor:
    if not tags:
        return p.position[0].unsqueeze(1)
    arms = torch.tensor(tags, dtype=torch.float64)
    return p.position[0].unsqueeze(1) + rotate(p.attitude[0].unsqueeze(1), arms)


def predicted_anchors(s: AnchorRanging, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    anchors = torch.tensor(s.anchors, dtype=torch.float64)
    expected = (tag_places(p, s.tags).unsqueeze(2) - anchors).norm(dim=-1).flatten(1)
    return expected, seen["anchor_range_mask"][0].double() / s.noise.std**2


def predicted_ranges(s: Ranging, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    """Every tag pair once, from the end with the lower index."""
    tags, t = tag_places(p, s.tags), s.n_tags
    mask = seen["range_mask"][0].double().unflatten(-1, (N, t, t))
    expected, weights = [], []
    for i, j, a, b in product(range(N), range(N), range(t), range(t)):
        if i < j:
            expected.append((tags[i, a] - tags[j, b]).norm())
            weights.append(mask[i, j, a, b] / s.noise.std**2)
    return torch.stack(expected), torch.stack(weights)


def polar(apart: Tensor) -> Tensor:
    return torch.stack((apart.norm(dim=-1), torch.atan2(apart[..., 1], apart[..., 0])), -1)


def predicted_bearings(
    s: LandmarkBearings, p: Kinematics, seen: Observation
) -> tuple[Tensor, Tensor]:
    points = seen["landmark_map"][0].double().unflatten(-1, (-1, 2)).repeat(1, s.depth, 1)
    expected = polar(unrotate(p.attitude[0].unsqueeze(1), points - p.position[0].unsqueeze(1)))
    mask = seen["landmark_bearing_mask"][0].double().unsqueeze(-1)
    return expected, mask / torch.tensor((s.range_std, s.bearing_std), dtype=torch.float64) ** 2


def predicted_uav_bearings(
    s: UavBearings, p: Kinematics, seen: Observation
) -> tuple[Tensor, Tensor]:
    mask = seen["uav_bearing_mask"][0].double().unflatten(-1, (s.depth, N))
    std = torch.tensor((s.range_std, s.bearing_std), dtype=torch.float64)
    expected, weights = [], []
    for i, j, d in product(range(N), range(N), range(s.depth)):
        if i != j:
            expected.append(polar(unrotate(p.attitude[0, i], p.position[0, j] - p.position[0, i])))
            weights.append(mask[i, d, j] / std**2)
    return torch.stack(expected), torch.stack(weights)


CASES: list[tuple[Sensor, int, Callable]] = [
    (Landmarks(6, std=0.2, radius=6.0, dropout=0.3), 3, predicted_landmarks),
    (Landmarks(6, std=0.2, radius=6.0), 2, predicted_landmarks),
    (Height(0.1, dropout=0.3), 3, predicted_height),
    (PositionFix(0.3, count=2), 3, predicted_fix),
    (PositionFix(0.3, count=1), 2, predicted_fix),
    (PositionFix(0.3, 2, vertical_std=0.7, dropout=0.3), 3, predicted_fix),
    (Tdoa(ANCHORS, 0.2, TAGS, ((0, 1), (2, 0)), depth=2, dropout=0.3), 3, predicted_differences),
    (Tdoa(ANCHORS, 0.2, pairs=((0, 1), (2, 0)), tail=0.2, tail_std=1.5), 3, predicted_differences),
    (Tdoa(PLANE_ANCHORS, 0.2, PLANE_TAGS, ((0, 1),)), 2, predicted_differences),
    (ArrivalAngles(0.05, 0.1, dropout=0.3, depth=2), 3, predicted_angles),
    (AnchorRanging(ANCHORS, RangeNoise(0.3, dropout=0.3), TAGS), 3, predicted_anchors),
    (AnchorRanging(PLANE_ANCHORS, RangeNoise(0.3), PLANE_TAGS, radius=7.0), 2, predicted_anchors),
    (AnchorRanging(ANCHORS), 3, predicted_anchors),
    (Ranging(RangeNoise(0.3, dropout=0.3), TAGS), 3, predicted_ranges),
    (Ranging(RangeNoise(0.3), PLANE_TAGS), 2, predicted_ranges),
    (Ranging(), 3, predicted_ranges),
    (LandmarkBearings(5, 0.15, 0.02, share=0.6, depth=2), 2, predicted_bearings),
    (UavBearings(0.15, 0.02, share=0.6, depth=2), 2, predicted_uav_bearings),
]


@pytest.mark.parametrize("case", CASES, ids=[f"{type(s).__name__}-{d}d" for s, d, _ in CASES])
def test_information_is_that_of_the_log_likelihood(case: tuple[Sensor, int, Callable]) -> None:
    """Hᵀ R⁻¹ H with H by automatic differentiation at ⊞ 0, over the whole team."""
    sensor, dim, predicted = case
    truth, seen = first_step(scenario(sensor, dim=dim, motion=RandomVelocity()))
    tilt = torch.tensor([0.3, -0.2, 0.5][: 3 if dim == 3 else 1], dtype=torch.float64)
    truth = replace(truth, attitude=rotate_by(truth.attitude, tilt.expand(1, N, -1)))
    d = 6 if dim == 3 else 3

    def expect(delta: Tensor) -> tuple[Tensor, Tensor]:
        near = Kinematics(
            truth.position + delta[..., :dim],
            truth.velocity,
            rotate_by(truth.attitude, delta[..., dim:]),
        )
        mean, weight = predicted(sensor, near, seen)
        return mean.flatten(), weight.flatten()

    zero = torch.zeros(1, N, d, dtype=torch.float64)
    jacobian, weights = torch.func.jacfwd(expect, has_aux=True)(zero)
    jacobian = jacobian.reshape(-1, N * d)
    assert (weights > 0).any()
    wanted = (jacobian.mT @ (weights.unsqueeze(-1) * jacobian)).unflatten(1, (N, d))
    if sensor.between_uavs:
        found = shared_information(sensor, truth, seen)[0].flatten(0, 1)
    else:
        own = own_information(sensor, truth, seen)[0]
        found = torch.block_diag(*own).unflatten(1, (N, d))
    torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-6)


def test_information_of_flow_is_that_of_its_log_likelihood() -> None:
    """Hᵀ R⁻¹ H about pose and velocity, by automatic differentiation."""
    sensor = OpticalFlow(0.2)
    truth, _ = first_step(scenario(sensor, motion=RandomVelocity()))
    tilt = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    q = rotate_by(truth.attitude[0], tilt.expand(N, 3))
    truth = replace(truth, attitude=q.unsqueeze(0))
    seen = Observation({"flow_mask": torch.tensor([[[1.0], [0.0], [1.0]]])})

    def flow(delta: Tensor, i: int) -> Tensor:
        return unrotate(rotate_by(q[i], delta[3:6]), truth.velocity[0, i] + delta[6:9])[:2]

    found = motion_information(sensor, truth, seen)[0]
    for i in range(N):
        h = torch.func.jacfwd(flow)(torch.zeros(9, dtype=torch.float64), i)
        assert h.abs().max() > 0.5
        wanted = float(seen["flow_mask"][0, i]) * h.mT @ h / 0.2**2
        torch.testing.assert_close(found[i], wanted, rtol=1e-9, atol=1e-9)


def test_flow_sharpens_the_bound_by_the_velocity_that_it_shows() -> None:
    """In an upright, standing team with a constant velocity, as a direct measurement of it."""
    process = ConstantVelocity(accel_std=0.5)
    places = ((3.0, 3.0, 1.0), (6.0, 3.0, 1.0))
    quick = {"process": process, "n": 2, "motion": standing(*places)}
    fix = PositionFix(1.0, count=2)
    flow = posterior_bound(scenario(fix, OpticalFlow(0.1), **quick), 2, steps=40)
    kalman = np.zeros((40, 3))
    prior = Prior()
    for axis in range(3):
        p = np.diag([prior.position_std**2, prior.velocity_spread**2])
        f = np.array([[1, 0.1], [0, 1]])
        q = 0.25 * np.array([[0.1**3 / 3, 0.005], [0.005, 0.1]])
        for k in range(40):
            if k:
                p = f @ p @ f.T + q
            rows = [(np.array([1.0, 0.0]), 1.0)]
            if axis < 2:
                rows.append((np.array([0.0, 1.0]), 0.1))
            information = np.linalg.inv(p) + sum(np.outer(h, h) / s**2 for h, s in rows)
            p = np.linalg.inv(information)
            kalman[k, axis] = p[0, 0]
    assert flow.position[:, 0].numpy() == pytest.approx(np.sqrt(kalman.sum(1)), rel=1e-6)


def test_false_matches_inform_of_the_landmark_they_show() -> None:
    """Where all L are seen, each is shown once on average; else the far ones are shown as well. The
    position's part is the same for all. A single landmark cannot be mistaken."""
    clean = Landmarks(4, positions=CORNERS)
    mixed = Landmarks(4, positions=CORNERS, false_matches=0.3)
    truth, seen = first_step(scenario(clean))
    torch.testing.assert_close(
        own_information(mixed, truth, seen), own_information(clean, truth, seen)
    )
    truth, seen = first_step(scenario(replace(clean, radius=5.0)))
    assert 0 < seen["landmark_mask"].mean() < 1
    a, b = (own_information(s, truth, seen) for s in (clean, mixed))
    torch.testing.assert_close(a[..., :3, :3], b[..., :3, :3])
    assert not torch.allclose(a, b, rtol=1e-3)
    truth, seen = first_step(scenario(Landmarks(1)))
    a, b = (own_information(Landmarks(1, false_matches=x), truth, seen) for x in (0.0, 0.3))
    torch.testing.assert_close(a, b)


def test_blocked_anchors_inform_as_those_that_are_never_in_sight() -> None:
    """And the others as ever."""
    error = RangeNoise(0.3, nlos=0.2)

    def informed(sensor: AnchorRanging) -> Tensor:
        truth, seen = first_step(scenario(sensor))
        return own_information(sensor, truth, seen)

    found = informed(AnchorRanging(ANCHORS, error, blocked=(1,)))
    never = informed(AnchorRanging(ANCHORS[1:2], replace(error, nlos=1.0)))
    others = informed(AnchorRanging((ANCHORS[0], ANCHORS[2]), error))
    torch.testing.assert_close(found, never + others)
    assert (found - informed(AnchorRanging(ANCHORS, error))).abs().max() > 0.1


def test_a_top_speed_is_a_uniform_velocity() -> None:
    task = scenario(dim=2, prior=Prior(velocity_std=7.0, kind="uniform", max_speed=3.0))
    variances = prior_covariance(error_model(task), task).diagonal()
    torch.testing.assert_close(variances, torch.tensor([100 / 12, 64 / 12, 3.0, 3.0]).double())


def test_slots_of_neighbours_tell_the_same_as_a_slot_for_each() -> None:
    dense = scenario(Ranging(RangeNoise(dropout=0.3)), Landmarks(4), process=ConstantVelocity())
    sparse = replace(dense, network=Network(max_neighbours=N - 1))
    assert "neighbours" in first_step(sparse)[1]
    a, b = (posterior_bound(task, 2, steps=20).mse for task in (dense, sparse))
    torch.testing.assert_close(a, b)


def test_expectation_over_where_the_uav_may_be() -> None:
    """Mean of u uᵀ over many worlds' draws, against an integral over the circle of headings."""
    sensor = AnchorRanging(((5.0, 4.0),), RangeNoise(std=1.0))
    task = scenario(sensor, dim=2, n=1, motion=standing((7.0, 4.0)))
    runs, spread = 4000, 1.5
    world = World(task, runs)
    seen = world.reset(0)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.zeros(runs, 1, 4, dtype=torch.float64)
    drawn[..., :2] = spread * torch.randn(runs, 1, 2, generator=generator, dtype=torch.float64)
    pose = error_model(task).pose()
    own, shared = expected_information([sensor], world.truth, seen, drawn, pose)
    assert shared is None
    axis = np.linspace(-9, 9, 901)
    x, y = np.meshgrid(axis, axis)
    weight = np.exp(-0.5 * (x**2 + y**2) / spread**2)
    along = (2 + x) ** 2 / ((2 + x) ** 2 + y**2 + 1e-12)
    mean = (weight * along).sum() / weight.sum()
    found = own.mean((0, 1))
    assert found[:2, :2].numpy() == pytest.approx(np.diag([mean, 1 - mean]), abs=0.02)
    assert not found[2:].any()


# ---------------------------------------------------------------- the processes


def two_steps(task: Scenario) -> tuple[Kinematics, Kinematics]:
    world = World(task)
    world.reset(3)
    for _ in range(20):
        world.advance(torch.zeros(1, task.arena.n_uavs, 3 * task.arena.dim))
    before = world.truth
    world.advance(torch.zeros(1, task.arena.n_uavs, 3 * task.arena.dim))
    return before, world.truth


def test_inertial_transition_is_the_derivative_of_the_strapdown_update() -> None:
    """F and G = ∂/∂(white noise) of p, v and q errors after one step, for the first UAV."""
    imu = Imu(0.05, 0.01, accel_bias=0.1, gyro_bias=0.02)
    task = scenario(imu, process=Inertial())
    before, now = two_steps(task)
    dt, p, v, q = 0.1, before.position[0, 0], before.velocity[0, 0], before.attitude[0, 0]
    gravity = torch.tensor((0.0, 0.0, GRAVITY), dtype=torch.float64)
    force = unrotate(q, (now.velocity[0, 0] - v) / dt + gravity)
    rate = rotation_between(q, now.attitude[0, 0]) / dt
    assert rate.norm() > 0.1

    def strapdown(delta: Tensor, white: Tensor) -> Tensor:
        turned = quaternion_product(q, quaternion_exp(delta[6:9]))
        acceleration = rotate(turned, force - delta[9:12] + white[:3]) - gravity
        place = p + delta[:3] + (v + delta[3:6]) * dt + 0.5 * acceleration * dt**2
        speed = v + delta[3:6] + acceleration * dt
        after = quaternion_product(turned, quaternion_exp((rate - delta[12:] + white[3:]) * dt))
        straight = quaternion_product(q, quaternion_exp(rate * dt))
        turn = rotation_between(straight, after)
        return torch.cat((place, speed, turn, delta[9:]))

    zero, quiet = torch.zeros(15, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
    f, g = torch.func.jacfwd(strapdown, (0, 1))(zero, quiet)
    g = g * torch.tensor([0.05] * 3 + [0.01] * 3)
    found, noise_added = error_model(task).transition(before, now, Observation({}))
    torch.testing.assert_close(found[0, 0], f)
    torch.testing.assert_close(noise_added[0, 0], g @ g.mT, rtol=1e-6, atol=1e-15)
    unbiased = error_model(replace(task, sensors=(Imu(0.05, 0.01),)))
    found, noise_added = unbiased.transition(before, now, Observation({}))
    torch.testing.assert_close(found[0, 0], f[:9, :9])


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.0099, 0.0101, 2.0])
def test_attitude_errors_for_any_turn(angle: float) -> None:
    turn = angle * torch.tensor((0.6, -0.64, 0.48), dtype=torch.float64)

    def attitude(delta: Tensor) -> Tensor:
        started = quaternion_exp(delta[:3])
        moved = quaternion_product(started, quaternion_exp(turn + delta[3:]))
        return rotation_between(quaternion_exp(turn), moved)

    wanted = torch.func.jacfwd(attitude)(torch.zeros(6, dtype=torch.float64))
    eye = torch.eye(3, dtype=torch.float64)
    f, g = strapdown_jacobians(eye, torch.zeros(3, dtype=torch.float64), turn, 1.0)
    torch.testing.assert_close(torch.cat((f[6:, 6:], g[6:, 3:]), -1), wanted, rtol=1e-9, atol=1e-9)


def test_wheeled_transition_is_the_derivative_of_dead_reckoning() -> None:
    odometry = Odometry(0.02, 0.01, 0.03, relative=0.1)
    task = scenario(odometry, dim=2, process=Wheeled())
    before, now = two_steps(task)
    p, heading = before.position[0, 0], before.attitude[0, 0]
    moved = unrotate(heading, now.position[0, 0] - p)
    turned = rotation_between(heading, now.attitude[0, 0])

    def reckon(delta: Tensor, white: Tensor) -> Tensor:
        turn = heading + delta[2:]
        place = p + delta[:2] + rotate(turn, moved + white[:2])
        return torch.cat((place, turn + turned + white[2:]))

    zero = torch.zeros(3, dtype=torch.float64)
    f, g = torch.func.jacfwd(reckon, (0, 1))(zero, zero)
    g = g * odometry.std(torch.cat((moved, turned)) / 0.1) * 0.1
    found, added = error_model(task).transition(before, now, Observation({}))
    torch.testing.assert_close(found[0, 0], f)
    torch.testing.assert_close(added[0, 0], g @ g.mT)


def test_biases_are_states_where_the_truth_has_them() -> None:
    task = scenario(Imu(), Landmarks(8), process=Inertial())
    biased = replace(task, sensors=(Imu(accel_bias=0.1, gyro_bias=0.01), Landmarks(8)))
    known = replace(task, sensors=(Imu(accel_bias=1e-7), Landmarks(8)))
    plain, more, same = (posterior_bound(t, 2, steps=50) for t in (task, biased, known))
    assert more.rmse > 1.02 * plain.rmse
    assert same.rmse == pytest.approx(plain.rmse, rel=0.02)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ins", [Ins(0.5), Ins(0.5, 0.3, 4.0), Ins(0.0, 0.3, 60.0)])
def test_an_ins_alone_errs_as_its_noise_adds_up(ins: Ins, dim: int) -> None:
    """Variance of the sum of white noise and of a Gauss–Markov process, sample by sample."""
    task = scenario(ins, dim=dim, process=InsDriven(), prior=Prior(2.0))
    k = np.arange(1, 51)
    bias = ins.bias**2 * np.exp(-0.1 * np.abs(k[:, None] - k) / ins.bias_time)
    variance = 2.0**2 + 0.1**2 * (50 * ins.std**2 + bias.sum())
    bound = posterior_bound(task, 1, steps=51)
    assert bound.position[-1].numpy() == pytest.approx(np.sqrt(dim * variance))


def test_an_ins_with_fixes_is_bounded_by_the_kalman_filter_that_knows_its_bias() -> None:
    ins, fix = Ins(0.5, 0.3, 4.0), PositionFix(0.8, count=2)
    task = scenario(ins, fix, process=InsDriven(), prior=Prior(2.0))
    kept = np.exp(-0.1 / 4.0)
    f = np.array([[1.0, 0.1 * kept], [0.0, kept]])  # p₊ − p̂₊ where p̂ adds up what the INS says
    push, white = np.array([0.1, 1.0]), np.diag([(0.1 * 0.5) ** 2, 0.0])
    q = 0.09 * (1 - kept**2) * np.outer(push, push) + white
    covariance, expected = np.diag([4.0, 0.09]), []
    for step in range(40):
        if step:
            covariance = f @ covariance @ f.T + q
        gain = covariance[:, :1] / (covariance[0, 0] + 0.64)
        covariance = covariance - gain @ covariance[:1]
        expected.append(np.sqrt(3 * covariance[0, 0]))
    found = posterior_bound(task, 1, steps=40).position.numpy()
    assert found[:, 0] == pytest.approx(np.array(expected))
    assert found[:, 1] == pytest.approx(np.array(expected))
    assert found[-1, 2] > 2.0


# ---------------------------------------------------------------- noise of ranges


@pytest.mark.parametrize(
    "error",
    [RangeNoise(0.2), RangeNoise(0.2, dropout=0.5), RangeNoise(0.2, tail=1.0, tail_std=0.2),
     RangeNoise(0.2, nlos=1.0, nlos_kind="constant", nlos_bias=5.0)],
)  # fmt: skip
def test_gaussian_ranges_inform_with_their_precision(error: RangeNoise) -> None:
    assert range_information(error) == pytest.approx(25.0, rel=1e-9)


def information_by_quadrature(density: Callable[[float], float], low: float, high: float) -> float:
    def integrand(x: float) -> float:
        slope = (density(x + 1e-5) - density(x - 1e-5)) / 2e-5
        return slope**2 / density(x)

    return quad(integrand, low, high, limit=500, points=np.linspace(low, high, 20))[0]


def test_mixtures_against_quadrature() -> None:
    def tailed(x: float) -> float:
        return float(0.8 * norm.pdf(x, 0, 0.2) + 0.2 * norm.pdf(x, 0, 1.0))

    def late(x: float) -> float:
        return float(0.7 * norm.pdf(x, 0, 0.2) + 0.3 * exponnorm.pdf(x, 1.0 / 0.2, 0, 0.2))

    found = range_information(RangeNoise(0.2, tail=0.2, tail_std=1.0))
    assert found == pytest.approx(information_by_quadrature(tailed, -7, 7), rel=1e-4)
    found = range_information(RangeNoise(0.2, nlos=0.3, nlos_bias=1.0))
    assert found == pytest.approx(information_by_quadrature(late, -1.2, 20), rel=1e-3)
    edges = quad(lambda x: norm.pdf(x) ** 2 / norm.cdf(x), -30, 10)[0]  # only they inform
    flat = range_information(RangeNoise(0.05, uniform=1.0))
    assert flat == pytest.approx(edges / (0.05 * 1.0), rel=1e-6)


@pytest.mark.parametrize(
    "error",
    [
        RangeNoise(0.2, nlos=0.3, tail=0.1, uniform=0.3),
        RangeNoise(10.0, nlos=0.15, nlos_bias=25.0, nlos_kind="constant", impulse=0.05,
                   impulse_size=100.0),
        RangeNoise(0.1, nlos=0.5, nlos_bias=0.5, uniform=0.2, impulse=0.1, impulse_size=3.0),
    ],
)  # fmt: skip
def test_mixtures_against_samples(error: RangeNoise) -> None:
    """The density is that of the sensor's samples; the score's variance is the information."""
    count = 400_000
    keys = noise.fold(torch.zeros(count, dtype=torch.int64), torch.arange(count))
    samples = error.sample(torch.zeros(count), keys, "test")[0].double().numpy()
    errors, density, slope = error_density(error)
    step = errors[1] - errors[0]
    assert density.sum() * step == pytest.approx(1.0, abs=1e-9)
    below = (np.cumsum(density) - 0.5 * density) * step
    cumulated = np.interp(np.sort(samples), errors, below)
    assert np.abs(cumulated - np.linspace(0, 1, count)).max() < 0.004
    score = np.interp(samples, errors, slope) / np.interp(samples, errors, density)
    information = range_information(error)
    assert abs(score.mean()) < 5 * np.sqrt(information / count)
    assert (score**2).mean() == pytest.approx(information, rel=0.02)


def test_lasting_nlos_is_taken_as_known() -> None:
    fresh = RangeNoise(0.2, nlos=0.3, nlos_kind="constant")
    lasting = replace(fresh, nlos_time=2.0)
    assert range_information(lasting) == pytest.approx(25.0, rel=1e-6)
    exponential = RangeNoise(0.2, nlos=0.3, nlos_time=2.0)
    late = range_information(RangeNoise(0.2, nlos=1.0))
    assert range_information(exponential) == pytest.approx(0.7 * 25.0 + 0.3 * late, rel=1e-6)


def test_contamination_only_takes_information_away() -> None:
    clean = range_information(RangeNoise(0.2))
    for worse in ({"nlos": 0.3}, {"tail": 0.1}, {"uniform": 0.2}, {"impulse": 0.1}):
        assert 0.2 * clean < range_information(RangeNoise(0.2, **worse)) < clean
    assert range_information(RangeNoise(0.0)) == pytest.approx(1e12, rel=1e-6)
    assert np.isfinite(range_information(RangeNoise(0.0, impulse=0.1, uniform=1.0)))


# ---------------------------------------------------------------- the whole bound


def indoor(steps: int = 60, runs: int = 4, cooperative: bool = True, **overrides: object) -> Bound:
    task = make_scenario("indoor-v0", **overrides)
    return posterior_bound(task, runs, 11, steps, cooperative)


def test_indoor_bound_is_where_consistent_filters_end() -> None:
    bound = posterior_bound(make_scenario("indoor-v0"), runs=6, steps=200)
    assert 0.032 < bound.rmse_after(10.0) < 0.036
    assert bound.position.shape == (200, 6)
    assert bound.rmse > bound.rmse_after(10.0)


def test_cooperation_never_hurts() -> None:
    for overrides in ({}, {"landmarks": 3}, {"motion": "random", "nlos": 0.3}):
        together = indoor(**overrides)
        alone = indoor(**overrides, cooperative=False)
        assert (together.mse < 1.02 * alone.mse).all()  # each has draws of its own spread
        assert together.rmse < alone.rmse


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ({"landmarks": 20}, {"landmarks": 8}),
        ({"landmark_std": 0.1}, {}),
        ({"uwb_std": 0.1}, {}),
        ({}, {"nlos": 0.3}),
        ({}, {"landmark_dropout": 0.5}),
        ({}, {"uwb_dropout": 0.5}),
        ({"prior_std": 0.1}, {}),
        ({}, {"imu_bias": True}),
        ({"accel_std": 0.01}, {}),
        ({"n_uavs": 8}, {"n_uavs": 4}),
    ],
)
def test_more_knowledge_lowers_the_bound(better: dict, worse: dict) -> None:
    assert indoor(**better).rmse < indoor(**worse).rmse


def test_permuting_uavs_permutes_the_bound() -> None:
    positions = torch.tensor(((2.0, 2, 1), (6, 3, 2), (4, 6, 3)), dtype=torch.float64)
    order = [2, 0, 1]
    prior = Prior(0.01, 0.01, 0.001)  # the draws of the expectation are not permuted

    def bound(chosen: list[int]) -> Tensor:
        task = scenario(
            Imu(),
            Landmarks(4, positions=CORNERS),
            Ranging(tags=TAGS),
            process=Inertial(),
            prior=prior,
            motion=standing(*map(tuple, positions[chosen].tolist())),
        )
        return posterior_bound(task, 1, steps=30).mse

    torch.testing.assert_close(bound(order), bound([0, 1, 2])[..., order], rtol=1e-3, atol=0)


def test_runs_are_the_worlds_of_their_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    task = make_scenario("indoor-v0", n_uavs=3, landmark_dropout=0.5)
    three = posterior_bound(task, runs=3, seed=4, steps=10)
    last = posterior_bound(task, runs=1, seed=6, steps=10)
    torch.testing.assert_close(three.mse[2:], last.mse)
    monkeypatch.setattr(worlds, "_NUMBERS", 1)
    torch.testing.assert_close(posterior_bound(task, 3, 4, 10).mse, three.mse)


def test_masks_are_those_of_the_paired_worlds() -> None:
    """Without landmarks for a second the bound rises, and in each world as its own masks say."""
    bound = indoor(steps=40, range_only=(1.0, 2.0))
    same = indoor(steps=40)
    torch.testing.assert_close(bound.mse[:, :10], same.mse[:, :10])
    assert (bound.mse[:, 19] > 1.2 * same.mse[:, 19]).all()
    assert bound.position[19].mean() > bound.position[30].mean()


def test_failed_uavs_are_not_scored() -> None:
    task = make_scenario("indoor-v0", n_uavs=3)
    failing = posterior_bound(replace(task, failures=((1, 5),)), 2, steps=10)
    assert failing.position[5:, 1].isnan().all()
    assert failing.position[:, [0, 2]].isfinite().all()
    whole = posterior_bound(task, 2, steps=10)
    assert (failing.mse[:, 9, 0] > whole.mse[:, 9, 0]).all()
    assert np.isfinite(failing.rmse)


def test_recordings_are_bounded_as_their_sensors_are_described() -> None:
    """Series of the world's own leaves gives the world's bound."""
    sensors = (Landmarks(4, positions=CORNERS, dropout=0.3), Ranging(RangeNoise(dropout=0.3)))
    task = scenario(*sensors, motion=standing((2, 2, 1), (6, 3, 2), (4, 6, 3)))
    world = World(task, window=20)
    world.reset(0)
    leaves = world.sensed.leaves
    maps = {"landmark_map": world.static["landmark_map"][0, 0]}
    series = [{name: Series(leaves[name][0]) for name in s.leaves(task.layout)} for s in sensors]
    recorded = replace(
        task,
        sensors=(
            RecordedSensor(sensors[0], series[0], maps),
            RecordedSensor(sensors[1], series[1]),
        ),
    )
    a, b = (posterior_bound(t, 1, steps=20).mse for t in (task, recorded))
    torch.testing.assert_close(a, b)


def test_exact_knowledge_is_no_trouble() -> None:
    certain = replace(make_scenario("indoor-v0"), prior=Prior(0.0, 0.0, 0.0))
    assert posterior_bound(certain, 1, steps=3).position[0].max() < 1e-5
    assert indoor(steps=20, landmark_std=0.0, uwb_std=0.0).rmse < 1e-5
    assert np.isfinite(indoor(steps=100, landmarks=0, imu_bias=True, prior="uniform").rmse)


def test_what_cannot_be_bounded_is_refused() -> None:
    class Magnetometer(Height):
        pass

    class Unheard(Sensor):
        leaves = Height.leaves
        sample = Height.sample
        std, dropout, bias_std = 0.1, 0.0, 0.0

    with pytest.raises(NotImplementedError, match="Unheard"):
        posterior_bound(scenario(Unheard()), 1, steps=1)
    assert posterior_bound(scenario(Magnetometer()), 1, steps=1).rmse > 0
    with pytest.raises(ValueError, match="Inertial needs the sensor Imu"):
        posterior_bound(scenario(process=Inertial()), 1, steps=1)
    with pytest.raises(ValueError, match="InsDriven needs the sensor Ins"):
        posterior_bound(scenario(process=InsDriven()), 1, steps=1)
    for wrong in ({"runs": 0}, {"steps": 0}, {"steps": 1001}):
        with pytest.raises(ValueError, match="not allowed"):
            posterior_bound(scenario(), **wrong)
