"""What every motion promises: rows, windows, derivatives, attitudes, walls."""

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coloc_env.geometry import rotation_between, rotation_matrix
from coloc_env.motion import (
    MOTIONS,
    Circle,
    RandomCircles,
    RandomHelices,
    RandomVelocity,
    Square,
    Waypoints,
    Weave,
)
from tests.sampling import crossed

ROOM = (30.0, 20.0, 5.0)
ROUTE = Waypoints(route=((2.0, 2.0, 1.0), (9.0, 3.0, 2.0), (9.0, 3.0, 4.0), (5.0, 8.0, 1.5)))
SHARP = Square(sharp=True)
TWO = (((0.0, 0.0, 0.0), (8.0, 20.0, 5.0)), ((20.0, 5.0, 1.0), (30.0, 9.0, 5.0)))
CORNERS = torch.tensor(TWO, dtype=torch.float64)
ALL = {
    **MOTIONS,
    "route": ROUTE,
    "sharp": SHARP,
    "fast_swarm": RandomVelocity(v_max=50.0),
    "boxes": RandomVelocity(boxes=TWO),
    "lines": RandomVelocity(interval=math.inf),
    "circles_in_boxes": RandomCircles(boxes=TWO),
    "helices": RandomHelices(),
    "helices_in_boxes": RandomHelices(RandomCircles(boxes=TWO), climb=(0.5, 2.0)),
    "weave": Weave(group=3),
    "weave_in_boxes": Weave(group=2, boxes=TWO),
}
# Velocity jumps at corners or walls.
JUMPY = {"sharp", "random_velocity", "fast_swarm", "boxes", "lines", "helices", "helices_in_boxes"}
SMOOTH = [name for name in ALL if name not in JUMPY]
LEVEL = [name for name in ALL if name != "aggressive"]
ALIGNED = [name for name in SMOOTH if name not in {"aggressive", "formation"}]
UPRIGHT = {"helix", "route", "helices"}  # never fly in 2-D
FLAT = [name for name in ALL if name not in UPRIGHT and not name.endswith("boxes")]
EVERYWHERE = [name for name in MOTIONS if name != "circle"]  # fit any room as they are


def same(a, b):
    return all(
        torch.equal(getattr(a, name), getattr(b, name))
        for name in ("position", "velocity", "attitude")
    )


