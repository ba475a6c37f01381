"""Scripted curves against their formulas."""

import math

import pytest
import torch

from coloc_env.geometry import rotation_matrix, wrap_angle
from coloc_env.motion import (
    Circle,
    FigureEight,
    FormationChange,
    Helix,
    Line,
    RecordedMotion,
    Square,
    StopAndGo,
)
from coloc_env.series import Series

ROOM = (30.0, 20.0, 5.0)


def distances(position):
    """Smallest distance between any two UAVs."""
    apart = (position.unsqueeze(-2) - position.unsqueeze(-3)).norm(dim=-1)
    n = position.shape[-2]
    return apart[..., ~torch.eye(n, dtype=torch.bool)].min()


def test_the_circle_of_indoor_v0(fly, arena):
    truth = fly(Circle(), arena(*ROOM), [0], 1000)
    t = 0.1 * torch.arange(1000, dtype=torch.float64).unsqueeze(-1)
    theta = 0.15 * t + math.pi / 3 * torch.arange(6).double()
    radius = 0.5 / 0.15
    x, y, z = truth.position[0].unbind(-1)
    close = {"rtol": 0, "atol": 1e-12}
    torch.testing.assert_close(x, 15 + radius * theta.cos(), **close)
    torch.testing.assert_close(y, 10 + radius * theta.sin(), **close)
    torch.testing.assert_close(z, 1.5 + 0.3 * theta.sin(), **close)
    assert z.min() >= 1.2
    assert z.max() <= 1.8
    torch.testing.assert_close(
        truth.velocity[0, ..., :2].norm(dim=-1), torch.full((1000, 6), 0.5).double(), **close
    )
    torch.testing.assert_close(truth.velocity[0, ..., 2], 0.045 * theta.cos(), **close)
    yaw = theta + math.pi / 2
    body_x = rotation_matrix(truth.attitude)[0, ..., 0]
    expected = torch.stack((yaw.cos(), yaw.sin(), 0 * yaw), -1)
    torch.testing.assert_close(body_x, expected, **close)


def test_helix_climbs_at_its_rate_between_its_margins(fly, arena):
    truth = fly(Helix(climb=0.3, margin=0.7), arena(*ROOM), [0], 2000)
    z, rate = truth.position[..., 2], truth.velocity[..., 2]
    assert z.min() == pytest.approx(0.7, abs=1e-3)
    assert z.max() == pytest.approx(4.3, abs=1e-3)
    assert rate.abs().max() == pytest.approx(0.3, abs=1e-9)
    assert (rate.abs() > 0.299).double().mean() > 0.5
    with pytest.raises(ValueError, match="Helix needs an arena of 3 dimensions, not 2"):
        fly(Helix(), arena(30.0, 20.0), [0], 1)


def test_lanes_are_straight_parallel_and_spread(fly, arena):
    truth = fly(Line(speed=1.0), arena(*ROOM), [0], 1500)
    x, y, z = truth.position[0].unbind(-1)
    assert torch.equal(y, y[:1].expand_as(y))
    torch.testing.assert_close(y[0], 0.5 + 19 * (torch.arange(6).double() + 0.5) / 6)
    assert len(z[0].unique()) == 6
    assert (x.min(), x.max()) == (pytest.approx(0.5, abs=1e-3), pytest.approx(29.5, abs=1e-3))
    assert (truth.velocity[..., 0].abs() == 1.0).double().mean() > 0.7
    level = fly(Line(height=2.0), arena(*ROOM), [0], 3)
    assert (level.position[..., 2] == 2.0).all()


@pytest.mark.parametrize("n", [1, 2, 5, 6])
def test_figure_eight_crosses_without_meeting(n, fly, arena):
    truth = fly(FigureEight(), arena(*ROOM[:2], n=n), [0], 3000)
    speed = truth.velocity[..., :2].norm(dim=-1)
    assert speed.max() == pytest.approx(1.0, abs=1e-3)
    assert truth.position[..., 0].max() == pytest.approx(29.5, abs=1e-2)
    if n > 1:
        assert distances(truth.position) > 0.5


