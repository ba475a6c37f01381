"""What is left of measurements at an estimate: statistics by numpy, pulls by geometry."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from torch import Tensor

from agents.models.measurements import Block, Neighbours
from agents.models.measurements.bearings import UavRangeBearings
from agents.models.measurements.ranges import AnchorRanges
from agents.models.measurements.vectors import Heights
from agents.models.process import InertialProcess, WheeledProcess
from agents.wrappers.residuals import pulls, robust_statistics
from coloc_env.observation import Observation
from coloc_env.scenario import Inertial
from coloc_env.sensors import AnchorRanging, Height, Imu, Odometry, RangeNoise, UavBearings

NOBODY = Neighbours(torch.zeros(1, 1, 0, 3), torch.zeros(1, 1, 0, 3), torch.zeros(1, 1, 0) > 0)
ANCHORS = torch.tensor([[0.0, 0.0, 0.0], [10.0, 0.0, 3.0], [4.0, 9.0, 1.0]], dtype=torch.float64)


# ---------------------------------------------------------------- robust statistics


def lower_median(values: NDArray) -> NDArray:
    """The middle one; of an even number the lower of the two in the middle, as torch has it."""
    return np.sort(values, axis=0)[(len(values) - 1) // 2]


def by_numpy(seen: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Median, Huber mean and scatter of vectors [m, d] that were all measured."""
    if not len(seen):
        nothing = np.zeros(seen.shape[-1])
        return nothing, nothing, nothing
    median = lower_median(seen)
    distance = np.linalg.norm(seen - median, axis=-1)
    typical = lower_median(distance)
    weight = np.array([1.0 if x <= typical else typical / x for x in distance])
    huber = np.average(seen, axis=0, weights=weight)
    return median, huber, seen.std(axis=0)


def assert_like_numpy(apart: NDArray, mask: NDArray) -> None:
    found = robust_statistics(torch.from_numpy(apart), torch.from_numpy(mask))
    for b, n in np.ndindex(mask.shape[:2]):
        expected = by_numpy(apart[b, n][mask[b, n]])
        for name, ours, theirs in zip(("median", "huber", "scatter"), found, expected, strict=True):
            np.testing.assert_allclose(ours[b, n], theirs, rtol=1e-9, atol=1e-9, err_msg=name)


def test_random_vectors_under_random_masks() -> None:
    rng = np.random.default_rng(0)
    for m in range(1, 9):
        assert_like_numpy(rng.normal(size=(20, 2, m, 3)), rng.random((20, 2, m)) < 0.7)


@given(
    apart=hnp.arrays(np.float64, (2, 2, 5, 2), elements=st.integers(-3, 3).map(float)),
    mask=hnp.arrays(np.bool_, (2, 2, 5)),
)
@settings(max_examples=100, deadline=None)
def test_whole_numbers_with_their_ties(apart: NDArray, mask: NDArray) -> None:
    assert_like_numpy(apart, mask)


def test_nothing_measured_is_zero() -> None:
    for leaf in robust_statistics(torch.full((1, 2, 4, 3), 7.0), torch.zeros(1, 2, 4) > 0):
        assert leaf.tolist() == [[[0.0] * 3] * 2]


def test_one_fix_is_its_own_median_and_mean() -> None:
    apart = torch.tensor([[[[9.0, 9.0], [1.5, -2.0], [9.0, 9.0]]]])
    mask = torch.tensor([[[False, True, False]]])
    median, huber, scatter = robust_statistics(apart, mask)
    assert median.flatten().tolist() == huber.flatten().tolist() == [1.5, -2.0]
    assert scatter.flatten().tolist() == [0.0, 0.0]


def test_two_alike_outvote_a_third() -> None:
    apart = torch.tensor([[[[1.0, 1.0], [1.0, 1.0], [50.0, -20.0]]]])
    _, huber, scatter = robust_statistics(apart, torch.ones(1, 1, 3) > 0)
    assert huber.flatten().tolist() == [1.0, 1.0]
    assert (scatter > 5).all()


