"""The bound of a snapshot against closed forms, automatic differentiation, ranks and estimators."""

import math
from dataclasses import replace
from typing import Any

import networkx
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import least_squares, minimize
from torch import Tensor

from coloc_env.bounds import SnapshotBound, posterior, posterior_bound, snapshot_bound, worlds
from coloc_env.bounds.snapshot import error_variance, position_mse
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Height, PositionFix, RangeNoise, Ranging, Sensor
from coloc_env.world import World

Links = list[tuple[int, int]]
TETRAHEDRON = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))


def team(**overrides: Any) -> Scenario:
    """A swarm, small and, unless asked otherwise, fully linked."""
    chosen: dict[str, Any] = {"n_uavs": 8, "anchor_share": 0.5, "comm_radius": None, "horizon": 10}
    return make_scenario("swarm-v0", **(chosen | overrides))


def mse(
    positions: NDArray[np.float64] | tuple,
    links: Links,
    anchors: int,
    std: float = 1.0,
    fix_std: float = 1e-5,
) -> NDArray[np.float64]:
    """The bound [N] for UAVs at given places, of which the first know where they are."""
    place = torch.as_tensor(np.array(positions), dtype=torch.float64).unsqueeze(0)
    n, dim = place.shape[1:]
    reach = torch.zeros(1, n, n)
    for i, j in links:
        reach[0, i, j] = reach[0, j, i] = 1.0
    seen = Observation(
        {
            "range_mask": reach,
            "position_fix_mask": (torch.arange(n) < anchors).float().view(1, n, 1),
        }
    )
    attitude = torch.zeros(1, n, 4 if dim == 3 else 1, dtype=torch.float64)
    attitude[..., 0] = float(dim == 3)
    truth = Kinematics(place, torch.zeros_like(place), attitude)
    sensors: list[Sensor] = [PositionFix(fix_std, max(anchors, 1)), Ranging(RangeNoise(std))]
    pose = torch.eye(6 if dim == 3 else 3, dim, dtype=torch.float64)
    return position_mse(sensors, truth, seen, pose)[0].numpy()


# ---------------------------------------------------------------- closed forms


@pytest.mark.parametrize("fix_std", [1e-5, 0.5])
def test_trilateration_with_one_anchor_more_than_dimensions(fix_std: float) -> None:
    """Σ u uᵀ = (d + 1)/d I in the centre of a regular simplex, hence d²/(d + 1) (σ² + σ_a²)."""
    solid = mse((*TETRAHEDRON, (0.0, 0.0, 0.0)), [(i, 4) for i in range(4)], 4, 0.3, fix_std)
    assert solid[4] == pytest.approx(9 / 4 * (0.09 + fix_std**2))
    angles = 2 * math.pi * np.arange(3) / 3
    corners = [(7 * math.cos(a), 7 * math.sin(a)) for a in angles]
    flat = mse((*corners, (0.0, 0.0)), [(i, 3) for i in range(3)], 3, 0.3, fix_std)
    assert flat[3] == pytest.approx(4 / 3 * (0.09 + fix_std**2))


def test_a_chain_adds_up_along_the_line() -> None:
    """Each UAV ranges to an anchor straight below and to the one before it: k σ² along the line and
    σ² across."""
    n = 6
    places = [(k, 0.0) for k in range(n)] + [(k - 1.0, 1.0) for k in range(n + 1)]
    below = [(k, n + 1 + k) for k in range(n)]
    before = [(n + k, n + 1 + k) for k in range(n)]
    assert mse(places, below + before, n + 1, 0.2)[n + 1 :] == pytest.approx(
        0.04 * (1 + np.arange(1, n + 1))
    )
    assert np.isinf(mse(places, below + before[1:], n + 1)[n + 1 :]).all()


def test_nothing_else_measured_leaves_the_fix() -> None:
    found = mse(TETRAHEDRON, [], 2, fix_std=0.7)
    assert found[:2] == pytest.approx(3 * 0.49)
    assert np.isinf(found[2:]).all()


# ---------------------------------------------------------------- information of the likelihood


def log_gauss(e: Tensor, mean: float, std: float) -> Tensor:
    return -0.5 * ((e - mean) / std) ** 2 - math.log(std * math.sqrt(2 * math.pi))


