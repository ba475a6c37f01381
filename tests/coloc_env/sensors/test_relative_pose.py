"""Relative poses and the worlds that have nothing else: who learns what, and its statistics."""

import math
from typing import Any

import pytest
import torch
from scipy.stats import chisquare, kstest
from torch import Tensor

from coloc_env.geometry import poses_in
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Odometry, RelativePose
from coloc_env.world import World

NAMES = ("stein2d-v0", "stein3d-v0")


def seen(name: str, worlds: int = 40, steps: int = 50, **overrides: Any) -> dict[str, Tensor]:
    """Leaves [worlds, steps, N, …] and the true poses beside them."""
    scenario = make_scenario(name, **overrides)
    world = World(scenario, worlds)
    observation, found = world.reset(0), []
    for _ in range(steps):
        truth = torch.cat((world.truth.position, world.truth.attitude), -1)
        found.append({**observation.leaves, "truth": truth})
        world.advance(torch.zeros(worlds, scenario.arena.n_uavs, 3 * scenario.arena.dim))
        observation = world.observation()
    return {key: torch.stack([each[key] for each in found], 1) for key in found[0]}


def residuals(name: str, **overrides: Any) -> Tensor:
    """log(T⁻¹ x_i⁻¹ x_j) of every match, as its first end holds it."""
    poses = poses_in(2 if "2d" in name else 3)
    leaves = seen(name, **overrides)
    n = leaves["truth"].shape[2]
    first, second = leaves["relative_pose_ends"].unflatten(-1, (-1, 2)).long().unbind(-1)
    mine = (leaves["relative_pose_mask"] > 0) & (first == torch.arange(n).unsqueeze(-1))
    truth = leaves["truth"].unsqueeze(2).expand(-1, -1, n, -1, -1)
    own = leaves["truth"].unsqueeze(3).expand(-1, -1, -1, second.shape[-1], -1)[mine]
    other = truth.gather(3, second.unsqueeze(-1).expand(*second.shape, poses.size))[mine]
    measured = leaves["relative_poses"].unflatten(-1, (-1, poses.size)).double()[mine]
    return poses.minus(poses.between(own, other), measured)


@pytest.mark.parametrize("name", NAMES)
def test_noise_is_gaussian_of_the_size_asked_for(name: str) -> None:
    r = residuals(name, outliers=0.0, relative_pose_noise=(0.08, 3.0))
    d = 2 if "2d" in name else 3
    assert len(r) == 2000
    for part, std in ((r[:, :d], 0.08), (r[:, d:], math.radians(3.0))):
        assert kstest((part / std).flatten().numpy(), "norm").pvalue > 1e-3


@pytest.mark.parametrize("name", NAMES)
def test_outliers_come_in_their_share_and_from_everywhere(name: str) -> None:
    r = residuals(name, outliers=0.3)
    d = 2 if "2d" in name else 3
    wrong = (r[:, :d].norm(dim=-1) > 0.5) | (r[:, d:].norm(dim=-1) > 0.5)
    share = float(wrong.double().mean())  # next to none of the wrong ones is near the truth
    assert abs(share - 0.3) < 5 * math.sqrt(0.21 / len(r))
    angle = r[wrong, d:].norm(dim=-1).numpy()  # uniform over all rotations
    cdf = (
        (lambda x: x / math.pi)
        if d == 2
        else (lambda x: (x - torch.tensor(x).sin().numpy()) / math.pi)
    )
    assert kstest(angle[angle > 0.5], lambda x: (cdf(x) - cdf(0.5)) / (1 - cdf(0.5))).pvalue > 1e-3


def test_what_is_wrong_lies_in_the_arena() -> None:
    leaves = seen("stein2d-v0", outliers=1.0, size=6.0, relative_pose_noise=(0.0, 0.0))
    poses, n = poses_in(2), 3
    first = leaves["relative_pose_ends"][..., 0].long()
    mine = (leaves["relative_pose_mask"][..., 0] > 0) & (first == torch.arange(n))
    place = poses.compose(leaves["truth"][mine], leaves["relative_poses"].double()[mine])[:, :2]
    assert float(place.abs().max()) <= 3.0 + 1e-5
    for axis in (0, 1):
        assert kstest(((place[:, axis] + 3) / 6).numpy(), "uniform").pvalue > 1e-3