def test_the_sharp_square_of_wsn_v0(fly, arena):
    square = Square(side=6.0, corner=(2.0, 2.0), period=40.0, sharp=True)
    truth = fly(square, arena(10.0, 10.0, n=1), [0], 401)
    corners = {0: (2, 2), 100: (8, 2), 200: (8, 8), 300: (2, 8), 400: (2, 2)}
    for step, corner in corners.items():
        assert truth.position[0, step, 0].tolist() == pytest.approx(corner, abs=1e-12)
    sides = [(0.6, 0.0), (0.0, 0.6), (-0.6, 0.0), (0.0, -0.6)]
    for k in range(400):
        assert truth.velocity[0, k, 0].tolist() == pytest.approx(sides[k // 100], abs=1e-12)


@pytest.mark.parametrize("steps", [3, 7, 29, 49, 107])
def test_a_sharp_square_turns_on_the_very_step(steps, fly, arena):
    square = Square(side=6.0, period=4 * steps * 0.1, sharp=True)
    velocity = fly(square, arena(10.0, 10.0, n=1), [0], 40 * steps).velocity[0, :, 0]
    turns = (velocity.diff(dim=0).abs().amax(-1) > 0).nonzero()[:, 0] + 1
    assert turns.tolist() == list(range(steps, 40 * steps, steps))


def test_the_square_stops_in_its_corners(fly, arena):
    truth = fly(Square(side=6.0, corner=(2.0, 3.0), period=60.0), arena(10.0, 10.0, 3.0), [0], 601)
    for leg, corner in enumerate([(8, 3), (8, 9), (2, 9), (2, 3)]):
        resting = 150 * (leg + 1) - 5
        assert truth.position[0, resting, 0, :2].tolist() == pytest.approx(corner, abs=1e-9)
        assert truth.velocity[0, resting, 0].norm() == 0
    assert (truth.position[..., 2] == 1.5).all()


def test_stop_and_go_stops_each_uav_in_its_turn(fly, arena):
    truth = fly(StopAndGo(), arena(*ROOM), [0], 1100)
    speed = truth.velocity[0, ..., :2].norm(dim=-1)
    assert speed.max() == pytest.approx(0.5, abs=1e-9)
    resting = (speed == 0).double()
    torch.testing.assert_close(
        resting.mean(0), torch.full((6,), 3 / 11).double(), atol=0.02, rtol=0
    )
    assert resting.sum(-1).max() < 6  # never all at once
    assert distances(truth.position) > 1
    place = truth.position[0, -110:, :, :2] - torch.tensor([15.0, 10.0])  # one cycle
    angle = torch.atan2(place[..., 1], place[..., 0])
    lead = wrap_angle(angle - angle[:, :1] - math.pi / 3 * torch.arange(6).double()).mean(0)
    assert lead.abs().max() < 1e-3


@pytest.mark.parametrize("n", range(2, 14))
def test_formations_change_shape_without_collisions(n, fly, arena):
    motion = FormationChange(size=4.0, speed=0.4, period=20.0, blend=8.0)
    truth = fly(motion, arena(*ROOM, n=n), [0], 1600)
    assert distances(truth.position) > 0.2
    centre = truth.position[0].mean(-2)
    place = truth.position[0] - centre.unsqueeze(-2)
    ahead = rotation_matrix(truth.attitude)[0, ..., 0]
    assert torch.equal(ahead, ahead[:, :1].expand_as(ahead))
    forward = (place * ahead).sum(-1)
    size = place.norm(dim=-1).amax(-1)
    for shape in range(4):  # line, ring, vee, grid, each held for 12 s
        torch.testing.assert_close(
            size[200 * shape : 200 * shape + 120], torch.full((120,), 4.0).double()
        )
    assert forward[:120].abs().max() < 1e-9  # abreast
    ring = place[200:320].norm(dim=-1)
    torch.testing.assert_close(ring, torch.full_like(ring, 4.0))
    if n % 2:
        assert (forward[400:520].argmax(-1) == n // 2).all()  # the leader flies in the middle
    assert truth.velocity.norm(dim=-1).max() <= 0.4 * (1 + 4 / 5.5) + 3.75 * 4 / 8


def test_recorded_motion_replays_its_tape_and_then_stays(fly, arena):
    room = arena(*ROOM)
    flight = fly(Circle(), room, [0], 50)
    motion = RecordedMotion(
        Series(flight.position[0]), Series(flight.velocity[0]), Series(flight.attitude[0])
    )
    replay = fly(motion, room, [1, 2], 60, window=7, first=[0, 20])
    assert torch.equal(replay.position[0, :50], flight.position[0])
    assert torch.equal(replay.velocity[1, :30], flight.velocity[0, 20:])
    assert torch.equal(replay.attitude[:, -1], flight.attitude[:, -1].expand(2, -1, -1))
    with pytest.raises(
        ValueError, match=r"RecordedMotion: position must be float64 of shape \(50, 5, 3\)"
    ):
        fly(motion, arena(*ROOM, n=5), [0], 1)
    halved = Series(flight.velocity[0].float())
    single = RecordedMotion(Series(flight.position[0]), halved, Series(flight.attitude[0]))
    with pytest.raises(ValueError, match="RecordedMotion: velocity must be float64"):
        fly(single, room, [0], 1)