def log_late(e: Tensor, mean: float, std: float) -> Tensor:
    """Gaussian plus exponential noise."""
    z = (std / mean - e / std) / 2**0.5
    return torch.special.erfc(z).log() - e / mean + 0.5 * (std / mean) ** 2 - math.log(2 * mean)


def mix(a: Tensor, b: Tensor, share: float) -> Tensor:
    return torch.stack((a + math.log(1 - share), b + math.log(share))).logsumexp(0)


NOISES: dict[str, tuple[dict[str, Any], Any]] = {
    "gaussian": ({"nlos": 0.0}, lambda e: log_gauss(e, 0.0, 10.0)),
    "constant": (
        {"nlos": 0.15},
        lambda e: mix(log_gauss(e, 0.0, 10.0), log_gauss(e, 25.0, 10.0), 0.15),
    ),
    "exponential": (
        {"nlos": 0.5, "nlos_kind": "exponential"},
        lambda e: mix(log_gauss(e, 0.0, 10.0), log_late(e, 25.0, 10.0), 0.5),
    ),
    "tail": (
        {"nlos": 0.0, "uwb_tail": 0.5},
        lambda e: mix(log_gauss(e, 0.0, 10.0), log_gauss(e, 0.0, 50.0), 0.5),
    ),
}


@pytest.mark.parametrize("kind", NOISES)
def test_bound_is_the_inverse_of_the_expected_hessian(kind: str) -> None:
    """Of −E log p(ranges, fixes | positions), the expectation an integral over each error."""
    overrides, log_density = NOISES[kind]
    task = team(n_uavs=7, comm_radius=9_000.0, **overrides)
    world = World(task)
    linked = world.reset(3)["range_mask"][0].triu(1).bool()
    at = world.truth.position[0]
    assert 10 < linked.sum() < 21
    errors = torch.linspace(-300, 450, 751, dtype=torch.float64)
    weights = log_density(errors).exp()
    assert float(weights.sum()) == pytest.approx(1.0, abs=1e-5)

    def distances(p: Tensor) -> Tensor:
        first, second = linked.nonzero().unbind(1)
        return (p[first] - p[second]).norm(dim=-1)

    def expected(p: Tensor) -> Tensor:
        shift = (distances(at) - distances(p)).unsqueeze(1)
        ranges = -(weights * log_density(errors + shift)).sum()
        fixes = 0.5 * ((p - at)[: task.anchor_uavs] / 0.1).square().sum()
        return ranges + fixes

    hessian = torch.autograd.functional.hessian(expected, at).reshape(21, 21)
    wanted = hessian.inverse().diagonal().view(7, 3).sum(-1)
    found = snapshot_bound(task, 1, 3, steps=1).mse[0, 0]
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=0)


def test_attitude_that_is_unknown_counts() -> None:
    """Of a point seen in the body frame; three are needed then, else one."""

    def bound(count: int, imu: bool) -> SnapshotBound:
        task = make_scenario(
            "indoor-v0", n_uavs=2, uwb=False, imu=imu, landmarks=count, landmark_radius=100.0
        )
        return snapshot_bound(task, 2, steps=2)

    assert [bound(k, imu=True).share_localizable for k in (0, 1, 2, 3)] == [0.0, 0.0, 0.0, 1.0]
    assert bound(0, imu=False).share_localizable == 0.0
    assert bound(4, imu=False).rmse == pytest.approx(0.15 * math.sqrt(3 / 4))
    assert bound(4, imu=True).rmse > 0.15


def test_what_earlier_steps_would_tell_is_not_known() -> None:
    """NLOS that lasts is a mixture like any other to one who sees one step of it."""
    fresh, lasting = (snapshot_bound(team(nlos_time=t), 2, steps=2).mse for t in (None, 10.0))
    torch.testing.assert_close(lasting, fresh)


# ---------------------------------------------------------------- who is localizable


