"""The FIR filter: least squares over its window, sure of what it knows, without a past."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.linalg import lstsq
from torch import Tensor

from agents import make
from agents.kalman.emvf import MinimumVarianceFir
from coloc_env.motion import Arena
from coloc_env.observation import Observation
from coloc_env.scenario import ConstantVelocity
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import AnchorRanging, Imu, RangeNoise
from tests.sampling import first_fast

DT = 0.5
KNOWN = 1e-10  # information that stands for none

some = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


# ---------------------------------------------------------------- a linear world


@dataclass(frozen=True)
class Problem:
    """Fixes [M, d] of one UAV in a window, those that are missing NaN; F, and Q = G Gᵀ."""

    f: np.ndarray
    g: np.ndarray
    z: np.ndarray
    std: float

    @property
    def there(self) -> np.ndarray:
        return ~np.isnan(self.z[:, 0])


def motion(dim: int, q: float, held: bool) -> tuple[np.ndarray, np.ndarray]:
    """F, and a root of filterpy's Q (held acceleration), or of the integral of white noise."""
    f = np.kron(np.array([[1.0, DT], [0.0, 1.0]]), np.eye(dim))
    if held:
        return f, np.kron(q**0.5 * np.array([[0.5 * DT**2], [DT]]), np.eye(dim))
    white = q * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    return f, np.kron(np.linalg.cholesky(white), np.eye(dim))


