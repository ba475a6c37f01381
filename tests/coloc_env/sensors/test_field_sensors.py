"""Sensors that robots carry (time differences, angles of arrival, fixes with outages, optical flow,
tags): what they say without noise, and how noisy they are."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest, norm
from torch import Tensor

from coloc_env.motion import Arena
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import ArrivalAngles, Layout, OpticalFlow, PositionFix, Sensor, Tdoa
from coloc_env.world import World

ONE = ((0.0, 0.0, 0.0), (30.0, 20.0, 5.0), (30.0, 0.0, 0.0), (0.0, 20.0, 5.0))


def seen_by(sensor: Sensor, rows: int = 30, steps: int = 20, **overrides: Any) -> list[tuple]:
    """Observation and truth of each step."""
    scenario = replace(make_scenario("indoor-v0", imu=False, **overrides), sensors=(sensor,))
    world, found = World(scenario, rows), []
    world.reset(torch.arange(rows))
    for _ in range(steps):
        found.append((world.observation(), world.truth))
        world.advance(torch.zeros(rows, scenario.arena.n_uavs, 9))
    return found


def is_normal(error: Tensor, std: float) -> None:
    """Mean and variance within what 1 in 10⁵ samples exceed."""
    error = error.double().flatten()
    n = len(error)
    assert n > 1000
    assert abs(float(error.mean())) < 4.4 * std / math.sqrt(n)
    low, high = chi2.ppf((1e-5, 1 - 1e-5), n) / n
    assert low < float((error**2).mean()) / std**2 < high


@pytest.mark.parametrize("pairs", [(), ((0, 2), (3, 1))])
def test_differences_are_of_distances(pairs: tuple) -> None:
    sensor = Tdoa(ONE, 0.2, pairs=pairs, dropout=0.3)
    error, there = [], []
    anchors = torch.tensor(ONE, dtype=torch.float64)
    for seen, truth in seen_by(sensor):
        far = (truth.position.unsqueeze(-2) - anchors).norm(dim=-1)
        exact = [far[..., n] - far[..., m] for m, n in pairs or ((0, 1), (1, 2), (2, 3), (3, 0))]
        mask = seen["tdoa_mask"] > 0
        assert not seen["tdoa"][~mask].any()
        error.append((seen["tdoa"] - torch.stack(exact, -1))[mask])
        there.append(mask.double())
    is_normal(torch.cat(error), 0.2)
    assert float(torch.stack(there).mean()) == pytest.approx(0.7, abs=0.02)


def test_a_tail_is_a_share_of_wide_noise_of_either_sign() -> None:
    """Against the mixture's own distribution; the others are as without it, to the bit."""
    errors, kept = [], []
    plain, tailed = (seen_by(Tdoa(ONE, 0.1, tail=t, tail_std=2.0)) for t in (0.0, 0.2))
    anchors = torch.tensor(ONE, dtype=torch.float64)
    for (before, _), (seen, truth) in zip(plain, tailed, strict=True):
        far = (truth.position.unsqueeze(-2) - anchors).norm(dim=-1)
        exact = far[..., [1, 2, 3, 0]] - far
        errors.append((seen["tdoa"] - exact).flatten())
        kept.append((seen["tdoa"] == before["tdoa"]).flatten())
    error, n = torch.cat(errors).numpy(), sum(map(len, errors))

    def below(e: np.ndarray) -> np.ndarray:
        return 0.8 * norm.cdf(e, 0, 0.1) + 0.2 * norm.cdf(e, 0, 2.0)

    assert kstest(error, below).pvalue > 1e-4
    assert float(torch.cat(kept).double().mean()) == pytest.approx(0.8, abs=5 * 0.4 / n**0.5)
    with pytest.raises(ValueError, match="tail"):
        Tdoa(ONE, tail=1.5)


def test_two_anchors_have_one_difference() -> None:
    assert Tdoa(ONE[:2]).ends == ([0], [1])