def by_ranks(positions: NDArray[np.float64], links: Links, anchors: int) -> NDArray[np.bool_]:
    """Whether any motion of the UAVs of a connected part, anchors held, that keeps all its ranges
    to first order moves each UAV: the null space of the rigidity matrix."""
    n, d = positions.shape
    found = np.arange(n) < anchors
    graph = networkx.Graph(links)
    graph.add_nodes_from(range(n))
    graph.remove_edges_from([(i, j) for i, j in links if i < anchors and j < anchors])
    free = graph.subgraph(range(anchors, n))
    for part in networkx.connected_components(free):
        order = {uav: k for k, uav in enumerate(sorted(part))}
        edges = [(i, j) for i, j in graph.edges if i in order or j in order]
        matrix = np.zeros((max(len(edges), 1), d * len(order)))
        for row, (i, j) in enumerate(edges):
            along = (positions[i] - positions[j]) / np.linalg.norm(positions[i] - positions[j])
            for uav, sign in ((i, 1.0), (j, -1.0)):
                if uav in order:
                    matrix[row, d * order[uav] : d * order[uav] + d] = sign * along
        motions = null_space(matrix, rcond=1e-9).reshape(len(order), -1)
        still = np.abs(motions).max(-1, initial=0.0) < 1e-6
        found[[*order]] = still
    return found


@pytest.mark.parametrize("dim", [2, 3])
def test_localizable_are_those_that_no_free_motion_moves(dim: int) -> None:
    """In 60 random graphs, from barely to densely linked."""
    rng = np.random.default_rng(dim)
    shares = []
    for trial in range(60):
        n, anchors = int(rng.integers(6, 25)), int(rng.integers(1, 6))
        positions = rng.uniform(0, 100, (n, dim))
        linked = rng.random((n, n)) < rng.uniform(0.1, 0.6)
        links = [(i, j) for i in range(n) for j in range(i) if linked[i, j]]
        found, wanted = (
            np.isfinite(mse(positions, links, anchors)),
            by_ranks(positions, links, anchors),
        )
        assert (found == wanted).all(), trial
        shares.append(wanted[anchors:].mean())
    assert 5 < sum(0 < share < 1 for share in shares) < 55


CORNERS = ((0.0, 0.0, 0.0), (10.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 10.0))
PARTS: dict[str, tuple[tuple, Links, list[bool]]] = {
    "three anchors": ((*CORNERS, (4, 5, 6)), [(0, 4), (1, 4), (2, 4)], [True]),
    "two anchors": ((*CORNERS, (4, 5, 6)), [(0, 4), (1, 4)], [False]),
    "in the anchors' plane": ((*CORNERS, (4, 5, 0)), [(0, 4), (1, 4), (2, 4)], [False]),
    "rigid, but tied to nothing": (
        (*CORNERS, (4, 5, 6), (7, 5, 6), (4, 8, 6), (4, 5, 9)),
        [(i, j) for j in range(5, 8) for i in range(4, j)],
        [False] * 4,
    ),
    "each needs the other": (
        (*CORNERS, (4, 5, 6), (8, 3, 2)),
        [(0, 4), (1, 4), (2, 5), (3, 5), (4, 5)],
        [False, False],
    ),
    "hanging on one that is sure": (
        (*CORNERS, (4, 5, 6), (8, 3, 2)),
        [(0, 4), (1, 4), (2, 4), (3, 4), (4, 5), (0, 5)],
        [True, False],
    ),
}


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_who_is_localizable_depends_on_no_scale(part: str, scale: float) -> None:
    """Nor on where the axes point, how good ranges are, or how good anchors."""
    positions, links, wanted = PARTS[part]
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turned = scale * (np.array(positions, dtype=float) @ turn + 50.0)
    for std, fix_std in ((scale, 1e-3 * scale), (1e-3, 10.0), (10.0, 1e-3)):
        found = mse(turned, links, 4, std, fix_std)[4:]
        assert np.isfinite(found).tolist() == wanted
    plain = mse(positions, links, 4, 0.1, 0.01)
    assert mse(turned, links, 4, 0.1, 0.01) == pytest.approx(plain, rel=1e-6)


def test_pseudoinverse_and_inverse_agree() -> None:
    """A part without a bound beside one that has it changes nothing for that one."""
    rng = np.random.default_rng(1)
    positions = rng.uniform(0, 100, (14, 3))
    links = [(i, j) for i in range(12) for j in range(i)]
    alone = mse(positions[:12], links, 4)
    beside = mse(positions, [*links, (12, 13), (11, 12)], 4)
    assert np.isfinite(alone).all()
    assert beside[:12] == pytest.approx(alone, rel=1e-9)
    assert np.isinf(beside[12:]).all()


