"""Drawn motions: distributions, limits, attitudes."""

import math

import pytest
import torch

from coloc_env.geometry import rotation_matrix
from coloc_env.motion import (
    Aggressive,
    RandomCircles,
    RandomHelices,
    RandomVelocity,
    Waypoints,
    Weave,
)
from coloc_env.motion.aggressive import _BASIS, PEAKS
from coloc_env.motion.frames import GRAVITY, heading

ROOM = (30.0, 20.0, 5.0)
SEEDS = list(range(50))


def test_random_circles_draw_all_they_say(fly, arena):
    motion = RandomCircles(speed=(0.3, 0.9), radius=(1.0, 4.0), height_amplitude=(0.1, 0.4))
    truth = fly(motion, arena(*ROOM), SEEDS, 2)
    speed = truth.velocity[:, 0, :, :2].norm(dim=-1).flatten()
    assert 0.3 <= speed.min() < 0.35
    assert 0.85 < speed.max() <= 0.9
    before, after = (truth.velocity[:, k, :, :2] for k in (0, 1))
    turn = (before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]).flatten()
    assert 0.35 < (turn > 0).double().mean() < 0.65  # both directions
    radius = 0.1 * speed**3 / turn.abs()  # v / ω, with |v × v'| ≈ v² ω dt
    assert 0.99 < radius.min() < 1.2
    assert 3.8 < radius.max() < 4.05
    around = heading(*(truth.velocity[:, 0, :, :2] / speed.view(50, 6, 1)).flatten(0, 1).T)
    assert torch.histc(around, 6, -math.pi, math.pi).min() > 25  # 50 expected in each


def test_random_circles_reach_the_whole_room(fly, arena):
    position = fly(RandomCircles(), arena(*ROOM), list(range(300)), 600).position.flatten(0, 2)
    assert (position.amin(0) < torch.tensor([0.7, 0.7, 0.6])).all()
    assert (position.amax(0) > torch.tensor(ROOM) - torch.tensor([0.7, 0.7, 0.6])).all()


def test_a_route_is_flown_from_point_to_point(fly, arena):
    points = ((2.0, 2.0, 1.0), (9.0, 3.0, 2.0), (9.0, 3.0, 4.0), (5.0, 8.0, 1.5))
    motion = Waypoints(route=points, duration=6.0, pause=2.0)
    truth = fly(motion, arena(*ROOM, n=2), [0], 400)
    for leg in range(4):
        resting = slice(80 * leg + 60, 80 * leg + 81)
        for uav, ahead in ((0, 1), (1, 3)):  # UAV 1 is half a route ahead
            arrived = truth.position[0, resting, uav]
            expected = torch.tensor(points[(leg + ahead) % 4]).double().expand_as(arrived)
            torch.testing.assert_close(arrived, expected, rtol=0, atol=1e-9)
            assert truth.velocity[0, resting, uav].abs().max() < 1e-6
    longest = max(math.dist(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True))
    assert truth.velocity.norm(dim=-1).max() == pytest.approx(1.875 * longest / 6, rel=1e-3)


def test_random_waypoints_keep_their_speed_limit(fly, arena):
    motion = Waypoints(max_speed=2.0)
    truth = fly(motion, arena(*ROOM), SEEDS, 3000)
    assert 1.2 < truth.velocity.norm(dim=-1).max() <= 2.0
    spread = truth.position.flatten(0, 2)
    assert (spread.amin(0) < 1.0).all()
    assert (spread.amax(0) > torch.tensor(ROOM) - 1.0).all()


def test_the_peaks_of_the_spline_are_those_of_its_basis():
    u = torch.linspace(0, 1, 2001, dtype=torch.float64)
    for order, peak in enumerate(PEAKS, start=1):
        sums = torch.zeros_like(u)
        for row in _BASIS:
            powers = range(order, 6)
            sums += sum(math.perm(p, order) * row[p] / 120 * u ** (p - order) for p in powers).abs()
        assert sums.max().item() == pytest.approx(peak, rel=1e-6)


@pytest.mark.parametrize("sides", [ROOM, (4.0, 4.0, 2.5), (8.0, 6.0, 40.0), (12.0, 9.0)])
@pytest.mark.parametrize("limits", [(4.5, 12.0, 60.0), (2.0, 3.0, 1e3), (9.0, 12.0, 10.0)])
def test_aggressive_flight_keeps_its_limits_and_uses_them(sides, limits, fly, arena):
    dt = 0.005
    truth = fly(Aggressive(*limits), arena(*sides, dt=dt), [1, 2, 3], 30_000)
    acceleration = truth.velocity.diff(dim=1) / dt
    jerk = acceleration.diff(dim=1) / dt
    used = [
        x.norm(dim=-1).max().item() / limit
        for x, limit in zip((truth.velocity, acceleration, jerk), limits, strict=True)
    ]
    assert max(used) <= 1
    assert max(used) > 0.45