def least_squares(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """State at the window's end and its covariance: the initial state and all process noises are
    unknown, the latter measured to be zero."""
    f, g = problem.f, problem.g
    size, noises = g.shape
    steps, d = problem.z.shape
    unknowns = size + (steps - 1) * noises
    state = np.eye(size, unknowns)  # x_j as a linear map of the unknowns
    rows, target = [], []
    for j in range(steps):
        if j:
            state = f @ state
            at = size + (j - 1) * noises
            state[:, at : at + noises] += g
        if problem.there[j]:
            rows.append(state[:d] / problem.std)
            target.append(problem.z[j] / problem.std)
    quiet = np.eye(unknowns)[size:]
    a, b = np.concatenate([*rows, quiet]), np.concatenate([*target, np.zeros(len(quiet))])
    found, _, rank, _ = lstsq(a, b)
    assert rank == unknowns
    return state @ found, state @ np.linalg.inv(a.T @ a) @ state.T


def kalman(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """filterpy's Kalman filter over the window, which knows nothing at its start."""
    d, size = problem.z.shape[1], len(problem.f)
    one = KalmanFilter(dim_x=size, dim_z=d)
    one.F, one.Q = problem.f, problem.g @ problem.g.T
    one.H, one.R = np.eye(d, size), problem.std**2 * np.eye(d)
    one.P = 1e8 * np.eye(size)
    for j, z in enumerate(problem.z):
        if j:
            one.predict()
        if problem.there[j]:
            one.update(z.reshape(-1, 1))
    return one.x[:, 0], one.P


def observed(z: Tensor, there: Tensor, dim: int) -> Observation:
    """What UAVs see whose fixes are z [B, N, d]."""
    prior = torch.zeros(*z.shape[:2], 3 * dim + 2 + (4 if dim == 3 else 1))
    prior[..., -dim - 2 :] = 1.0
    return Observation({"prior": prior, "fix": z.float(), "fix_mask": there.float().unsqueeze(-1)})


def linear(
    tools: SimpleNamespace, memory: int, dim: int, q: float, held: bool, **options: Any
) -> MinimumVarianceFir:
    """The filter in a linear world, where fixes are all that is measured."""
    believed = replace(
        tools.linear.believed,
        arena=Arena(dim, 3, DT, (-50.0,) * dim, (50.0,) * dim),
        process=ConstantVelocity(q**0.5, held=held),
    )
    models = mock.Mock(return_value=[tools.linear.fixes])
    with mock.patch("agents.kalman.emvf.make_measurements", models):
        localizer = make("emvf", believed, memory=memory, **options)
    assert isinstance(localizer, MinimumVarianceFir)
    localizer.leaves = ["fix", "fix_mask"]
    return localizer


@some
@given(
    seed=st.integers(0, 2**31),
    memory=st.integers(2, 7),
    dim=st.sampled_from([2, 3]),
    q=st.floats(0.01, 10),
    held=st.booleans(),
)
def test_it_is_the_least_squares_solution_and_the_kalman_filter_of_the_window(
    seed: int,
    memory: int,
    dim: int,
    q: float,
    held: bool,
    tools: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever was measured, also if a third is missing; state and covariance, from the first
    window that tells both position and velocity."""
    monkeypatch.setattr("agents.kalman.emvf._NOTHING", KNOWN)
    generator = torch.Generator().manual_seed(seed)
    steps, uavs = memory + 3, 3
    z = (3 * torch.randn(steps, 1, uavs, dim, generator=generator)).float()
    there = torch.rand(steps, 1, uavs, generator=generator) < 0.67
    localizer, (f, g) = linear(tools, memory, dim, q, held), motion(dim, q, held)
    belief = localizer.reset(observed(z[0], there[0], dim))
    for k in range(steps):
        seen = observed(z[k], there[k], dim)
        belief, _ = localizer.step(belief, seen)
        state, covariance = (x[0].numpy() for x in localizer.gaussian(belief, seen))
        for i in range(uavs):
            window = slice(max(0, k + 1 - memory), k + 1)
            fixes = z[window, 0, i].double().numpy().copy()
            fixes[~there[window, 0, i].numpy()] = np.nan
            problem = Problem(f, g, fixes, tools.linear.fixes.std)
            if problem.there.sum() < 2:
                continue
            # 1e8 m², from which the Kalman filter starts, leave a trace.
            for reference, close in ((least_squares, 1e-6), (kalman, 1e-5)):
                x, p = reference(problem)
                spread = np.sqrt(np.diag(p))
                np.testing.assert_allclose((state[i] - x) / spread, 0 * x, atol=close)
                scale = np.outer(spread, spread)
                np.testing.assert_allclose(covariance[i] / scale, p / scale, atol=close)


def test_the_two_references_agree() -> None:
    """And one of them, for two fixes, with what is written on paper."""
    f, g = motion(2, 0.5, False)
    z = np.array([[1.0, 2.0], [1.5, 1.0]])
    problem = Problem(f, g, z, 0.8)
    x, p = least_squares(problem)
    np.testing.assert_allclose(x[:2], z[1], atol=1e-12)
    np.testing.assert_allclose(x[2:], (z[1] - z[0]) / DT, atol=1e-12)
    np.testing.assert_allclose(np.diag(p)[:2], 0.64, atol=1e-12)
    expected = 2 * 0.64 / DT**2 + 0.5 * DT / 3
    np.testing.assert_allclose(np.diag(p)[2:], expected, atol=1e-12)
    root = motion(2, 0.5, True)[1]
    held = Q_discrete_white_noise(2, DT, 0.5, block_size=2, order_by_dim=False)
    np.testing.assert_allclose(root @ root.T, held, atol=1e-15)
    more = Problem(f, g, np.array([[1.0, 2.0], [np.nan] * 2, [1.5, 1.0], [0.0, 4.0]]), 0.8)
    for one, other in zip(least_squares(more), kalman(more), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)


def test_in_a_linear_world_once_is_enough(tools: SimpleNamespace) -> None:
    g = torch.Generator().manual_seed(0)
    z, there = 3 * torch.randn(5, 2, 3, 2, generator=g), torch.ones(5, 2, 3)
    found = []
    for iterations in (1, 6):
        localizer = linear(tools, 3, 2, 1.0, True, iterations=iterations)
        seen = [observed(*each, 2) for each in zip(z, there, strict=True)]
        found.append(tools.replay(localizer, seen).position)
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-10)


# ---------------------------------------------------------------- as sure as it may be


def chi_square_band(dim: int, count: int) -> float:
    """Five standard deviations of the mean of ``count`` independent NEES."""
    return 5 * (2 * dim / count) ** 0.5


@pytest.mark.parametrize("memory", first_fast(3, 2, 5))
def test_errors_are_as_large_as_it_says(memory: int, tools: SimpleNamespace) -> None:
    """Windows overlap: only every M-th estimate counts as another sample."""
    runs, steps = 60, 96
    found = tools.score(f"emvf:memory={memory}", make_scenario("wsn-v0"), runs, steps)
    band = chi_square_band(2, runs * steps // memory)
    assert found.nees.mean() == pytest.approx(2, abs=band)
    assert tools.consistent(found.nees, 2) > 0.85
    for early in range(memory):
        assert found.nees[:, early].mean() == pytest.approx(2, abs=chi_square_band(2, runs))


def test_beliefs_that_are_wrong_show(tools: SimpleNamespace) -> None:
    """Case 2 believes in a 25th of the ranges' variance, case 3 in nine times as much."""
    sure, unsure = (
        tools.score("emvf", make_scenario("wsn-v0", case=case), 30, 60).nees.mean()
        for case in (2, 3)
    )
    assert sure == pytest.approx(50, rel=0.1)
    assert unsure == pytest.approx(2 / 9, rel=0.1)


@pytest.mark.parametrize("overrides", [{}, {"imu": False}, {"imu_bias": True}], ids=str)
def test_errors_in_space_are_as_large_as_it_says(overrides: dict, tools: SimpleNamespace) -> None:
    """Among anchors alone; with an IMU the attitude is what dead reckoning says."""
    room: dict[str, Any] = {"room": (20.0, 15.0, 12.0), "motion": "random", "n_uavs": 3}
    scenario = make_scenario("indoor-v0", anchors=8, landmarks=0, **room, **overrides)
    found = tools.score("emvf", scenario, 16, 30)
    assert found.nees.mean() == pytest.approx(3, abs=chi_square_band(3, 16 * 3 * 10))


CEILING = ((0.0, 0.0, 4.0), (10.0, 0.0, 4.0), (0.0, 8.0, 4.0), (10.0, 8.0, 4.0))


@pytest.mark.parametrize(("std", "most"), [(0.1, 0.3), (0.0, 0.002)])
def test_anchors_at_the_ceiling_are_enough(std: float, most: float, tools: SimpleNamespace) -> None:
    """Ranges to a plane do not tell its two sides apart: the room does."""
    sensors = (Imu(), AnchorRanging(CEILING, RangeNoise(std=std)))
    scenario = replace(tools.families["tags"](), sensors=sensors, believed_sensors=sensors)
    found = tools.score("emvf", scenario, 3, 15)
    assert found.rmse < most
    assert found.nees.mean() < 4


def test_differences_from_a_plane_through_the_room_are_refused() -> None:
    """Error before: 28 m with four anchors, 0.49 m with eight."""
    own = {"landmarks": 0, "uwb": False}
    with pytest.raises(ValueError, match="all 4 anchors lie in one plane"):
        make("emvf", make_scenario("indoor-v0", tdoa_anchors=4, **own))
    make("emvf", make_scenario("indoor-v0", tdoa_anchors=8, **own))


@pytest.mark.parametrize("name", ["emvf", "hpff"])
@pytest.mark.parametrize("std", [0.0, 0.1])
@pytest.mark.parametrize("anchors", [4, 6])
def test_a_plane_through_the_room_is_refused(name: str, std: float, anchors: int) -> None:
    """Error before: 7.8 to 12.3 m (hpff 411 m) without noise, 1.5 to 3.6 m with it."""
    overrides = {"landmarks": 0, "uwb_std": std}
    with pytest.raises(ValueError, match=f"all {anchors} anchors lie in one plane") as refused:
        make(name, make_scenario("indoor-v0", anchors=anchors, **overrides))
    assert "\n" not in str(refused.value)
    make(name, make_scenario("indoor-v0", anchors=anchors + 4, **overrides))
    make(name, make_scenario("indoor-v0", anchors=anchors, uwb_std=std))  # with landmarks


def test_a_longer_memory_is_a_smaller_error(tools: SimpleNamespace) -> None:
    """As long as the motion is what it is believed to be."""
    rmse = [
        tools.score(f"emvf:memory={memory}", make_scenario("wsn-v0"), 20, 40).rmse
        for memory in (2, 4, 8)
    ]
    assert rmse[1] < 0.9 * rmse[0]
    assert rmse[2] < 0.9 * rmse[1]


# ---------------------------------------------------------------- no past


def garbled(observation: Observation, seed: int, change: Any) -> Observation:
    """Other ranges, some of them missing."""
    g = torch.Generator().manual_seed(seed)
    leaves = {
        name: 10 * torch.rand(observation[name].shape, generator=g)
        for name in ("anchor_ranges", "anchor_range_mask")
    }
    leaves["anchor_range_mask"] = (leaves["anchor_range_mask"] > 3).float()
    return change(observation, **leaves)


@pytest.mark.parametrize("memory", [2, 3, 5])
def test_what_happened_before_the_window_is_forgotten(memory: int, tools: SimpleNamespace) -> None:
    scenario, first = make_scenario("wsn-v0", n_uavs=2), 5
    localizer = make("emvf", scenario, memory=memory)
    seen = tools.play(localizer, scenario, range(10), 12).observations
    other = [garbled(o, k, tools.change) if k < first else o for k, o in enumerate(seen)]
    plain, changed = tools.replay(localizer, seen), tools.replay(localizer, other)
    for k in range(first + memory - 1, 12):
        tools.assert_same(changed.estimates[k], plain.estimates[k])
    for k in range(first + memory - 1):
        assert not torch.equal(changed.position[k], plain.position[k])


def test_a_kidnapped_robot_is_found_again_after_a_window(tools: SimpleNamespace) -> None:
    runs, at, memory = 40, 20, 3
    scenario = make_scenario("wsn-v0", kidnap_at=at * 0.1)
    nees = tools.score(f"emvf:memory={memory}", scenario, runs, 60).nees.mean((0, 2))
    assert nees[at : at + memory - 1].min() > 20
    settled = torch.cat((nees[:at], nees[at + memory - 1 :]))
    assert settled.mean() == pytest.approx(2, abs=0.2)
    assert settled.max() < 2 + chi_square_band(2, runs)


def test_before_the_window_is_full_all_memories_are_the_same(tools: SimpleNamespace) -> None:
    scenario = make_scenario("wsn-v0", uwb_dropout=0.2)
    seen = tools.play(make("emvf", scenario), scenario, range(5), 6).observations
    short, long = (tools.replay(make("emvf", scenario, memory=m), seen) for m in (3, 6))
    torch.testing.assert_close(short.position[:3], long.position[:3], rtol=0, atol=1e-9)
    for one, other in zip(short.estimates[:3], long.estimates[:3], strict=True):
        torch.testing.assert_close(one.covariance, other.covariance, rtol=1e-9, atol=0)
    assert (short.position[3:] - long.position[3:]).abs().max() > 0.05


# ---------------------------------------------------------------- what is missing


def without(observation: Observation, anchors: list[int], change: Any) -> Observation:
    mask = observation["anchor_range_mask"].clone()
    mask[..., anchors] = 0.0
    return change(observation, anchor_range_mask=mask)


def test_with_nothing_measured_it_knows_nothing(tools: SimpleNamespace) -> None:
    """Not even that the robot is in the room."""
    scenario = make_scenario("wsn-v0")
    localizer = make("emvf", scenario)
    seen = tools.play(localizer, scenario, [1, 2], 8).observations
    silent = [without(o, [0, 1, 2, 3], tools.change) for o in seen]
    run = tools.replay(localizer, [*silent, *seen[:1]])
    for estimate in run.estimates[:-1]:
        assert (estimate.position == 5.0).all()
        assert estimate.velocity.abs().max() < 1e-9
        assert (torch.linalg.eigvalsh(estimate.covariance) > 1e5).all()
    assert (torch.linalg.eigvalsh(run.estimates[-1].covariance) < 0.1).all()


@pytest.mark.parametrize("left", [[], [1], [0, 1], [0, 2]], ids=str)
def test_what_ranges_do_not_tell_it_does_not_claim(left: list[int], tools: SimpleNamespace) -> None:
    """One anchor tells a distance; two, unless in line with the robot, a place and its mirror."""
    scenario = make_scenario("wsn-v0")
    localizer = make("emvf", scenario)
    seen = tools.play(localizer, scenario, range(4), 8).observations
    missing = [a for a in range(4) if a not in left]
    run = tools.replay(localizer, [without(o, missing, tools.change) for o in seen])
    for estimate in run.estimates:
        assert estimate.position.isfinite().all()
        assert estimate.velocity.isfinite().all()
        spread = torch.linalg.eigvalsh(estimate.covariance)
        assert (spread > 0).all()
        assert ((spread > 1e3).sum(-1) >= 2 - len(left)).all()


def test_a_range_now_and_then_is_enough(tools: SimpleNamespace) -> None:
    """Three ranges at three different steps are a position."""
    scenario = make_scenario("wsn-v0")
    localizer = make("emvf", scenario, memory=6)
    world = tools.play(localizer, scenario, range(10), 60)
    sparse = [
        without(o, [a for a in range(4) if a != k % 4], tools.change)
        for k, o in enumerate(world.observations)
    ]
    run = tools.replay(localizer, sparse)
    k = torch.arange(60, dtype=torch.float64)
    truth = torch.stack((2 + 0.06 * k, torch.full_like(k, 2.0)), -1)
    error = (run.position - truth[:, None, None]).norm(dim=-1)[10:]
    assert error.square().mean().sqrt() < 0.6


def test_of_two_tags_the_attitude_matters(tools: SimpleNamespace) -> None:
    """Lever arms turn with the attitude, which is dead reckoning's."""
    scenario = tools.families["tags"]()
    localizer = make("emvf", scenario)
    seen = tools.play(localizer, scenario, [3], 4).observations
    turned = []
    for o in seen:
        prior = o["prior"].clone()
        prior[..., 6:10] = prior[..., [7, 6, 9, 8]]  # half a turn about x
        turned.append(tools.change(o, prior=prior))
    plain, other = tools.replay(localizer, seen), tools.replay(localizer, turned)
    assert (plain.position - other.position).abs().max() > 0.05


# ---------------------------------------------------------------- alone


def test_it_looks_at_nobody_else(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", anchors=8, landmarks=0)
    localizer = make("emvf", scenario)
    assert not localizer.exchanges
    seen = tools.play(localizer, scenario, [0, 1], 5).observations
    g = torch.Generator().manual_seed(0)
    leaves = ("ranges", "range_mask", "messages", "message_mask", "links")
    changed = [
        tools.change(o, **{n: torch.rand(o[n].shape, generator=g).round() for n in leaves})
        for o in seen
    ]
    plain, other = tools.replay(localizer, seen), tools.replay(localizer, changed)
    for one, two in zip(plain.estimates, other.estimates, strict=True):
        tools.assert_same(one, two)


def test_it_needs_no_prior(tools: SimpleNamespace) -> None:
    """Without an attitude there is nothing that it takes from it."""
    scenario = make_scenario("wsn-v0")
    localizer = make("emvf", scenario)
    seen = tools.play(localizer, scenario, [0, 1], 5).observations
    lied = [tools.change(o, prior=o["prior"] + 0.5) for o in seen]
    plain, other = tools.replay(localizer, seen), tools.replay(localizer, lied)
    torch.testing.assert_close(plain.position, other.position, rtol=0, atol=1e-6)


def test_watching_is_stepping_without_the_estimate(tools: SimpleNamespace) -> None:
    for scenario in (make_scenario("wsn-v0"), tools.families["tags"]()):
        localizer = make("emvf", scenario)
        run = tools.play(localizer, scenario, [0, 1], 5)
        belief = run.beliefs[0]
        for k, seen in enumerate(run.observations):
            belief = localizer.advance(belief, seen)
            tools.assert_same(belief, run.beliefs[k + 1])
        state, covariance = localizer.gaussian(belief, run.observations[-1])
        d = scenario.arena.dim
        assert torch.equal(state[..., :d], run.estimates[-1].position)
        assert torch.equal(covariance[..., :d, :d], run.estimates[-1].covariance)


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("memory=1", "memory='1' is not allowed: a whole number from 2 to 1000"),
        ("memory=0", "memory='0'"),
        ("iterations=0", "iterations='0' is not allowed: a whole number ≥ 1"),
        ("memory=2.5", "memory='2.5' is not allowed: a whole number"),
        ("window=3", "unknown option 'window'.*memory"),
    ],
)
def test_options_that_make_no_sense(options: str, words: str) -> None:
    scenario = make_scenario("wsn-v0")
    with pytest.raises(ValueError, match=f"^emvf: .*{words}"):
        make(f"emvf:{options}", scenario)