def test_a_broken_swarm_is_no_trouble() -> None:
    task = make_scenario("swarm-v0", n_uavs=40, comm_radius=2_000.0, failure_rate=0.5, horizon=20)
    bound = snapshot_bound(task, 3)
    assert bound.mse.shape == bound.localizable.shape == (3, 20, 40)
    assert not bound.mse.isnan().any()
    assert not bound.scored[..., : task.anchor_uavs].any()
    assert 0 < bound.share_localizable < 1
    assert bound.rmse == torch.inf
    assert 3.0 < bound.rmse_localizable < torch.inf
    unlinked = snapshot_bound(make_scenario("swarm-v0", n_uavs=5, comm_radius=1.0), 1, steps=1)
    assert unlinked.share_localizable == 0.0
    assert math.isnan(unlinked.rmse_localizable)
    nobody = snapshot_bound(team(anchor_share=0.0), 1, steps=1)
    assert nobody.share_localizable == 0.0


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ({"nlos": 0.0}, {}),
        ({}, {"nlos": 0.5}),
        ({"nlos": 0.0}, {"nlos": 0.0, "uwb_tail": 0.5}),
        ({}, {"link_failure": 0.2}),
        ({"uwb_std": 5.0}, {}),
        ({"anchor_std": 0.1}, {"anchor_std": 20.0}),
    ],
)
def test_more_knowledge_lowers_the_bound(better: dict, worse: dict) -> None:
    a, b = (snapshot_bound(team(n_uavs=16, **x), 3, steps=3) for x in (better, worse))
    assert (a.mse <= (1 + 1e-9) * b.mse).all()
    assert a.rmse < b.rmse


# ---------------------------------------------------------------- what estimators attain


def efficiency(task: Scenario, runs: int, fit: Any) -> float:
    """Mean squared bound over mean squared error, over worlds of their own."""
    world = World(task, runs)
    seen, anchors = world.reset(torch.arange(runs)), task.anchor_uavs
    place, ranges = world.truth.position.numpy(), seen["ranges"].double().numpy()
    i, j = np.triu_indices(task.arena.n_uavs, 1)
    free = j >= anchors
    i, j = i[free], j[free]
    bound = snapshot_bound(task, runs, steps=1)
    squared = 0.0
    for true, measured in zip(place, ranges, strict=True):

        def residual(x: NDArray[np.float64], true: Any = true, measured: Any = measured) -> Any:
            p = np.concatenate((true[:anchors], x.reshape(-1, 3)))
            return np.linalg.norm(p[i] - p[j], axis=-1) - measured[i, j]

        def jacobian(x: NDArray[np.float64], true: Any = true) -> Any:
            p = np.concatenate((true[:anchors], x.reshape(-1, 3)))
            along = (p[i] - p[j]) / np.linalg.norm(p[i] - p[j], axis=-1)[:, None]
            matrix, row = np.zeros((len(i), len(p), 3)), np.arange(len(i))
            matrix[row, i], matrix[row, j] = along, -along
            return matrix[:, anchors:].reshape(len(i), -1)

        found = fit(residual, jacobian, true[anchors:].ravel())
        squared += float(((found - true[anchors:].ravel()) ** 2).sum())
    return float(bound.mse[:, 0, anchors:].sum()) / squared


