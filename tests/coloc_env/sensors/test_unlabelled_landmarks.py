"""Landmarks without names, lasting mistakes, symmetric rooms, and headings that may be any."""

from typing import Any

import pytest
import torch
from torch import Tensor

from coloc_env.geometry import level, quaternion_exp, rotation_matrix
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

SEEDS = torch.arange(8)


def series(steps: int, **overrides: Any) -> tuple[dict[str, Tensor], World]:
    """Leaves [K, B, N, F] of 8 worlds."""
    world = World(make_scenario("indoor-v0", **overrides), len(SEEDS))
    seen, found = world.reset(SEEDS), []
    for _ in range(steps):
        found.append(dict(seen.leaves))
        world.advance(torch.zeros(len(SEEDS), 6, 9))
        seen = world.observation()
    return {k: torch.stack([one[k] for one in found]) for k in found[0]}, world


def test_the_same_vectors_in_another_order() -> None:
    named, _ = series(2)
    unnamed, _ = series(2, association="unknown")
    one = torch.cat(
        (named["landmarks"].unflatten(-1, (20, 3)), named["landmark_mask"][..., None]), -1
    )
    other = torch.cat(
        (
            unnamed["unlabelled_landmarks"].unflatten(-1, (20, 3)),
            unnamed["unlabelled_landmark_mask"][..., None],
        ),
        -1,
    )
    assert torch.equal(one.sort(-2).values, other.sort(-2).values)
    assert not torch.equal(one, other)
    assert torch.equal(named["landmark_map"], unnamed["landmark_map"])
    assert not {"landmarks", "landmark_mask"} & unnamed.keys()
    first = [int(x) for x in (other[0, :, 0, :, -1] > 0).float().argmax(-1)]
    assert len(set(first)) > 1  # the order is each UAV's and step's own


def test_mistakes_last() -> None:
    """As many as are asked for; the same wrong landmark as 0.1 s before with probability e^(−1/30),
    for every step anew without ``alias_time``."""
    right, _ = series(40)
    for time, share in ((3.0, 0.967), (None, 0.3 / 19)):
        wrong, _ = series(40, false_matches=0.3, alias_time=time)
        seen = (right["landmark_mask"][1:] * right["landmark_mask"][:-1]) > 0
        shape = (20, 3)
        shown = wrong["landmarks"].unflatten(-1, shape) - right["landmarks"].unflatten(-1, shape)
        mistaken = shown.abs().amax(-1) > 0
        assert mistaken[right["landmark_mask"] > 0].float().mean() == pytest.approx(0.3, abs=0.04)
        # The true offset between two landmarks hardly turns in a step.
        same = (shown[1:] - shown[:-1]).norm(dim=-1) < 0.5
        both = mistaken[1:] & seen
        assert (same & mistaken[:-1])[both].float().mean() == pytest.approx(share, abs=0.03)


@pytest.mark.parametrize("count", [6, 7])
def test_half_a_turn_leaves_a_symmetric_room_as_it_is(count: int) -> None:
    _, world = series(1, landmarks=count, landmark_placement="symmetric", room=(12.0, 8.0, 4.0))
    points = world.observation()["landmark_map"][:, 0].unflatten(-1, (count, 3))
    turned = torch.cat((torch.tensor([12.0, 8.0]) - points[..., :2], points[..., 2:]), -1)
    apart = torch.cdist(points, turned)
    assert apart.min(-1).values.max() < 1e-5
    assert torch.cdist(points, points).add(100 * torch.eye(count)).min() > 0.01


def test_level_takes_the_heading_away() -> None:
    g = torch.Generator().manual_seed(0)
    attitude = quaternion_exp(torch.randn(50, 3, generator=g, dtype=torch.float64))
    before, after = rotation_matrix(attitude), rotation_matrix(level(attitude))
    torch.testing.assert_close(after[:, 1, 0], torch.zeros(50, dtype=torch.float64))
    assert (after[:, 0, 0] > 0).all()
    torch.testing.assert_close(after[:, 2], before[:, 2])  # roll and pitch
    assert level(torch.tensor([[1.0]])).tolist() == [[0.0]]


def test_the_prior_says_nothing_of_the_heading() -> None:
    """The same as another prior but for the mean attitude, whatever the true heading is."""
    usual, _ = series(1)
    blind, world = series(1, prior_yaw="uniform")
    usual, blind = usual["prior"][0], blind["prior"][0]
    assert torch.equal(usual[..., :6], blind[..., :6])
    assert torch.equal(usual[..., 10:], blind[..., 10:])
    assert (rotation_matrix(blind[..., 6:10].double())[..., 1, 0].abs() < 1e-6).all()
    heading = rotation_matrix(world.truth.attitude)[..., 0, 0]
    assert heading.std() > 0.3


@pytest.mark.parametrize("wrong", [{"alias_time": 0.0}, {"prior_yaw": "any"}, {"association": 1}])
def test_wrong_options(wrong: dict[str, Any]) -> None:
    name = next(iter(wrong))
    with pytest.raises(ValueError, match=f"indoor-v0: {name}=.* is not allowed"):
        make_scenario("indoor-v0", **wrong)