def test_one_outlier_of_many_hardly_moves_the_huber_mean() -> None:
    rng = np.random.default_rng(1)
    apart = torch.from_numpy(0.1 * rng.normal(size=(200, 1, 11, 3)))
    mask = torch.ones(200, 1, 11) > 0
    apart[:, :, 4] = 100.0
    _, huber, _ = robust_statistics(apart, mask)
    assert huber.abs().mean() < 0.1
    assert apart.mean(-2).abs().mean() > 9


@given(shift=st.floats(-50, 50), seed=st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_statistics_move_along_and_know_no_order(shift: float, seed: int) -> None:
    g = torch.Generator().manual_seed(seed)
    apart = torch.randn(3, 1, 6, 3, generator=g, dtype=torch.float64)
    mask = torch.rand(3, 1, 6, generator=g) < 0.8
    base = robust_statistics(apart, mask)
    order = torch.randperm(6, generator=g)
    for ours, theirs in zip(
        robust_statistics(apart[:, :, order], mask[:, :, order]), base, strict=True
    ):
        torch.testing.assert_close(ours, theirs)
    moved = robust_statistics(apart + shift, mask)
    some = mask.any(-1)
    for i, by in enumerate((shift, shift, 0.0)):
        torch.testing.assert_close(moved[i][some], base[i][some] + by, atol=1e-9, rtol=0)
    hidden = apart.masked_fill(~mask.unsqueeze(-1), 1e6)
    for ours, theirs in zip(robust_statistics(hidden, mask), base, strict=True):
        torch.testing.assert_close(ours, theirs)


# ---------------------------------------------------------------- pulls


def state(position: list[float]) -> Tensor:
    rest = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    return torch.tensor([[[*position, *rest]]], dtype=torch.float64)


def ranges_to(position: list[float], measured: list[float], std: float = 0.1, **more: Any) -> Block:
    """The block of ranges to the first anchors, linearized at a position."""
    m = len(measured)
    sensor = AnchorRanging(tuple(map(tuple, ANCHORS[:m].tolist())), RangeNoise(std=std))
    leaves = {
        "anchor_ranges": torch.tensor([[measured]], dtype=torch.float64),
        "anchor_range_mask": torch.ones(1, 1, m),
        "anchor_map": ANCHORS[:m].reshape(1, 1, -1),
        **more,
    }
    process = InertialProcess(0.1, Imu(), Inertial())
    return AnchorRanges(sensor).linearize(process, state(position), Observation(leaves), NOBODY)


@given(
    position=st.tuples(*[st.floats(1.0, 9.0)] * 3),
    measured=st.floats(1.0, 20.0),
)
@settings(max_examples=50, deadline=None)
def test_one_range_pulls_onto_its_sphere(
    position: tuple[float, float, float], measured: float
) -> None:
    raw, _ = pulls([ranges_to(list(position), [measured])], 3)
    moved = torch.tensor(position, dtype=torch.float64) + raw[0, 0]
    assert float((moved - ANCHORS[0]).norm()) == pytest.approx(measured, abs=1e-9)
    away = torch.tensor(position, dtype=torch.float64) - ANCHORS[0]
    assert float(torch.linalg.cross(away, raw[0, 0]).norm()) < 1e-7, "straight to or from it"


@given(position=st.tuples(*[st.floats(1.0, 9.0)] * 3), seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_a_pull_is_the_mean_of_its_measurements(
    position: tuple[float, float, float], seed: int
) -> None:
    """h r/‖h‖² with h by finite differences of the distance, r cut at twice its deviation."""
    rng = np.random.default_rng(seed)
    p, std = np.array(position), 0.2
    anchors = ANCHORS.numpy()

    def distances(at: NDArray) -> NDArray:
        return np.linalg.norm(at - anchors, axis=-1)

    measured = distances(p) + rng.normal(size=3)
    h = np.stack([(distances(p + e) - distances(p - e)) / 2e-5 for e in 1e-5 * np.eye(3)], -1)
    residual = measured - distances(p)
    found = pulls([ranges_to(list(position), measured.tolist(), std)], 3)
    for ours, r in zip(found, (residual, residual.clip(-2 * std, 2 * std)), strict=True):
        expected = (h * (r / (h**2).sum(-1))[:, None]).mean(0)
        np.testing.assert_allclose(ours[0, 0], expected, atol=1e-6)


def test_pulls_of_several_kinds_share_one_mean() -> None:
    ranging = ranges_to([3.0, 4.0, 0.0], [6.0])  # 5 m away: one metre out, along (0.6, 0.8, 0)
    leaves = {"height": torch.tensor([[[0.3]]]), "height_mask": torch.ones(1, 1, 1)}
    process = InertialProcess(0.1, Imu(), Inertial())
    at = state([3.0, 4.0, 0.0])
    height = Heights(Height(std=0.1)).linearize(process, at, Observation(leaves), NOBODY)
    raw, clipped = pulls([ranging, height], 3)
    torch.testing.assert_close(raw[0, 0].tolist(), [0.3, 0.4, 0.15])
    torch.testing.assert_close(clipped[0, 0].tolist(), [0.06, 0.08, 0.1])


def test_what_was_not_measured_pulls_nowhere() -> None:
    mask = torch.zeros(1, 1, 3)
    blind = ranges_to([3.0, 4.0, 1.0], [9.0, 9.0, 9.0], anchor_range_mask=mask)
    for pull in pulls([blind], 3):
        assert pull.flatten().tolist() == [0.0, 0.0, 0.0]
    half = ranges_to(
        [3.0, 4.0, 0.0], [6.0, 99.0, -99.0], anchor_range_mask=torch.tensor([[[1.0, 0, 0]]])
    )
    torch.testing.assert_close(pulls([half], 3)[0][0, 0].tolist(), [0.6, 0.8, 0.0])


def test_range_and_bearing_pull_where_they_say() -> None:
    """Seen from a wrong place, a neighbour's range and bearing together pull to the right one."""
    process = WheeledProcess(0.1, Odometry())
    right, wrong = np.array([2.0, 1.0]), np.array([2.02, 0.97])
    there, heading = np.array([5.0, 5.0]), 0.4
    x, y = there - right
    z = torch.tensor([[[np.hypot(x, y), np.arctan2(y, x) - heading]]])
    at = torch.tensor([[[*wrong, 0.0, 0.0, heading]]], dtype=torch.float64)
    leaves = {"uav_bearings": z, "uav_bearing_mask": torch.ones(1, 1, 1)}
    known = Neighbours(
        position=torch.from_numpy(there).view(1, 1, 1, 2),
        variance=torch.zeros(1, 1, 1, 2, dtype=torch.float64),
        known=torch.ones(1, 1, 1) > 0,
    )
    model = UavRangeBearings(UavBearings(range_std=0.1, bearing_std=0.1))
    block = model.linearize(process, at, Observation(leaves), known)
    raw, clipped = pulls([block], 2)
    np.testing.assert_allclose(raw[0, 0], right - wrong, atol=5e-4)
    torch.testing.assert_close(clipped, raw)
    doubtful = Neighbours(known.position, known.variance, ~known.known)
    block = model.linearize(process, at, Observation(leaves), doubtful)
    assert pulls([block], 2)[0].abs().max() == 0


def test_what_partners_do_not_know_widens_the_clip() -> None:
    sensor_std, partner_std, r = 0.1, 0.5, 10.0
    unit = torch.tensor([1.0, 0.0], dtype=torch.float64)

    def block(**partner: Any) -> Block:
        return Block(
            residual=torch.full((1, 1, 1, 1), r, dtype=torch.float64),
            jacobian=unit.view(1, 1, 1, 1, 2),
            variance=torch.full((1, 1, 1, 1), sensor_std**2, dtype=torch.float64),
            mask=torch.ones(1, 1, 1) > 0,
            **partner,
        )

    alone = pulls([block()], 2)[1]
    shared = torch.full((1, 1, 1, 1), partner_std**2, dtype=torch.float64)
    together = pulls([block(partner_variance=shared)], 2)[1]
    assert float(alone[0, 0, 0]) == pytest.approx(2 * sensor_std)
    assert float(together[0, 0, 0]) == pytest.approx(2 * np.hypot(sensor_std, partner_std))