def test_maximum_likelihood_attains_the_bound_under_gaussian_noise() -> None:
    def fit(residual: Any, jacobian: Any, start: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(least_squares(residual, start, jacobian, x_scale=10.0).x)

    assert efficiency(team(n_uavs=12, nlos=0.0, anchor_std=0.0), 200, fit) == pytest.approx(
        1.0, abs=0.06
    )


def test_maximum_likelihood_comes_near_the_bound_under_nlos() -> None:
    """It needs many ranges per UAV to know which are NLOS; from the truth on, as a bound that is
    local wants."""

    def fit(residual: Any, jacobian: Any, start: NDArray[np.float64]) -> NDArray[np.float64]:
        def loss(x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
            e = -residual(x)
            direct = 0.85 * np.exp(-0.5 * (e / 10) ** 2)
            late = 0.15 * np.exp(-0.5 * ((e - 25) / 10) ** 2)
            density = direct + late
            slope = (direct * e + late * (e - 25)) / 100 / density
            return -np.log(density).sum(), -slope @ jacobian(x)

        return np.asarray(minimize(loss, start, jac=True, method="BFGS", tol=1e-4).x)

    found = efficiency(team(n_uavs=40, anchor_share=0.8, anchor_std=0.0), 80, fit)
    assert 0.9 < found < 1.06


# ---------------------------------------------------------------- beside the posterior bound


def at_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """The posterior bound with its information where the snapshot's is."""
    whole = posterior.expected_information
    monkeypatch.setattr(
        posterior,
        "expected_information",
        lambda sensors, truth, seen, drawn, *rest: whole(sensors, truth, seen, 0 * drawn, *rest),
    )


@pytest.mark.parametrize("overrides", [{}, {"comm_radius": 2_500.0}, {"link_failure": 0.6}])
def test_prior_and_motion_only_add(monkeypatch: pytest.MonkeyPatch, overrides: dict) -> None:
    at_the_truth(monkeypatch)
    task = make_scenario("swarm-v0", n_uavs=40, horizon=12, **overrides)
    whole, now = posterior_bound(task, 2), snapshot_bound(task, 2)
    assert (whole.mse <= (1 + 1e-9) * now.mse).all()
    assert now.localizable.any()


def test_a_prior_that_says_nothing_leaves_the_snapshot(monkeypatch: pytest.MonkeyPatch) -> None:
    at_the_truth(monkeypatch)
    task = make_scenario("swarm-v0", n_uavs=60, comm_radius=4_000.0, prior_std=1e6, horizon=5)
    whole, now = posterior_bound(task, 3, steps=1), snapshot_bound(task, 3, steps=1)
    sharp = now.mse < 100.0**2
    assert sharp.double().mean() > 0.8
    torch.testing.assert_close(whole.mse[sharp], now.mse[sharp], rtol=1e-3, atol=0)
    assert (whole.mse[~now.localizable] > 1e5**2).all()


def test_posterior_is_below_the_snapshot_as_both_are_reported() -> None:
    task = make_scenario("swarm-v0", n_uavs=40, horizon=12)
    whole, now = posterior_bound(task, 2), snapshot_bound(task, 2)
    assert torch.equal(whole.scored, now.scored)
    assert whole.rmse < now.rmse
    assert (whole.mse < 1.02 * now.mse)[now.scored].double().mean() > 0.999


# ---------------------------------------------------------------- seeds, blocks, refusals


def test_runs_are_the_worlds_of_their_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    task = make_scenario("swarm-v0", n_uavs=30, comm_radius=3_000.0)
    three = snapshot_bound(task, 3, 4, steps=4)
    last = snapshot_bound(task, 1, 6, steps=4)
    assert 0 < three.share_localizable < 1
    torch.testing.assert_close(three.mse[2:], last.mse)
    monkeypatch.setattr(worlds, "_NUMBERS", 1)
    torch.testing.assert_close(snapshot_bound(task, 3, 4, steps=4).mse, three.mse)


def test_what_cannot_be_bounded_is_refused() -> None:
    for wrong in ({"runs": 0}, {"steps": 0}, {"steps": 11}):
        with pytest.raises(ValueError, match=r"snapshot_bound: runs=.* not allowed: .* 1 to 10"):
            snapshot_bound(team(), **wrong)
    unknown = make_scenario("indoor-v0", n_uavs=1)

    class Unheard(Sensor):
        leaves = Height.leaves
        sample = Height.sample
        std, dropout, bias_std = 0.1, 0.0, 0.0

    odd = replace(unknown, sensors=(*unknown.sensors, Unheard()))
    with pytest.raises(NotImplementedError, match="Unheard"):
        snapshot_bound(odd, 1, steps=1)


def test_variances_of_a_known_matrix() -> None:
    """Units of any size, a block of them that is singular."""
    units = torch.tensor([1e-4, 1e-4, 1e5, 1e5], dtype=torch.float64)
    regular = torch.tensor([[2.0, 1.0], [1.0, 2.0]], dtype=torch.float64)
    singular = torch.ones(2, 2, dtype=torch.float64)
    matrix = torch.block_diag(regular, singular) * units * units.unsqueeze(1)
    found = error_variance(matrix.unsqueeze(0), 2, 2)[0]
    assert found[:2].numpy() == pytest.approx(2 / 3 * 1e8)
    assert found[2:].isinf().all()