def test_aggressive_flight_points_its_thrust(fly, arena):
    dt = 1e-3
    truth = fly(Aggressive(), arena(*ROOM, dt=dt), [4], 20_000)
    acceleration = (truth.velocity[:, 2:] - truth.velocity[:, :-2]) / (2 * dt)
    force = acceleration + torch.tensor([0.0, 0.0, GRAVITY])
    body = rotation_matrix(truth.attitude[:, 1:-1])
    thrust = force / force.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(body[..., 2], thrust, rtol=0, atol=1e-4)
    assert thrust[..., 2].min() < 0.95  # it does tilt


def test_random_velocity_follows_the_model_of_the_spec(fly, arena):
    room = arena(10e3, 10e3, 5e3, n=200, dt=1.0)
    motion = RandomVelocity(v_max=50.0)
    truth = fly(motion, room, [1, 2, 3], 400)
    assert truth.velocity.norm(dim=-1).max() <= 50.0
    start = truth.position[:, 0].flatten(0, 1)
    torch.testing.assert_close(start.mean(0), torch.tensor(room.centre).double(), rtol=0.06, atol=0)
    first = truth.velocity[:, 0].norm(dim=-1).flatten()
    assert first.mean() == pytest.approx(25.0, rel=0.06)  # uniform speed
    up = (truth.velocity[:, 0, :, 2].flatten() / first).sort().values
    assert (up - torch.linspace(-1, 1, len(up))).abs().max() < 0.12  # uniform on the sphere
    # Away from walls an unchanged target leaves v₊ − v shrinking by exp(−dt / lag) a step.
    change = truth.velocity.diff(dim=1)
    kept = (change[:, 1:] - math.exp(-1 / 3) * change[:, :-1]).norm(dim=-1) < 1e-9
    assert (~kept).double().mean() == pytest.approx(0.1, abs=0.01)  # new targets, rarely a wall


def test_walls_reflect(fly, arena):
    room = arena(6.0, 5.0, 4.0, dt=0.1)
    truth = fly(RandomVelocity(v_max=8.0, lag=20.0, interval=1e6), room, [1, 2], 2000)
    low, high = truth.position.flatten(0, 2).aminmax(dim=0)
    assert (low >= 0).all()
    assert (high <= torch.tensor([6.0, 5.0, 4.0])).all()
    speed = truth.velocity.abs()
    torch.testing.assert_close(speed, speed[:, :1].expand_as(speed))  # only signs ever change
    assert (truth.velocity[:, 1:] * truth.velocity[:, :-1] < 0).any(1).all()


def test_an_infinite_interval_makes_straight_lines(fly, arena):
    truth = fly(RandomVelocity(v_max=8.0, interval=math.inf), arena(*ROOM), SEEDS, 400)
    speed = truth.velocity.abs()
    assert torch.equal(speed, speed[:, :1].expand_as(speed))  # walls change signs, nothing else
    assert (truth.velocity.sign().diff(dim=1) != 0).any()
    total = truth.velocity[:, 0].norm(dim=-1).flatten()
    assert total.max() <= 8.0
    assert total.mean() == pytest.approx(4.0, abs=5 * 8 / math.sqrt(12 * 300))  # uniform


def test_helices_are_circles_that_climb_between_floor_and_ceiling(fly, arena):
    motion = RandomHelices(RandomCircles(height_amplitude=(0.0, 0.0), margin=0.7), climb=(0.2, 0.6))
    truth = fly(motion, arena(*ROOM), SEEDS, 1000)
    level = fly(motion.circles, arena(*ROOM), SEEDS, 1000)
    assert torch.equal(truth.position[..., :2], level.position[..., :2])
    rate = truth.velocity[..., 2]
    # A triangle wave from the closed form of its unfolded path.
    rise, height = ROOM[2] - 1.4, level.position[:, :1, :, 2] - 0.7
    path = height + rate[:, :1] * 0.1 * torch.arange(1000).view(1, -1, 1)
    wave = rise - (path.remainder(2 * rise) - rise).abs()
    torch.testing.assert_close(truth.position[..., 2] - 0.7, wave, rtol=0, atol=1e-9)
    assert 0.2 <= rate.abs().min() < 0.21
    assert 0.59 < rate.abs().max() <= 0.6
    assert 0.35 < (rate[:, 0] > 0).double().mean() < 0.65
    assert (rate.sign().diff(dim=1) != 0).any(1).all()