@pytest.mark.parametrize("matches", [1, 3])
def test_both_ends_hold_a_match_and_nobody_else(matches: int) -> None:
    leaves = seen("stein2d-v0", n_uavs=5, matches_per_step=matches)
    mask = leaves["relative_pose_mask"] > 0
    ends = leaves["relative_pose_ends"].unflatten(-1, (-1, 2)).long()
    pose = leaves["relative_poses"].unflatten(-1, (matches, 3))
    assert (mask.sum(2) == 2).all()
    holder = torch.arange(5).view(5, 1, 1)
    assert ((ends == holder).any(-1) | ~mask).all()
    held = ends.masked_fill(~mask.unsqueeze(-1), 0).sum(2)
    assert (ends[mask] == (held // 2).unsqueeze(2).expand_as(ends)[mask]).all()
    assert (held % 2 == 0).all()
    total = pose.sum(2).unsqueeze(2).expand_as(pose)
    torch.testing.assert_close(2 * pose[mask], total[mask], rtol=0, atol=1e-5)
    assert not pose[~mask].any()
    pairs = (held[..., 0] // 2) * 5 + held[..., 1] // 2
    counts = torch.bincount(pairs.flatten(), minlength=25).view(5, 5)
    assert not counts.diagonal().any()
    drawn = counts[~torch.eye(5, dtype=torch.bool)].numpy()
    assert chisquare(drawn).pvalue > 1e-3


def test_no_link_no_match() -> None:
    leaves = seen("stein2d-v0", n_uavs=4, comm_radius=3.0, outliers=0.0)
    mask = leaves["relative_pose_mask"][..., 0] > 0
    assert 0.05 < float((mask.sum(2) == 2).double().mean()) < 0.8
    distance = leaves["relative_poses"][..., :2][mask].norm(dim=-1)
    assert float(distance.max()) < 3.0 + 0.4


@pytest.mark.parametrize("name", NAMES)
def test_odometry_adds_up_to_the_path(name: str) -> None:
    motion = {"motion": "random"}
    leaves = seen(name, worlds=3, odometry_noise=(0.0, 0.0), **motion)
    poses = poses_in(2 if "2d" in name else 3)
    d, odometry = poses.dim, leaves["odometry"].double() * 0.1
    pose = leaves["truth"][:, 0]
    for k in range(1, odometry.shape[1]):
        shift, turn = odometry[:, k, :, :d], odometry[:, k, :, d:]
        step = poses.exp(torch.cat((torch.zeros_like(shift), turn), -1))
        pose = poses.compose(pose, torch.cat((shift, step[..., d:]), -1))
    end = leaves["truth"][:, -1]
    assert float(poses.minus(pose, end).abs().max()) < 1e-5


def test_odometry_in_space_has_the_noise_asked_for() -> None:
    leaves = seen("stein3d-v0", odometry_noise=(0.01, 0.5))["odometry"].double()
    assert leaves.shape[-1] == 6
    for part, std in ((leaves[..., :3], 0.1), (leaves[..., 3:], math.radians(5.0))):
        assert kstest((part / std).flatten().numpy(), "norm").pvalue > 1e-3
    slips = Odometry(0.3, 0.2, 0.1, relative=0.5).std(torch.tensor([2.0, 0, 0, 0, 0, -4.0]))
    torch.testing.assert_close(slips, torch.tensor([1.3, 1.2, 1.2, 0.1, 0.1, 2.1]))


@pytest.mark.parametrize("name", NAMES)
def test_the_reference_is_uav_0(name: str) -> None:
    leaves = seen(name, worlds=2, steps=5)
    expected = leaves["truth"][:, :, :1].expand_as(leaves["truth"]).float()
    assert torch.equal(leaves["reference"], expected)


def test_static_teams_stand_as_published() -> None:
    world = World(make_scenario("stein3d-v0", n_uavs=5))
    world.reset(0)
    places = [[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2], [4, 0, 0]]
    assert world.truth.position[0].tolist() == places
    assert (world.truth.attitude[0] == torch.tensor([1.0, 0, 0, 0])).all()
    assert not world.now.scored[0, 0]
    assert world.now.scored[0, 1:].all()


def test_one_uav_alone_meets_nobody() -> None:
    leaves = seen("stein2d-v0", worlds=2, steps=3, n_uavs=1)
    assert not leaves["relative_pose_mask"].any()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"outliers": 1.2}, "outliers=1.2 is not allowed: a number from 0 to 1"),
        ({"matches_per_step": 0}, "matches_per_step=0 is not allowed: a whole number ≥ 1"),
        ({"relative_pose_noise": (-1.0, 2.0)}, r"relative_pose_noise=\(-1.0, 2.0\) is not allowed"),
        ({"motion": "hover"}, "motion='hover' is not allowed: one of static, circle"),
        ({"motion": "static", "n_uavs": 10}, "motion=static is not allowed: only for at most 9"),
        ({"dt": 0.0}, "dt=0.0 is not allowed: a number > 0 in s"),
        ({"n_uavs": 0}, "n_uavs=0 is not allowed: a whole number from 1 to 10000"),
    ],
)
def test_wrong_overrides_are_named(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=f"^stein2d-v0: .*{words}"):
        make_scenario("stein2d-v0", **overrides)


def test_the_team_believes_all_but_the_outliers() -> None:
    scenario = make_scenario("stein2d-v0", outliers=0.4, matches_per_step=2)
    believed = scenario.believed.sensor(RelativePose)
    assert believed == RelativePose(2)
    assert scenario.sensors[1] == RelativePose(2, outliers=0.4)
