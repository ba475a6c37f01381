"""Pairing landmarks without names, against enumeration and optimal assignment."""

from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2, multivariate_normal
from torch import Tensor

from agents import make
from agents.association.candidates import Candidates
from agents.association.clutter import CLUTTER, log_mixture
from agents.association.joint import joint
from agents.association.nearest import nearest
from agents.errors import NotServed
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

GATE = 0.99
UNNAMED = {"association": "unknown"}


def problem(seed: int, measured: int, landmarks: int, spread: float = 0.4) -> Candidates:
    """One UAV that sees some of the landmarks, displaced as its prior allows, and a stray one."""
    rng = np.random.default_rng(seed)
    h = torch.zeros(1, 1, landmarks, 3, 6, dtype=torch.float64)
    h[..., :3] = -torch.eye(3, dtype=torch.float64)
    h[..., 3:] = torch.from_numpy(rng.normal(0, 3, (1, 1, landmarks, 3, 3)))
    root = torch.from_numpy(np.tril(rng.normal(0, spread, (6, 6))))
    root[3:] *= 0.1
    p = root @ root.T + 1e-4 * torch.eye(6, dtype=torch.float64)
    expected = torch.from_numpy(rng.uniform(-2, 2, (1, 1, landmarks, 3)))
    error = torch.linalg.cholesky(p) @ torch.from_numpy(rng.normal(size=6))
    seen = rng.permutation(landmarks)[:measured]
    z = (expected[0, 0] + h[0, 0] @ error)[seen] + 0.15 * torch.from_numpy(
        rng.normal(size=(measured, 3))
    )
    z[-1] += 1.0
    apart = z.unsqueeze(1) - expected[0, 0]
    s = h[0, 0] @ p @ h[0, 0].mT + 0.15**2 * torch.eye(3, dtype=torch.float64)
    squared = (apart * torch.linalg.solve(s.expand(measured, -1, -1, -1), apart)).sum(-1)
    mask = torch.ones(1, 1, measured, dtype=torch.bool)
    at = (z[None, None], mask, expected, h, p[None, None], 0.15**2)
    return Candidates(*at, squared[None, None], torch.logdet(s)[None, None])


def joint_distance(found: Candidates, names: list[int]) -> float:
    """Squared Mahalanobis distance of the stacked innovation of a set of pairings."""
    pairs = [(m, name) for m, name in enumerate(names) if name >= 0]
    if not pairs:
        return 0.0
    h = torch.cat([found.jacobian[0, 0, name] for _, name in pairs])
    r = torch.cat([found.z[0, 0, m] - found.expected[0, 0, name] for m, name in pairs])
    s = h @ found.covariance[0, 0] @ h.T + found.variance * torch.eye(len(r), dtype=r.dtype)
    return float(r @ torch.linalg.solve(s, r))


def compatible(found: Candidates, names: list[int]) -> bool:
    """By enumeration: no landmark twice, each pairing and all together within the gate."""
    used = [name for name in names if name >= 0]
    alone = all(
        found.squared[0, 0, m, name] <= chi2.ppf(GATE, 3)
        for m, name in enumerate(names)
        if name >= 0
    )
    within = not used or joint_distance(found, names) <= chi2.ppf(GATE, 3 * len(used))
    return len(set(used)) == len(used) and alone and within


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 3), st.integers(3, 4))
def test_joint_compatibility_accepts_what_enumeration_does(seed: int, m: int, count: int) -> None:
    found = problem(seed, m, count)
    names = joint(found, GATE, 8)[0, 0].tolist()
    assert compatible(found, names)
    every = [list(c) for c in product(range(-1, count), repeat=m) if compatible(found, list(c))]
    most = max(sum(name >= 0 for name in c) for c in every)
    assert sum(name >= 0 for name in names) <= most


def test_a_wide_enough_search_finds_the_best_set() -> None:
    """Of the most pairings, the ones with the smallest joint distance."""
    for seed in range(8):
        found = problem(seed, 3, 3)
        names = joint(found, GATE, 100)[0, 0].tolist()
        every = [list(c) for c in product(range(-1, 3), repeat=3) if compatible(found, list(c))]
        best = min(every, key=lambda c: (-sum(n >= 0 for n in c), joint_distance(found, c)))
        assert names == best


