"""Maps that a team makes, against a known map, scipy's least squares, and one another."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from agents import make
from agents.slam.maps import uniform
from agents.slam.slam import MapBelief, Slam
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import UnmappedLandmarks
from coloc_env.world import World


def unknown(**overrides: Any) -> Scenario:
    return make_scenario("indoor-v0", landmarks_known=False, **{"landmarks": 8} | overrides)


def true_map(world: World) -> torch.Tensor:
    sensor = next(s for s in world.scenario.sensors if isinstance(s, UnmappedLandmarks))
    keys = world._keys  # privileged
    return sensor.true_map(keys, world.scenario.layout)


def run(name: str, scenario: Scenario, seeds: list[int], steps: int, known: bool = False):
    """Errors [K, B, N, d], squared Mahalanobis distances [K, B, N], last belief and true map."""
    world, localizer = World(scenario, len(seeds)), make(name, scenario)
    seen = world.reset(seeds)
    belief: Any = localizer.reset(seen)
    if known:
        belief = informed(belief, true_map(world))
    errors, distances = [], []
    for _ in range(steps):
        belief, estimate = localizer.step(belief, seen)
        apart = estimate.position.double() - world.truth.position
        errors.append(apart)
        solved = torch.linalg.solve(estimate.covariance.double(), apart)
        distances.append((apart * solved).sum(-1))
        world.advance(estimate.action())
        seen = world.observation()
    where = true_map(world) if isinstance(localizer, Slam) else None
    return torch.stack(errors), torch.stack(distances), belief, where


def informed(belief: MapBelief, places: torch.Tensor) -> MapBelief:
    """As if the map were known to a tenth of a millimetre."""
    size = places[0].numel()
    covariance = belief.covariance.clone()
    covariance[..., -size:, -size:] = 1e-8 * torch.eye(size, dtype=torch.float64)
    landmarks = places.unsqueeze(1).expand_as(belief.landmarks)
    return belief.replace(
        landmarks=landmarks, covariance=covariance, found=torch.ones_like(belief.found)
    )


def test_with_the_map_it_is_the_joint_filter() -> None:
    overrides = {"anchors": 2, "n_uavs": 3, "prior_std": 0.3}
    errors, *_ = run("slam_central:iterations=2", unknown(**overrides), [5, 9], 12, known=True)
    others, *_ = run("ekf_joint", make_scenario("indoor-v0", landmarks=8, **overrides), [5, 9], 12)
    torch.testing.assert_close(errors, others, rtol=0, atol=2e-4)


def test_with_the_map_each_alone_is_a_filter_of_its_own() -> None:
    overrides = {"anchors": 2, "n_uavs": 3, "prior_std": 0.3, "uwb": False}
    known, *_ = run("ekf", make_scenario("indoor-v0", landmarks=8, **overrides), [5], 8)
    for maps in ("own", "shared"):
        scenario = unknown(**overrides)
        errors, *_ = run(f"slam:maps={maps}:iterations=2", scenario, [5], 8, known=True)
        torch.testing.assert_close(errors, known, rtol=0, atol=3e-4)


@pytest.mark.parametrize("name", ["slam_central", "slam"])
def test_a_first_step_is_scipys_least_squares(name: str) -> None:
    """Poses and landmarks of one step, all residuals whitened and given to scipy at once."""
    scenario = unknown(n_uavs=2, landmarks=5, uwb=False, landmark_radius=40.0)
    world = World(scenario)
    seen = world.reset(3)
    localizer = make(f"{name}:iterations=12", scenario)
    assert isinstance(localizer, Slam)
    before = localizer.reset(seen)
    belief, _ = localizer.step(before, seen)
    for group in ([0, 1],) if localizer.centralized else ([0], [1]):
        mean, spread = least(localizer, before, seen, group)
        got = belief.landmarks[0, group[0]].numpy().ravel()
        np.testing.assert_allclose(got, mean[-15:], atol=2e-4)
        rows = belief.covariance[0, group[0]]
        np.testing.assert_allclose(rows[-15:, -15:].numpy(), spread[-15:, -15:], rtol=0.02)
        for k, i in enumerate(group):
            np.testing.assert_allclose(belief.state[0, i, :3], mean[9 * k : 9 * k + 3], atol=2e-4)


def least(localizer: Slam, prior: MapBelief, seen: Observation, group: list[int]):
    """Mean (positions and map absolute, all else as errors) and covariance by scipy."""
    process = localizer.process
    start = prior.state[0, group]
    roots = [np.linalg.cholesky(process.initial(seen["prior"].double())[1][0, i]) for i in group]
    middle, size = prior.landmarks[0, 0].numpy().ravel(), 15
    deviation = np.sqrt(uniform(localizer.believed.arena, 5, start)[1].numpy())
    z, mask = (leaf[0, group] for leaf in localizer.vectors.read(seen, 3))

    def residuals(delta: np.ndarray) -> np.ndarray:
        poses = torch.tensor(delta[:-size]).view(len(group), -1)
        x = process.boxplus(start, poses)
        rotation, landmarks = process.rotation(x), torch.tensor(middle + delta[-size:]).view(-1, 3)
        off = (z.double() - (landmarks - x[:, None, :3]) @ rotation) / 0.15
        priors = [np.linalg.solve(root, p) for root, p in zip(roots, poses.numpy(), strict=True)]
        return np.concatenate((*priors, delta[-size:] / deviation, off[mask].numpy().ravel()))

    solved = least_squares(residuals, np.zeros(9 * len(group) + size), xtol=1e-13, ftol=1e-13)
    mean = solved.x.copy()
    mean[-size:] += middle
    for k in range(len(group)):
        mean[9 * k : 9 * k + 3] += start[k, :3].numpy()
    return mean, np.linalg.inv(solved.jac.T @ solved.jac)


def test_shared_maps_hold_what_one_map_of_the_team_does() -> None:
    """Without ranges, and with maps that take a step to arrive, both are nearly one estimate."""
    scenario = unknown(n_uavs=3, uwb=False, anchors=4, prior_std=0.5)
    (team, _, _, _), (shared, *_), (own, *_) = (
        run(name, scenario, [1], 18) for name in ("slam_central", "slam", "slam:maps=own")
    )
    late = slice(5, None)
    between = float((team - shared)[late].norm(dim=-1).mean())
    alone = float((team - own)[late].norm(dim=-1).mean())
    assert between < 0.35 * alone


def test_a_team_with_anchors_finds_itself_and_the_map() -> None:
    errors, distances, belief, places = run("slam_central", unknown(anchors=4, n_uavs=3), [0], 50)
    assert float(errors[30:].norm(dim=-1).square().mean().sqrt()) < 0.3
    assert float(distances.mean()) < 9
    found = belief.found[:, 0]
    apart = (belief.landmarks[:, 0] - places).norm(dim=-1)[found]
    assert int(found.sum()) > 5
    assert float(apart.square().mean().sqrt()) < 0.6


def test_nothing_says_where_landmarks_are() -> None:
    world = World(unknown())
    seen = world.reset(0)
    assert "landmark_map" not in seen
    assert torch.equal(
        seen["landmarks"], World(make_scenario("indoor-v0", landmarks=8)).reset(0)["landmarks"]
    )


def test_who_cannot_is_refused() -> None:
    with pytest.raises(ValueError, match="slam: the team has no landmarks to map"):
        make("slam", make_scenario("indoor-v0", anchors=4, landmarks=0))
    with pytest.raises(ValueError, match="slam_central: each UAV needs a slot for every other"):
        make("slam_central", unknown(n_uavs=20))
    with pytest.raises(
        ValueError, match=r"UnmappedLandmarks would be ignored; these use it: .*slam"
    ):
        make("gn", unknown(anchors=4))
    assert make("slam:maps=own", unknown(n_uavs=20)).name == "slam"