def test_differences_of_tags_and_of_far_anchors() -> None:
    """In entry a · P + q the tag a; nothing where one of the anchors is beyond the radius."""
    arms = (((1.0, 0.0, 0.0), (0.0, 0.0, 2.0)),) * 6
    sensor = Tdoa(ONE, 0.0, arms, pairs=((0, 1), (2, 3)), radius=18.0)
    anchors, beyond = torch.tensor(ONE, dtype=torch.float64), 0
    for seen, truth in seen_by(sensor, 3, 4):
        turn = Rotation.from_quat(truth.attitude.roll(-1, -1).reshape(-1, 4).numpy())
        for a, arm in enumerate(arms[0]):
            tag = truth.position + torch.from_numpy(turn.apply(arm)).view_as(truth.position)
            far = (tag.unsqueeze(-2) - anchors).norm(dim=-1)
            for q, (m, n) in enumerate(sensor.pairs):
                near = (far[..., m] <= 18) & (far[..., n] <= 18)
                z = seen["tdoa"][..., 2 * a + q]
                exact = (far[..., n] - far[..., m]) * near
                torch.testing.assert_close(z, exact.float(), rtol=0, atol=1e-5)
                assert torch.equal(seen["tdoa_mask"][..., 2 * a + q] > 0, near)
                beyond += int((~near).sum())
    assert beyond


def test_angles_are_those_of_the_body_frame() -> None:
    sensor = ArrivalAngles(0.03, 0.07, field=0.3, radius=15.0, dropout=0.2)
    azimuths, elevations, share = [], [], []
    for seen, truth in seen_by(sensor, 10, 10):
        z = seen["arrival_angles"].unflatten(-1, (-1, 2)).double()
        mask = seen["arrival_angle_mask"] > 0
        assert not z[~mask].any()
        apart = truth.position.unsqueeze(1) - truth.position.unsqueeze(2)
        q = truth.attitude.roll(-1, -1).unsqueeze(2).expand(*apart.shape[:3], 4)
        v = Rotation.from_quat(q.reshape(-1, 4).numpy()).inv().apply(apart.reshape(-1, 3).numpy())
        v = torch.from_numpy(v).view_as(apart)
        length = v.norm(dim=-1)
        elevation = torch.asin(v[..., 2] / length.clamp_min(1e-9))
        can = (length <= 15) & (elevation.abs() <= 0.3) & (length > 0)
        assert not (mask & ~can).any()
        share.append(mask[can].double())
        off = z[..., 0] - torch.atan2(v[..., 1], v[..., 0])
        azimuths.append(torch.atan2(off.sin(), off.cos())[mask])
        elevations.append((z[..., 1] - elevation)[mask])
    is_normal(torch.cat(azimuths), 0.03)
    is_normal(torch.cat(elevations), 0.07)
    assert float(torch.cat(share).mean()) == pytest.approx(0.8, abs=0.05)


def test_flow_is_the_velocity_forward_and_left() -> None:
    sensor = OpticalFlow(0.2, lowest=1.0, highest=3.0, dropout=0.25)
    error, share = [], []
    for seen, truth in seen_by(sensor):
        z, mask = seen["flow"].double(), seen["flow_mask"][..., 0] > 0
        turn = Rotation.from_quat(truth.attitude.roll(-1, -1).reshape(-1, 4).numpy()).inv()
        v = torch.from_numpy(turn.apply(truth.velocity.reshape(-1, 3).numpy()))
        height = truth.position[..., 2]
        can = (height >= 1) & (height <= 3)
        assert not (mask & ~can).any()
        assert not z[~mask].any()
        share.append(mask[can].double())
        error.append((z - v.view_as(truth.velocity)[..., :2])[mask])
    is_normal(torch.cat(error), 0.2)
    assert float(torch.cat(share).mean()) == pytest.approx(0.75, abs=0.05)


def test_fixes_are_less_sure_upwards() -> None:
    sensor = PositionFix(0.5, count=6, vertical_std=1.5)
    error = torch.cat([seen["position_fix"] - truth.position for seen, truth in seen_by(sensor)])
    for axis, std in enumerate((0.5, 0.5, 1.5)):
        is_normal(error[..., axis], std)


def fixed(steps: int, rows: int = 300, **settings: Any) -> Tensor:
    """Which UAVs have a fix [K, R, N]."""
    sensor = PositionFix(1.0, count=6, **settings)
    return torch.stack(
        [seen["position_fix_mask"][..., 0] > 0 for seen, _ in seen_by(sensor, rows, steps)]
    ).double()