def row(truth, b):
    return type(truth)(
        truth.position[b : b + 1], truth.velocity[b : b + 1], truth.attitude[b : b + 1]
    )


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize(("rows", "n"), [(2, 6), (5, 7), (37, 3)])
def test_a_row_does_not_depend_on_its_batch(name, rows, n, fly, arena):
    room = arena(*ROOM, n=n)
    seeds = [100 + 7 * b for b in range(rows)]
    first = [(31 * b) % 50 for b in range(rows)]  # rows reset at different times
    batch = fly(ALL[name], room, seeds, 24, window=8, first=first)
    for b in {0, rows // 2, rows - 1}:
        alone = fly(ALL[name], room, [seeds[b]], 24, window=8, first=[first[b]])
        assert same(row(batch, b), alone)


@pytest.mark.parametrize("name", FLAT)
def test_a_row_in_the_plane_does_not_depend_on_its_batch(name, fly, arena):
    room = arena(*ROOM[:2], n=5)
    batch = fly(ALL[name], room, list(range(13)), 30)
    assert batch.position.shape == batch.velocity.shape == (13, 30, 5, 2)
    assert batch.attitude.shape == (13, 30, 5, 1)
    assert batch.attitude.abs().max() <= math.pi
    assert same(row(batch, 12), fly(ALL[name], room, [12], 30, window=1))


@pytest.mark.parametrize("name", ALL)
def test_windows_change_no_number(name, fly, arena):
    whole = fly(ALL[name], arena(*ROOM), [3, 4], 130)
    for window in (1, 7, 64):
        assert same(whole, fly(ALL[name], arena(*ROOM), [3, 4], 130, window=window))


@pytest.mark.parametrize("name", ALL)
def test_shapes_and_precision(name, fly, arena):
    truth = fly(ALL[name], arena(*ROOM), [1, 2, 3], 4)
    assert truth.position.shape == truth.velocity.shape == (3, 4, 6, 3)
    assert truth.attitude.shape == (3, 4, 6, 4)
    assert {truth.position.dtype, truth.velocity.dtype, truth.attitude.dtype} == {torch.float64}


@pytest.mark.parametrize(("name", "dim"), crossed(ALL, [2, 3], every=2))
def test_velocity_is_the_derivative_of_position(name, dim, fly, arena):
    if dim == 2 and name not in FLAT:
        pytest.skip("3-D only")
    dt = 1e-3
    truth = fly(ALL[name], arena(*ROOM[:dim], dt=dt), [5, 6], 12_000)
    difference = (truth.position[:, 2:] - truth.position[:, :-2]) / (2 * dt)
    error = (difference - truth.velocity[:, 1:-1]).abs().amax((-1, -2))
    if name in JUMPY:
        jump = truth.velocity.diff(dim=1).abs().amax((-1, -2))
        scale = max(1.0, truth.velocity.abs().max().item())
        smooth = torch.maximum(jump[:, 1:], jump[:, :-1]) < 1e-3 * scale
        assert smooth.double().mean() > 0.8
        assert error[smooth].max() < 1e-3 * scale
    else:
        assert error.max() < 1e-5
        assert truth.velocity.diff(dim=1).norm(dim=-1).max() < 8 * dt  # m/s²


@pytest.mark.parametrize("name", ALL)
def test_attitudes_are_unit_and_turn_smoothly(name, fly, arena):
    dt = 0.01
    attitude = fly(ALL[name], arena(*ROOM, dt=dt), [7], 12_000).attitude
    assert (attitude.norm(dim=-1) - 1).abs().max() < 1e-14
    assert attitude[..., 0].min() >= 0
    if name not in JUMPY:
        turn = rotation_between(attitude[:, :-1], attitude[:, 1:]).norm(dim=-1)
        assert turn.max() < 3.5 * dt  # rad/s


@pytest.mark.parametrize("name", LEVEL)
def test_level_motions_only_yaw(name, fly, arena):
    attitude = fly(ALL[name], arena(*ROOM), [8], 500).attitude
    assert not attitude[..., 1:3].any()


@pytest.mark.parametrize("name", [*ALIGNED, "sharp"])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_x_axis_leads_along_the_horizontal_velocity(name, dim, fly, arena):
    if dim == 2 and name not in FLAT:
        pytest.skip("3-D only")
    truth = fly(ALL[name], arena(*ROOM[:dim]), [9, 10], 3000)
    speed = truth.velocity[..., :2].norm(dim=-1)
    ahead = rotation_matrix(truth.attitude)[..., :2, 0]
    along = (ahead * truth.velocity[..., :2]).sum(-1)
    assert ((along - speed).abs() <= 1e-9 * speed + 1e-12).all()


def inside(truth, room, slack=1e-9):
    low, high = (torch.tensor(end, dtype=torch.float64) for end in (room.low, room.high))
    return bool(((truth.position >= low - slack) & (truth.position <= high + slack)).all())


@settings(
    max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    sides=st.tuples(st.floats(4, 200), st.floats(4, 200), st.floats(2.5, 60)),
    low=st.floats(-50, 50),
    n=st.integers(1, 9),
    seed=st.integers(0, 2**31),
)
@pytest.mark.parametrize("name", EVERYWHERE)
def test_defaults_stay_in_any_room(name, sides, low, n, seed, fly, arena):
    room = arena(*sides, n=n, low=low)
    truth = fly(MOTIONS[name], room, [seed, seed + 1], 3000)
    assert torch.isfinite(truth.velocity).all()
    assert inside(truth, room)
    if name != "helix":
        room = arena(*sides[:2], n=n, low=low)
        assert inside(fly(MOTIONS[name], room, [seed], 3000), room)


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    sides=st.tuples(st.floats(4, 20), st.floats(4, 20), st.floats(2.5, 5)),
    speed=st.floats(0.05, 3),
    rate=st.floats(0.05, 3),
    height=st.floats(0, 5),
    swing=st.floats(0, 3),
)
def test_a_circle_fits_or_says_why(sides, speed, rate, height, swing, fly, arena):
    room, motion = arena(*sides), Circle(speed, rate, height, swing)
    if speed / rate <= 0.5 * min(sides[:2]) and swing <= min(height, sides[2] - height):
        assert inside(fly(motion, room, [0], 3000), room)
    else:
        with pytest.raises(ValueError, match=r"Circle: .* (at most \d|must be in \[)"):
            fly(motion, room, [0], 1)


@pytest.mark.parametrize("name", MOTIONS)
def test_ten_kilometres(name, fly, arena):
    room = arena(10e3, 10e3, 5e3, n=20, dt=1.0)
    truth = fly(MOTIONS[name], room, [11], 5000)
    assert inside(truth, room)
    assert truth.velocity.norm(dim=-1).max() <= 50.0


@pytest.mark.parametrize("name", ["helices", "helices_in_boxes"])
def test_helices_need_three_dimensions(name, fly, arena):
    with pytest.raises(ValueError, match="RandomHelices needs an arena of 3 dimensions, not 2"):
        fly(ALL[name], arena(*ROOM[:2]), [0], 1)


@pytest.mark.parametrize("name", [name for name in ALL if name.endswith("in_boxes")])
def test_each_uav_keeps_to_a_box_of_its_own(name, fly, arena):
    """And every box has its share of them."""
    position = fly(ALL[name], arena(*ROOM), list(range(60)), 3000).position
    within = [((position >= low) & (position <= high)).all(-1).all(1) for low, high in CORNERS]
    assert (within[0] ^ within[1]).all()
    groups = position.shape[2] // 2 if name == "weave_in_boxes" else position.shape[2]
    sides = (CORNERS[:, 1] - CORNERS[:, 0]).prod(-1)
    share = float(sides[0] / sides.sum())
    spread = 5 * math.sqrt(share * (1 - share) / (60 * groups))
    assert within[0].double().mean() == pytest.approx(share, abs=spread)


@pytest.mark.parametrize(
    "name", ["random", "waypoints", "aggressive", "random_velocity", "lines", "helices", "weave"]
)
def test_worlds_and_uavs_fly_different_paths(name, fly, arena):
    position = fly(ALL[name], arena(*ROOM), list(range(40)), 1).position[:, 0].flatten(0, 1)
    assert len(position.unique(dim=0)) == 240
