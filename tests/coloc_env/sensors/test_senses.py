"""Compass, lamps, signal strength, ultrasound and magnetic field: what they say without noise, how
noisy they are, what walls do, and that no batch changes them."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation
from torch import Tensor

from coloc_env.geometry.walls import depth
from coloc_env.motion import Arena
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import (
    Compass,
    Layout,
    Light,
    Magnetic,
    PathLoss,
    Rssi,
    Sensor,
    Sight,
    UavRssi,
    Ultrasonic,
)
from coloc_env.sensors.light import lamp_places, scattered
from coloc_env.world import World
from tests.coloc_env.sensors.test_field_sensors import is_normal, seen_by

ROOM = ((0.0, 0.0, 0.0), (30.0, 20.0, 5.0))
WALLS = (((11.0, 5.0, 0.0), (11.5, 12.0, 5.0)), ((17.0, 9.0, 0.0), (17.2, 15.0, 4.0)))
LAMPS = lamp_places(6, ROOM[1])
POINTS = ((0.0, 0.0, 0.0), (30.0, 20.0, 5.0), (30.0, 0.0, 0.0))
EVERY: list[Sensor] = [
    Compass(0.1, dropout=0.3),
    Light(LAMPS, sight=Sight(WALLS, 3)),
    Rssi(POINTS, PathLoss(walls=WALLS), dropout=0.2),
    UavRssi(PathLoss(walls=WALLS), dropout=0.2),
    Ultrasonic(ROOM, walls=WALLS),
    Magnetic(ROOM, dropout=0.2),
]


def turns(attitude: Tensor) -> Rotation:
    return Rotation.from_quat(attitude.roll(-1, -1).reshape(-1, 4).numpy())


def in_body(attitude: Tensor, v: Tensor) -> Tensor:
    """Rᵀ v by scipy, v of three numbers for each attitude."""
    return torch.from_numpy(turns(attitude).inv().apply(v.reshape(-1, 3).numpy())).view_as(v)


def test_a_compass_shows_the_heading() -> None:
    errors, there = [], []
    for seen, truth in seen_by(Compass(0.2, dropout=0.3), motion="aggressive"):
        yaw = turns(truth.attitude).as_euler("ZYX")[:, 0].reshape(truth.attitude.shape[:2])
        mask = seen["compass_mask"][..., 0] > 0
        assert not seen["compass"][~mask].any()
        assert seen["compass"].abs().max() <= math.pi + 1e-6
        off = seen["compass"][..., 0].double() - torch.from_numpy(yaw.copy())
        errors.append(torch.atan2(off.sin(), off.cos())[mask])
        there.append(mask.double())
    is_normal(torch.cat(errors), 0.2)
    assert float(torch.stack(there).mean()) == pytest.approx(0.7, abs=0.03)


def test_lamps_are_dimmer_farther_away_and_seen_from_below() -> None:
    """By the formula, in numpy, where no wall is between."""
    sensor = Light(LAMPS, sight=Sight(WALLS), radius=9.0)
    errors, hidden = [], 0
    lamps = torch.tensor(LAMPS, dtype=torch.float64)
    for seen, truth in seen_by(sensor, 20, 10):
        apart = lamps - truth.position.unsqueeze(-2)
        r = apart.norm(dim=-1)
        exact = 1000 * (apart[..., 2] / r) / (r**2 + 0.1) + 20
        blocked = depth(truth.position.unsqueeze(-2), lamps, WALLS) > 0
        mask = seen["light_mask"] > 0
        assert torch.equal(mask, (r <= 9) & ~blocked)
        hidden += int((blocked & (r <= 9)).sum())
        assert not seen["light"][~mask].any()
        std = ((0.05 * exact) ** 2 + 0.25).sqrt()
        errors.append(((seen["light"] - exact) / std)[mask])
    assert hidden
    is_normal(torch.cat(errors), 1.0)


@pytest.mark.parametrize("std", [0.05, 0.6])
def test_directions_are_scattered_as_von_mises_and_fisher_have_it(std: float) -> None:
    """E z = (coth κ − 1/κ) u, and the angle about u is uniform."""
    g = torch.Generator().manual_seed(0)
    u = torch.randn(4, 3, generator=g)
    u = (u / u.norm(dim=-1, keepdim=True)).view(1, 1, 1, 4, 3)
    z = scattered(u.expand(5000, 1, 1, 4, 3), std, torch.arange(5000).view(-1, 1), "test")
    torch.testing.assert_close(z.norm(dim=-1), torch.ones(5000, 1, 1, 4))
    kappa = 1 / std**2
    mean = 1 / math.tanh(kappa) - 1 / kappa
    error = 5 * std / math.sqrt(5000)
    torch.testing.assert_close(z.mean(0), mean * u[0], rtol=0, atol=error)


def test_directions_are_of_the_body_frame() -> None:
    sensor = Light(LAMPS, angle_std=1e-4)
    lamps = torch.tensor(LAMPS, dtype=torch.float64)
    for seen, truth in seen_by(sensor, 3, 3, motion="aggressive"):
        for k, lamp in enumerate(lamps):
            way = in_body(truth.attitude, lamp - truth.position)
            way = way / way.norm(dim=-1, keepdim=True)
            mask = seen["light_mask"][..., k] > 0
            z = seen["light_direction"][..., 3 * k : 3 * k + 3].double()
            assert (z - way)[mask].abs().max() < 6e-4
            assert not z[~mask].any()


@pytest.mark.parametrize("count", [1, 2, 5, 6, 12])
def test_lamps_hang_evenly_on_the_ceiling(count: int) -> None:
    places = np.array(lamp_places(count, ROOM[1]))
    assert len(np.unique(places, axis=0)) == count
    assert (places[:, 2] == 5).all()
    np.testing.assert_allclose(places[:, 1].min() + places[:, 1].max(), 20)


def test_strength_falls_with_the_distance_and_behind_walls() -> None:
    sensor, errors, losses = Rssi(POINTS, PathLoss(walls=WALLS)), [], set()
    points = torch.tensor(POINTS, dtype=torch.float64)
    for seen, truth in seen_by(sensor, 20, 10):
        apart = truth.position.unsqueeze(-2) - points
        between = [depth(truth.position.unsqueeze(-2), points, (wall,)) > 0 for wall in WALLS]
        count = torch.stack(between).sum(0)
        losses |= set(count.flatten().tolist())
        exact = -40 - 22 * apart.norm(dim=-1).log10() - 5 * count
        errors.append(seen["rssi"] - exact)
    assert losses == {0, 1, 2}
    is_normal(torch.cat(errors), 4.0)


def test_uavs_hear_each_other_each_for_itself() -> None:
    """With the same loss on the way, but noise of their own; nobody hears itself."""
    errors, both = [], []
    for seen, truth in seen_by(UavRssi(PathLoss(std=2.0)), 20, 10):
        far = torch.cdist(truth.position, truth.position)
        mask = seen["uav_rssi_mask"] > 0
        assert torch.equal(mask, ~torch.eye(6, dtype=torch.bool).expand(20, 6, 6))
        error = seen["uav_rssi"] + 40 + 22 * far.log10()
        errors.append(error[mask])
        both.append((error * error.mT)[mask])
    is_normal(torch.cat(errors), 2.0)
    assert abs(float(torch.cat(both).mean())) < 0.3


def test_ultrasound_shows_the_nearest_wall_ahead() -> None:
    """Level, upright UAVs: forward and back in closed form, up and down by the height."""
    errors, there, far = [], [], 0
    for seen, truth in seen_by(Ultrasonic(ROOM), 20, 10, motion="random"):
        mask, z = seen["ultrasonic_mask"] > 0, seen["ultrasonic"].double()
        assert not z[~mask].any()
        forward = torch.from_numpy(turns(truth.attitude).apply((1.0, 0.0, 0.0)))
        forward = forward.view_as(truth.position)
        upright = forward[..., 2].abs() < 1e-9
        height = truth.position[..., 2]
        for beam, exact in ((4, 5 - height), (5, height)):
            close = (exact <= 4) & upright
            assert not mask[..., beam][(exact > 4) & upright].any()
            errors.append((z[..., beam] - exact)[mask[..., beam] & close])
            there.append(mask[..., beam][close].double())
        for beam, way in ((0, forward), (1, -forward)):
            to = torch.where(way > 0, torch.tensor(ROOM[1]), 0.0) - truth.position
            exact = (to / way)[..., :2].amin(-1)
            far += int((exact > 4).sum())
            errors.append((z[..., beam] - exact)[mask[..., beam] & upright])
    assert far
    is_normal(torch.cat(errors), 0.03)
    assert float(torch.cat(there).mean()) == pytest.approx(0.95, abs=0.02)


def at_nodes(sensor: Magnetic) -> tuple[Tensor, Tensor, list[np.ndarray]]:
    """The field and the map there [X, Y, Z, 3], and the coordinates of the nodes."""
    axes = [np.arange(n, dtype=float) for n in sensor.nodes]
    grid = torch.from_numpy(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    return sensor.field(grid)[0], sensor.mapped(grid)[0], axes


def test_the_field_is_scipys_interpolation_and_its_map_is_nearly_right() -> None:
    sensor = Magnetic(ROOM, std=0.3)
    true, known, axes = at_nodes(sensor)
    is_normal(known - true, 0.5)
    fields = [RegularGridInterpolator(axes, each.numpy()) for each in (true, known)]
    errors = []
    for seen, truth in seen_by(sensor, 20, 10, motion="aggressive"):
        exact, mapped = (torch.from_numpy(f(truth.position.numpy())) for f in fields)
        errors.append(seen["magnetic"] - in_body(truth.attitude, exact))
        torch.testing.assert_close(sensor.mapped(truth.position)[0], mapped)
    is_normal(torch.cat(errors), 0.3)


def test_the_anomaly_is_a_random_field() -> None:
    """Its variance, and its correlation exp(−Δ² / 2 ℓ²) at one and two nodes, along each axis."""
    room = ((0.0, 0.0, 0.0), (12.0, 12.0, 12.0))
    sensors = [Magnetic(room, building=number) for number in range(30)]
    field = torch.stack([at_nodes(s)[0] - torch.tensor(s.earth) for s in sensors])
    assert float(field.square().mean()) == pytest.approx(25.0, rel=0.05)
    for axis in (1, 2, 3):
        for apart in (1, 2):
            a, b = field.narrow(axis, 0, 11), field.narrow(axis, apart, 11)
            wanted = math.exp(-0.5 * (apart / 2) ** 2)
            assert float((a * b).mean()) / 25 == pytest.approx(wanted, abs=0.06)


def test_beyond_its_map_the_field_is_as_at_the_edge() -> None:
    sensor = Magnetic(((0.0, 0.0, 0.0), (3.0, 2.0, 2.5)))
    assert sensor.nodes == (4, 3, 4)
    out = torch.tensor([[-2.0, 1.3, 0.7], [9.0, 1.3, 0.7]], dtype=torch.float64)
    edge = torch.tensor([[0.0, 1.3, 0.7], [3.0, 1.3, 0.7]], dtype=torch.float64)
    torch.testing.assert_close(sensor.field(out)[0], sensor.field(edge)[0])
    assert not sensor.field(out)[1][..., 0].any()


@pytest.mark.parametrize("sensor", EVERY, ids=lambda s: type(s).__name__)
def test_a_row_is_the_world_of_its_seed(sensor: Sensor) -> None:
    """To the bit, whatever the batch."""
    scenario = replace(
        make_scenario("indoor-v0", imu=False, motion="aggressive"), sensors=(sensor,)
    )
    batch, alone = World(scenario, 3), World(scenario)
    whole, one = batch.reset(torch.arange(3)), alone.reset(1)
    for _ in range(3):
        for name, leaf in one.leaves.items():
            assert torch.equal(whole[name][1:2], leaf), name
        batch.advance(torch.zeros(3, 6, 9))
        alone.advance(torch.zeros(1, 6, 9))
        whole, one = batch.observation(), alone.observation()


def test_senses_change_no_number_of_others() -> None:
    senses = dict.fromkeys(("compass", "light", "rssi", "ultrasonic", "magnetic"), True)
    plain, whole = (
        World(make_scenario("indoor-v0", **each), 2).reset(torch.arange(2)) for each in ({}, senses)
    )
    assert len(whole.leaves) - len(plain.leaves) == 2 + 4 + 3 + 2 + 2
    for name, leaf in plain.leaves.items():
        assert torch.equal(whole[name], leaf), name


def test_walls_of_the_network_are_what_senses_meet() -> None:
    wall = (11.0, 5.0, 0.0, 11.5, 12.0, 5.0)
    scenario = make_scenario("indoor-v0", walls=wall, light=True, rssi=True, ultrasonic=True)
    for sensor in scenario.sensors[-3:]:
        found = {Rssi: "loss", Light: "sight"}.get(type(sensor))
        walls = (getattr(sensor, found) if found else sensor).walls
        assert walls == (((11.0, 5.0, 0.0), (11.5, 12.0, 5.0)),)


@pytest.mark.parametrize(
    ("kind", "wrong", "words"),
    [
        (Compass, {"std": -1.0}, "std=-1.0 is not allowed: a standard deviation in rad"),
        (Compass, {"dropout": 2.0}, "dropout=2.0 is not allowed: a probability"),
        (Light, {"lamps": ()}, "at least one lamp"),
        (Light, {"lamps": LAMPS, "power": 0.0}, "power=0.0 is not allowed: an intensity at 1 m"),
        (Light, {"lamps": LAMPS, "angle_std": 0.0}, "angle_std=0.0 is not allowed: an angle"),
        (Light, {"lamps": LAMPS, "share": 1.0}, "share=1.0 is not allowed: a share"),
        (Rssi, {"points": ()}, "at least one access point"),
        (PathLoss, {"exponent": 0.0}, "exponent=0.0 is not allowed: a number > 0"),
        (
            PathLoss,
            {"wall_loss": -1.0},
            "wall_loss=-1.0 is not allowed: a loss in dB",
        ),
        (Ultrasonic, {"room": ROOM, "reach": 0.0}, "reach=0.0 is not allowed: a distance in m > 0"),
        (Ultrasonic, {"room": ((0.0, 0.0), (1.0, 1.0))}, "corners of three numbers"),
        (Magnetic, {"room": ROOM, "map_std": -1.0}, "map_std=-1.0 is not allowed"),
        (Magnetic, {"room": ROOM, "length": 0.0}, "length=0.0 is not allowed: a distance in m > 0"),
        (Magnetic, {"room": (ROOM[0], (999.0, 999.0, 9.0))}, "a map of at most 200000 nodes"),
    ],
)
def test_settings_are_checked(kind: Any, wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        kind(**wrong)


@pytest.mark.parametrize("sensor", [Light(LAMPS), Ultrasonic(ROOM), Magnetic(ROOM)])
def test_senses_of_space_need_three_dimensions(sensor: Sensor) -> None:
    with pytest.raises(ValueError, match="a 3-D scenario"):
        sensor.leaves(Layout(Arena(2, 3, 0.1, (0.0, 0.0), (1.0, 1.0)), 3))