def test_a_weave_crosses_at_the_centres_of_its_groups(fly, arena):
    """At drawn speeds, on curves of drawn size."""
    speeds, lengths, swings = (1.0, 2.0), (3.0, 4.0), (0.2, 1.0)
    motion = Weave(speeds, lengths, swings, group=5)
    room = arena(60.0, 50.0, 8.0, n=14, dt=0.02)
    truth = fly(motion, room, SEEDS[:6], 3000)
    groups = torch.arange(14) % 3
    low, high = truth.position.amin(1), truth.position.amax(1)
    middle, half = (low + high) / 2, (high - low) / 2  # a figure of eight is symmetric
    for group in range(3):
        centre = middle[:, groups == group]
        torch.testing.assert_close(centre, centre[:, :1].expand_as(centre), rtol=0, atol=1e-3)
    between = middle[:, 1:3] - middle[:, :2]
    assert (between.norm(dim=-1) > 1.0).all()
    across = (truth.position - middle.unsqueeze(1))[..., :2].norm(dim=-1)
    assert (across.amin(1) < 0.05).all()  # all pass the centre
    reach = across.amax(1)
    assert 3.0 - 1e-3 <= reach.min() < 3.1
    assert 3.9 < reach.max() <= 4.0
    assert 0.2 - 1e-3 <= half[..., 2].min() < 0.3
    assert 0.9 < half[..., 2].max() <= 1.0
    assert truth.velocity.norm(dim=-1).max() <= 2.0
    assert truth.velocity.norm(dim=-1).amax(1).min() > 0.9
    acceleration = (truth.velocity.diff(dim=1) / 0.02).norm(dim=-1)
    assert acceleration.max() <= 17 / 16 * 4.0 / 3.0


def test_the_acceleration_of_a_figure_of_eight_is_what_weave_says(fly, arena):
    motion = Weave((2.0, 2.0), (3.0, 3.0), (0.0, 0.0), group=2)
    truth = fly(motion, arena(*ROOM, dt=1e-3), [0, 1], 20_000)
    acceleration = (truth.velocity.diff(dim=1) / 1e-3).norm(dim=-1)
    assert float(acceleration.max()) == pytest.approx(17 / 16 * 4 / 3, rel=1e-4)
    assert float(truth.velocity.norm(dim=-1).max()) == pytest.approx(2.0, rel=1e-6)


def test_half_of_a_weaving_group_flies_backwards(fly, arena):
    """On the lobe that a figure of eight's own axis points to, the turn tells the sense."""
    motion = Weave((1.0, 1.0), (3.0, 3.0), (0.0, 0.0), group=4)
    room = arena(*ROOM, n=8)
    carry = motion.start(torch.arange(5), room)
    truth, _ = motion.advance(carry, torch.arange(400).expand(5, -1), room)
    axis = carry["curve"][:, 3:5].transpose(1, 2).unsqueeze(1)
    away = truth.position[..., :2] - carry["centre"][:, :2].transpose(1, 2).unsqueeze(1)
    right = (away * axis).sum(-1) > 1.5  # well inside the lobe
    before, after = truth.velocity[:, :-1, :, :2], truth.velocity[:, 1:, :, :2]
    turn = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    clockwise = turn < 0
    expected = (torch.arange(8) // 2 % 2 == 0).expand_as(turn)
    assert torch.equal(clockwise[right[:, :-1]], expected[right[:, :-1]])


def test_each_uav_keeps_to_its_box(fly, arena):
    """Which are filled in proportion to their volumes, from the start on."""
    boxes = (((0.0, 0.0, 0.0), (2.0, 5.0, 4.0)), ((3.0, 1.0, 0.0), (6.0, 5.0, 2.0)))
    motion = RandomVelocity(v_max=8.0, boxes=boxes)
    position = fly(motion, arena(6.0, 5.0, 4.0, n=40), SEEDS, 300).position
    within = []
    for low, high in torch.tensor(boxes).double():
        within.append(((position >= low) & (position <= high)).all(-1))
        reached = position[within[-1].all(1).unsqueeze(1).expand(position.shape[:3])]
        torch.testing.assert_close(reached.amin(0), low, rtol=0, atol=0.05)
        torch.testing.assert_close(reached.amax(0), high, rtol=0, atol=0.05)
    first, second = (inside.all(1) for inside in within)
    assert (first ^ second).all()
    share = 40 / 64
    spread = 5 * math.sqrt(share * (1 - share) / first.numel())
    assert first.double().mean() == pytest.approx(share, abs=spread)
    start = position[:, 0][second]
    middle = torch.tensor(boxes[1]).double().mean(0)
    torch.testing.assert_close(start.mean(0), middle, rtol=0, atol=0.1)


def test_heading_is_that_of_the_vector_everywhere():
    angle = torch.linspace(-math.pi, math.pi, 10_001, dtype=torch.float64)
    torch.testing.assert_close(heading(angle.cos(), angle.sin()), angle, rtol=0, atol=1e-15 * 4)