def test_joint_compatibility_refuses_what_fits_one_by_one() -> None:
    """A prior that is wide along one axis allows both vectors, but shifted to either side alone;
    nearest neighbour takes both."""
    expected = torch.tensor([[0.0, 0, 0], [10, 0, 0]], dtype=torch.float64)
    h = torch.zeros(1, 1, 2, 3, 6, dtype=torch.float64)
    h[..., :3] = torch.eye(3, dtype=torch.float64)
    p = torch.diag(torch.tensor([1.0, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4], dtype=torch.float64))
    z = expected + torch.tensor([[1.5, 0, 0], [-1.5, 0, 0]], dtype=torch.float64)
    s = torch.diag(p.diagonal()[:3] + 0.01)
    apart = z.unsqueeze(1) - expected
    squared = (apart**2 / s.diagonal()).sum(-1)
    mask = torch.ones(1, 1, 2, dtype=torch.bool)
    det = torch.logdet(s).expand(1, 1, 2)
    at = (z[None, None], mask, expected[None, None], h, p[None, None], 0.01)
    found = Candidates(*at, squared[None, None], det)
    assert nearest(found.squared, chi2.ppf(GATE, 3)).tolist() == [[[0, 1]]]
    assert sorted(joint(found, GATE, 8)[0, 0].tolist()) in ([-1, 0], [-1, 1])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_nearest_neighbours(seed: int) -> None:
    """Each landmark goes to the nearest of the vectors that are nearest to it, within the gate."""
    squared = np.random.default_rng(seed).uniform(0, 20, (4, 5))
    found = nearest(torch.from_numpy(squared), 9.0).tolist()
    closest = squared.argmin(1)
    for m, name in enumerate(closest):
        rivals = [squared[i, name] for i in range(4) if closest[i] == name]
        mine = squared[m, name] == min(rivals) and squared[m, name] <= 9.0
        assert found[m] == (name if mine else -1)


def test_nearest_is_the_optimal_assignment_where_landmarks_are_far_apart() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        squared = rng.uniform(20, 90, (4, 6))
        seen = rng.permutation(6)[:4]
        squared[np.arange(4), seen] = rng.uniform(0, 5, 4)
        assert nearest(torch.from_numpy(squared), 15.0).tolist() == seen.tolist()
        assert linear_sum_assignment(squared)[1].tolist() == seen.tolist()


def test_any_landmark_or_clutter() -> None:
    points = np.array([[0.0, 0, 0], [1, 2, 3]])
    z = np.array([0.5, 1, 1.5])
    each = [multivariate_normal.logpdf(z, point, 0.3) for point in points]
    expected = np.log(CLUTTER / 50 + (1 - CLUTTER) * np.exp(each).mean())
    assert float(log_mixture(torch.tensor(each), 50.0)) == pytest.approx(expected, rel=1e-12)


def test_names_are_those_of_the_map() -> None:
    """At the truth, what comes without names gets the ones it had."""
    named, unnamed = (
        World(make_scenario("indoor-v0", prior_std=0.1, **way), 2) for way in ({}, UNNAMED)
    )
    one, other = named.reset(0), unnamed.reset(0)
    for method in ("nearest", "joint"):
        ekf: Any = make(f"ekf:association={method}", unnamed.scenario)
        prior = ekf.predicted(ekf.reset(other), other)[0]
        found = ekf.association.named(prior).observation
        seen: Tensor = found["landmark_mask"] > 0
        assert seen.float().mean() > 0.9 * one["landmark_mask"].mean()
        wide = seen.repeat_interleave(3, -1)
        same = (found["landmarks"] == one["landmarks"])[wide]
        assert same.float().mean() > 0.95


@pytest.mark.parametrize("agent", ["ekf_joint", "dlspf", "slam", "ekf:fusion=exchange"])
def test_who_needs_names_refuses(agent: str) -> None:
    with pytest.raises(NotServed, match=r"would be ignored|needs landmarks with names"):
        make(agent, make_scenario("indoor-v0", **UNNAMED))


def test_robust_screens_judge_named_landmarks() -> None:
    scenario = make_scenario("indoor-v0", **UNNAMED)
    with pytest.raises(NotServed, match="association=nearest or joint"):
        make("pf500:robust=huber", scenario)
    make("pf500:robust=huber:association=joint", scenario)