def test_outages_last() -> None:
    """A two-state Markov chain: share, and correlation e^(−t / time)."""
    there = fixed(15, outage=0.4, outage_time=1.0)
    assert float(there.mean()) == pytest.approx(0.6, abs=0.03)
    kept = float((there[2] * there[12]).mean())  # 1 s later
    assert kept == pytest.approx(0.36 + 0.24 * math.exp(-1.0), abs=0.04)


def test_times_without_fixes_and_missing_ones() -> None:
    there = fixed(8, 40, off=(0.2, 0.5))
    assert there.flatten(1).mean(1).tolist() == [1, 1, 0, 0, 0, 1, 1, 1]
    assert float(fixed(4, 100, dropout=0.3).mean()) == pytest.approx(0.7, abs=0.03)


@pytest.mark.parametrize(
    ("kind", "wrong", "words"),
    [
        (Tdoa, {"anchors": ONE[:1]}, "at least two anchor positions"),
        (Tdoa, {"anchors": ONE, "pairs": ((1, 1),)}, "pairs of different indices of the 4 anchors"),
        (Tdoa, {"anchors": ONE, "pairs": ((0, 4),)}, "pairs of different indices of the 4 anchors"),
        (Tdoa, {"anchors": ONE, "std": -1.0}, "std=-1.0 is not allowed"),
        (Tdoa, {"anchors": ONE, "radius": 0.0}, "radius=0.0 is not allowed: a distance in m > 0"),
        (ArrivalAngles, {"field": 1.6}, "field=1.6 is not allowed: an elevation"),
        (ArrivalAngles, {"azimuth_std": -0.1}, "azimuth_std=-0.1 is not allowed"),
        (ArrivalAngles, {"dropout": 2.0}, "dropout=2.0 is not allowed: a probability"),
        (OpticalFlow, {"lowest": 2.0, "highest": 1.0}, "a height in m above lowest=2"),
        (OpticalFlow, {"std": -0.1}, "std=-0.1 is not allowed"),
        (PositionFix, {"vertical_std": -1.0}, "vertical_std=-1.0 is not allowed"),
        (PositionFix, {"outage": 1.5}, "outage=1.5 is not allowed: a share"),
        (PositionFix, {"outage_time": 0.0}, "outage_time=0.0 is not allowed: a time in s > 0"),
        (PositionFix, {"off": (3.0, 1.0)}, r"\(from, to\) in s, from ≤ to"),
    ],
)
def test_settings_are_checked(kind: Any, wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        kind(**wrong)


@pytest.mark.parametrize("sensor", [ArrivalAngles(), OpticalFlow()])
def test_sensors_of_space_need_three_dimensions(sensor: Sensor) -> None:
    with pytest.raises(ValueError, match="a 3-D scenario"):
        sensor.leaves(Layout(Arena(2, 3, 0.1, (0.0, 0.0), (1.0, 1.0)), 3))


@pytest.mark.parametrize("count", [1, 17])
def test_numbers_of_anchors_are_checked(count: int) -> None:
    with pytest.raises(ValueError, match=f"tdoa_anchors={count} is not allowed"):
        make_scenario("indoor-v0", tdoa_anchors=count)


def test_other_sensors_change_no_number() -> None:
    """What is measured by default is the same to the bit beside all others."""
    every = {"tdoa_anchors": 8, "angles": True, "gnss": True, "flow": True, "barometer": True}
    plain, whole = (first(make_scenario("indoor-v0", **each)) for each in ({}, every))
    assert whole.leaves.keys() - plain.leaves.keys() == {
        *("tdoa", "tdoa_mask", "tdoa_map", "arrival_angles", "arrival_angle_mask"),
        *("position_fix", "position_fix_mask", "flow", "flow_mask", "height", "height_mask"),
    }
    for name, leaf in plain.leaves.items():
        assert torch.equal(whole[name], leaf), name


def first(scenario: Any) -> Observation:
    return World(scenario, 2).reset(torch.arange(2))
