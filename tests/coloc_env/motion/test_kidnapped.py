"""Kidnapping: where UAVs are found, what senses it and what does not, and what is refused."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from coloc_env import noise
from coloc_env.bounds import posterior_bound
from coloc_env.geometry import rotate, rotate_by
from coloc_env.motion import MOTIONS, Arena, Kidnapped, Kinematics, Motion, RandomVelocity
from coloc_env.network import Network
from coloc_env.scenario import Inertial, Prior, Scenario, Wheeled
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import GRAVITY, AnchorRanging, Imu, Odometry, RangeNoise, Sensor
from coloc_env.world import World
from training.evaluation.evaluate import evaluate

ROOM = (30.0, 20.0, 5.0)
DT = 0.1
FLAT = [name for name in MOTIONS if name != "helix"]  # those that fly in 2-D

some = settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def same(a: Kinematics, b: Kinematics) -> bool:
    return all(
        torch.equal(getattr(a, name), getattr(b, name))
        for name in ("position", "velocity", "attitude")
    )


def part(truth: Kinematics, steps: slice, uavs: Any = slice(None)) -> Kinematics:
    """Some steps and UAVs."""
    cut = (x[:, steps, uavs] for x in (truth.position, truth.velocity, truth.attitude))
    return Kinematics(*cut)


# ---------------------------------------------------------------- where they are


@pytest.mark.parametrize("name", MOTIONS)
@some
@given(
    at=st.integers(1, 100),
    seed=st.integers(0, 2**31),
    low=st.floats(-50, 50),
    height=st.floats(4, 9),
)
def test_they_are_across_the_arena_from_then_on_and_stay_in_it(
    name: str, at: int, seed: int, low: float, height: float, fly: Any
) -> None:
    room = Arena(3, 6, DT, (low, -low, 0.0), (low + 30.0, 20.0 - low, height))
    plain = fly(MOTIONS[name], room, [seed], 100)
    moved = fly(Kidnapped(MOTIONS[name], at), room, [seed], 100)
    assert same(part(moved, slice(0, at)), part(plain, slice(0, at)))
    after, before = part(moved, slice(at, None)), part(plain, slice(at, None))
    turn = torch.tensor([-1.0, -1.0, 1.0])
    axis = torch.tensor([low + 15.0, 10.0 - low, 0.0], dtype=torch.float64)
    close: dict[str, float] = {"rtol": 0, "atol": 1e-9}
    torch.testing.assert_close(after.position - axis, turn * (before.position - axis), **close)
    torch.testing.assert_close(after.velocity, turn * before.velocity, **close)
    assert torch.equal(after.attitude, before.attitude)
    ends = torch.tensor((room.low, room.high), dtype=torch.float64)
    assert (moved.position >= ends[0] - 1e-9).all()
    assert (moved.position <= ends[1] + 1e-9).all()


@pytest.mark.parametrize("name", FLAT)
def test_they_are_across_the_plane_too(name: str, fly: Any, arena: Any) -> None:
    room = arena(30.0, 20.0, low=-4.0)
    plain = fly(MOTIONS[name], room, [1, 2], 60)
    moved = fly(Kidnapped(MOTIONS[name], 25), room, [1, 2], 60)
    assert same(part(moved, slice(0, 25)), part(plain, slice(0, 25)))
    centre = torch.tensor([11.0, 6.0]).double()
    torch.testing.assert_close(
        moved.position[:, 25:], 2 * centre - plain.position[:, 25:], rtol=0, atol=1e-12
    )
    assert torch.equal(moved.velocity[:, 25:], -plain.velocity[:, 25:])


@some
@given(chosen=st.sets(st.integers(0, 5), min_size=1), at=st.integers(1, 30))
def test_only_those_chosen_are_carried(chosen: set[int], at: int, fly: Any, arena: Any) -> None:
    room, motion = arena(*ROOM), MOTIONS["random"]
    uavs = tuple(sorted(chosen))
    left = [i for i in range(6) if i not in chosen]
    plain, everyone = fly(motion, room, [3], 31), fly(Kidnapped(motion, at), room, [3], 31)
    moved = fly(Kidnapped(motion, at, uavs), room, [3], 31)
    assert same(part(moved, slice(None), left), part(plain, slice(None), left))
    assert same(part(moved, slice(None), uavs), part(everyone, slice(None), uavs))
    away = (moved.position - plain.position)[:, at:, uavs].norm(dim=-1)
    assert away.min() > 0


@pytest.mark.parametrize("name", ["random", "random_velocity", "aggressive"])
def test_windows_and_batches_change_no_number(name: str, fly: Any, arena: Any) -> None:
    """Also where rows have been reset at different times, and are at different steps."""
    motion, room = Kidnapped(MOTIONS[name], 40, (0, 3)), arena(*ROOM)
    whole = fly(motion, room, [3, 4, 5], 90, first=[0, 31, 7])
    for window in (1, 7, 40):
        assert same(whole, fly(motion, room, [3, 4, 5], 90, window=window, first=[0, 31, 7]))
    alone = fly(motion, room, [4], 90, first=[31])
    assert torch.equal(alone.position, whole.position[1:2])


def test_it_happens_once_and_to_whom_it_says(arena: Any) -> None:
    """What tells sensors of it."""
    motion, room = Kidnapped(MOTIONS["random"], 4, (1,)), arena(*ROOM, n=3)
    carry = motion.start(noise.row_keys(torch.tensor([0, 1])), room)
    truth, _ = motion.advance(carry, torch.tensor([[2, 3, 4, 5, 6], [4, 5, 6, 7, 8]]), room)
    assert truth.carried is not None
    assert truth.carried.nonzero().tolist() == [[0, 2, 1], [1, 0, 1]]


# ---------------------------------------------------------------- what senses it


def scenario(motion: Motion, *sensors: Sensor) -> Scenario:
    """Three UAVs in the room, or in its plan where they roll on wheels."""
    dim = 2 if isinstance(sensors[0], Odometry) else 3
    return Scenario(
        name="kidnapping",
        arena=Arena(dim, 3, DT, (0.0,) * dim, ROOM[:dim]),
        horizon=100,
        motion=motion,
        sensors=sensors,
        network=Network(),
        prior=Prior(),
        process=Wheeled() if dim == 2 else Inertial(),
        believed_sensors=sensors,
    )


def watched(
    made: Scenario, leaf: str, steps: int, window: int | None = None
) -> tuple[Kinematics, Tensor]:
    """Truth and a leaf, [B, K, N, …]."""
    world = World(made, 2, window=window)
    seen, record = world.reset(0), []
    width = 3 * made.arena.dim
    for _ in range(steps):
        truth = world.truth
        record.append((truth.position, truth.velocity, truth.attitude, seen[leaf].double()))
        world.advance(torch.zeros(2, 3, width))
        seen = world.observation()
    position, velocity, attitude, measured = (torch.stack(x, 1) for x in zip(*record, strict=True))
    return Kinematics(position, velocity, attitude), measured


def strapdown(truth: Kinematics, imu: Tensor) -> Kinematics:
    """Dead reckoning of the leaf ``imu`` from the true start."""
    p, v, q = (x[:, 0] for x in (truth.position, truth.velocity, truth.attitude))
    path = [(p, v, q)]
    for u in imu.unbind(1)[1:]:
        a = rotate(q, u[..., :3]) - torch.tensor([0.0, 0.0, GRAVITY])
        p, v, q = p + (v + 0.5 * a * DT) * DT, v + a * DT, rotate_by(q, u[..., 3:] * DT)
        path.append((p, v, q))
    return Kinematics(*(torch.stack(x, 1) for x in zip(*path, strict=True)))


AT, STEPS = 30, 60
STRAPDOWN: list[Callable[[], Motion]] = [
    lambda: MOTIONS["random"],
    lambda: MOTIONS["aggressive"],
    lambda: RandomVelocity(),
]


@pytest.mark.parametrize("motion", STRAPDOWN, ids=["random", "aggressive", "random_velocity"])
def test_an_imu_does_not_notice(motion: Callable[[], Motion]) -> None:
    """Dead reckoning is not moved by the step at which a UAV is carried; from then on it follows
    the motion again, from where, and as fast as, it thought to be."""
    taken = (0, 2)
    made = scenario(Kidnapped(motion(), AT, taken), Imu(0.0, 0.0))
    truth, imu = watched(made, "imu", STEPS)
    plain, unmoved = watched(scenario(motion(), Imu(0.0, 0.0)), "imu", STEPS)
    assert torch.equal(imu[:, :AT], unmoved[:, :AT])
    assert torch.equal(imu[:, :, 1], unmoved[:, :, 1])
    assert torch.equal(imu[..., 3:], unmoved[..., 3:])  # gyroscopes measure all the time
    found = strapdown(truth, imu)
    # Carried: the velocity stays as it was, whichever way the UAV is put down.
    torch.testing.assert_close(
        found.velocity[:, AT, taken], found.velocity[:, AT - 1, taken], rtol=0, atol=1e-5
    )
    gained = truth.velocity[:, AT:] - truth.velocity[:, AT : AT + 1]
    torch.testing.assert_close(
        (found.velocity[:, AT:] - found.velocity[:, AT : AT + 1])[:, :, taken],
        gained[:, :, taken],
        rtol=0,
        atol=5e-5,
    )
    step = found.position.diff(dim=1)
    mean = 0.5 * (found.velocity[:, 1:] + found.velocity[:, :-1])
    torch.testing.assert_close(step, DT * mean, rtol=0, atol=1e-12)
    jump = (truth.position[:, AT] - truth.position[:, AT - 1]).norm(dim=-1)
    assert jump[:, taken].min() > 1
    assert (plain.position - truth.position)[:, :, 1].abs().max() == 0


def test_wheels_do_not_notice() -> None:
    """Dead reckoning stands still while a robot is carried, and then moves as the robot does."""
    motion, taken = MOTIONS["random"], (0, 2)
    exact = Odometry(0.0, 0.0, 0.0)
    truth, odometry = watched(scenario(Kidnapped(motion, AT, taken), exact), "odometry", STEPS)
    _, unmoved = watched(scenario(motion, exact), "odometry", STEPS)
    assert torch.equal(odometry[:, :AT], unmoved[:, :AT])
    assert torch.equal(odometry[..., 2], unmoved[..., 2])
    assert not odometry[:, AT, taken, :2].any()
    place, heading, path = truth.position[:, 0], truth.attitude[:, 0], []
    for u in odometry.unbind(1)[1:]:
        place = place + rotate(heading, u[..., :2]) * DT
        heading = rotate_by(heading, u[..., 2:] * DT)
        path.append(place)
    found = torch.stack(path, 1)
    before, after = slice(0, AT - 1), slice(AT, None)
    torch.testing.assert_close(found[:, before], truth.position[:, 1:AT], rtol=0, atol=1e-5)
    shift = truth.position[:, AT] - truth.position[:, AT - 1]
    shift[:, 1] = 0.0
    expected = truth.position[:, AT + 1 :] - shift.unsqueeze(1)
    torch.testing.assert_close(found[:, after], expected, rtol=0, atol=1e-5)
    assert shift[:, taken].norm(dim=-1).min() > 1


def test_distances_are_those_to_where_they_are() -> None:
    anchors = ((0.0, 0.0, 0.0), (30.0, 20.0, 5.0))
    exact = AnchorRanging(anchors, RangeNoise(std=0.0))
    made = scenario(Kidnapped(MOTIONS["random"], AT), Imu(), exact)
    truth, ranges = watched(made, "anchor_ranges", STEPS)
    distance = (truth.position.unsqueeze(-2) - torch.tensor(anchors)).norm(dim=-1)
    torch.testing.assert_close(ranges, distance, rtol=0, atol=1e-5)


@pytest.mark.parametrize("window", [1, 7, AT, AT + 1])
def test_however_many_steps_are_sensed_at_once(window: int) -> None:
    motion = Kidnapped(MOTIONS["aggressive"], AT, (1,))
    for leaf, sensor in (("imu", Imu()), ("odometry", Odometry())):
        made = scenario(motion if leaf == "imu" else Kidnapped(MOTIONS["random"], AT), sensor)
        (whole, expected), (cut, found) = (watched(made, leaf, STEPS, w) for w in (None, window))
        assert torch.equal(found, expected)
        assert same(whole, cut)


# ---------------------------------------------------------------- what is refused


def test_no_bound_is_known() -> None:
    made = make_scenario("wsn-v0", kidnap_at=1.0, horizon=20)
    with pytest.raises(ValueError, match="no bound is known for a team that is kidnapped"):
        posterior_bound(made, 1)
    assert evaluate(made, ["emvf"], runs=1).bound is None
    assert evaluate(make_scenario("wsn-v0", horizon=20), ["emvf"], runs=1).bound is not None


@pytest.mark.parametrize(
    ("at", "uavs", "words"),
    [
        (0, None, "Kidnapped: at=0 is not allowed: a step ≥ 1"),
        (-3, (0,), "Kidnapped: at=-3 is not allowed"),
        (5, (), r"Kidnapped: uavs=\(\) is not allowed: indices of UAVs"),
        (5, (0, 6), r"Kidnapped: uavs=\(0, 6\) is not allowed"),
        (5, (-1,), r"Kidnapped: uavs=\(-1,\) is not allowed"),
    ],
)
def test_refusals(at: int, uavs: Any, words: str, fly: Any, arena: Any) -> None:
    with pytest.raises(ValueError, match=words):
        fly(Kidnapped(MOTIONS["circle"], at, uavs), arena(*ROOM), [0], 1)


def test_indoors_some_may_be_taken() -> None:
    made = make_scenario("indoor-v0", kidnap_at=2.5, kidnapped=(1, 4))
    assert made.motion == Kidnapped(MOTIONS["circle"], 25, (1, 4))
    with pytest.raises(ValueError, match=r"kidnapped=\(1,\) is not allowed: only with kidnap_at"):
        make_scenario("indoor-v0", kidnapped=(1,))
