"""``campus-v0``: the building between UAVs, clocks, the three flights, and who is cut off when."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from pettingzoo.test import parallel_api_test, parallel_seed_test
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torchrl.envs import check_env_specs

from coloc_env import noise
from coloc_env.bounds import posterior_bound
from coloc_env.envs.pettingzoo import parallel_env
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.geometry.walls import depth
from coloc_env.motion import Arena, Kinematics, Motion, Patrol, Split
from coloc_env.network import Network
from coloc_env.reference import SatelliteReference
from coloc_env.render import Renderer
from coloc_env.scenario import InsDriven, Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.scenarios.campus import BUILDING, COURT, SIZE
from coloc_env.sensors import Clock, Ins, PositionFix, RangeNoise, Ranging
from coloc_env.world import World

FLIGHTS = ("s1", "s2", "s3")
LOW, HIGH = (torch.tensor(corner, dtype=torch.float64) for corner in BUILDING)
EXACT: dict[str, Any] = {
    "uwb_std": 0.0,
    "believed_uwb_std": 0.2,
    "clock_offset": 0.0,
    "clock_skew": 0.0,
    "nlos_bias": 0.0,
}
TROUBLE: dict[str, Any] = {
    "nlos": 0.2,
    "uwb_dropout": 0.1,
    "link_failure": 0.2,
    "message_loss": 0.1,
    "failure_rate": 0.3,
    "wall_loss": 0.5,
}


def path(flight: str, worlds: int, dt: float = 0.1, seconds: float | None = None) -> Kinematics:
    """The truth of a whole flight."""
    scenario = make_scenario("campus-v0", flight=flight, dt=dt)
    steps = scenario.horizon if seconds is None else round(seconds / dt)
    carry = scenario.motion.start(noise.row_keys(torch.arange(worlds)), scenario.arena)
    index = torch.arange(steps).expand(worlds, steps)
    return scenario.motion.advance(carry, index, scenario.arena)[0]


def jumped(world: World, seconds: float) -> Tensor:
    """Observed range mask, ranges, links and positions ``seconds`` on, in a fresh window."""
    for _ in range(round(seconds / world.scenario.arena.dt)):
        world.advance(torch.zeros(world.batch_size, world.scenario.arena.n_uavs, 9))
    return world.truth.position


def parts(links: Tensor) -> list[int]:
    """Number of connected parts of each world's network [B, N, N]."""
    return [connected_components(one.numpy() > 0, directed=False)[0] for one in links]


# ---------------------------------------------------------------- through walls


def test_depth_is_what_sampling_finds() -> None:
    """Random segments in and about two boxes, and their exact lengths inside."""
    generator = torch.Generator().manual_seed(0)
    walls = (((2.0, 3.0, 0.0), (5.0, 4.0, 6.0)), ((6.0, 0.0, 1.0), (8.0, 9.0, 2.0)))
    start, end = 10 * torch.rand(2, 100, 3, generator=generator, dtype=torch.float64)
    share = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000
    points = start.unsqueeze(1) + share[:, None] * (end - start).unsqueeze(1)
    inside = sum(
        ((points > torch.tensor(low)) & (points < torch.tensor(high))).all(-1).double()
        for low, high in walls
    )
    sampled = inside.mean(1) * (end - start).norm(dim=-1)
    found = depth(start, end, walls)
    assert (found > 0).double().mean() > 0.1
    torch.testing.assert_close(found, sampled, rtol=0, atol=3e-3)  # two or four ends, 15 m / 20 000
    assert torch.equal(depth(end, start, walls), found)


def test_depth_by_hand() -> None:
    box = (((0.0, 0.0, 0.0), (4.0, 2.0, 3.0)),)
    cases = [
        ((-1, 1, 1), (5, 1, 1), 4.0),  # along x, parallel to two pairs of faces
        ((2, 1, 1), (2, 1, 9), 2.0),  # from inside, upwards
        ((1, 1, 1), (3, 1, 1), 2.0),  # wholly inside
        ((-1, -1, 1), (3, 3, 1), 2 * math.sqrt(2)),
        ((-1, 1, 1), (-0.5, 1, 1), 0.0),  # ends before it
        ((-1, 2, 1), (5, 2, 1), 0.0),  # along a face
        ((0, 0, -1), (0, 0, 9), 0.0),  # along an edge
        ((1, 1, 1), (1, 1, 1), 0.0),  # nowhere
    ]
    for start, end, expected in cases:
        a, b = (torch.tensor(point, dtype=torch.float64) for point in (start, end))
        assert float(depth(a, b, box)) == pytest.approx(expected, abs=1e-12), (start, end)
        assert float(depth(b, a, box)) == pytest.approx(expected, abs=1e-12), (end, start)
    plane = depth(torch.tensor([-1.0, 1.0]), torch.tensor([5.0, 1.0]), (((0, 0), (4, 2)),))
    assert float(plane) == 4.0


def test_a_signal_gets_through_as_its_power_allows() -> None:
    """As often as 20 log₁₀(R/d) − loss · depth exceeds the shadowing of 4 dB."""
    network = Network(radius=100.0, walls=(((4.0, -5.0), (6.0, 5.0)),), wall_loss=8.0)
    place = torch.tensor([[0.0, 0.0], [10.0, 0.0], [0.0, 40.0]], dtype=torch.float64)
    keys = noise.fold(torch.zeros(20_000, 1, dtype=torch.int64), torch.arange(20_000)[:, None])
    position = place.expand(20_000, 1, 3, 2)
    alive = torch.ones(20_000, 1, 3, dtype=torch.bool)
    through = network.unbroken(keys, *network.neighbours(position, alive), position)[:, 0]
    assert torch.equal(through, through.mT)
    assert not through.diagonal(dim1=1, dim2=2).any()
    assert through[:, 0, 2].all()  # in sight
    margin = 20 * math.log10(100 / 10) - 8.0 * 2.0
    expected = 0.5 * math.erfc(-margin / (4 * math.sqrt(2)))
    got = float(through[:, 0, 1].double().mean())
    assert got == pytest.approx(expected, abs=5 * math.sqrt(expected * (1 - expected) / 20_000))


@pytest.mark.parametrize("loss", [0.0, 4.3, math.inf])
def test_blocked_ranges_are_too_long_or_lost(loss: float) -> None:
    exact = EXACT | {"nlos_bias": 3.0, "nlos_kind": "constant", "wall_excess": 0.5}
    world = World(make_scenario("campus-v0", flight="s3", wall_loss=loss, **exact), 6)
    world.reset(0)
    biased = lost = 0
    for _ in range(8):
        position = jumped(world, 5.0)
        seen = world.observation()
        inside = depth(position.unsqueeze(2), position.unsqueeze(1), (BUILDING,))
        apart = (position.unsqueeze(2) - position.unsqueeze(1)).norm(dim=-1)
        measured, sight = seen["range_mask"] > 0, inside == 0
        sight = sight & ~torch.eye(10, dtype=torch.bool)
        assert measured[sight].all()
        assert torch.equal(measured, seen["links"] > 0)
        expected = apart + torch.where(inside > 0, 3.0 + 0.5 * inside, 0.0)
        torch.testing.assert_close(
            seen["ranges"][measured].double(), expected[measured], rtol=0, atol=1e-4
        )
        assert torch.equal(seen["ranges"], seen["ranges"].mT)
        biased += int((measured & (inside > 0)).sum())
        lost += int((~measured & (inside > 0)).sum())
    assert (biased > 0) == (loss < math.inf)
    share = lost / (lost + biased)
    assert {0.0: share < 0.2, 4.3: 0.8 < share < 1, math.inf: share == 1}[loss], share


def test_large_teams_with_few_slots_see_the_same_building() -> None:
    """Neighbour slots by index or by distance: the same ranges, where both have them."""
    scenario = make_scenario("campus-v0", flight="s3", n_uavs=20, **EXACT)
    few = replace(scenario, network=replace(scenario.network, max_neighbours=12))
    all_seen, some = World(scenario, 2), World(few, 2)
    wide, seen = all_seen.reset(0), some.reset(0)
    index = seen["neighbours"].long()
    assert 0 < float(seen["range_mask"].mean()) < 1
    assert torch.equal(seen["range_mask"], seen["links"])
    there = wide["range_mask"].gather(-1, index) * (seen["range_mask"] > 0)
    assert torch.equal(there, seen["range_mask"])
    assert torch.equal(wide["ranges"].gather(-1, index) * there, seen["ranges"])


# ---------------------------------------------------------------- clocks


def test_clocks_make_a_systematic_bounded_error_of_each_pair() -> None:
    exact = EXACT | {"clock_offset": 0.3, "clock_skew": 0.2}
    world = World(make_scenario("campus-v0", flight="s1", **exact), 40)
    world.reset(0)
    upper, errors = torch.ones(10, 10).triu(1) > 0, []
    for _ in range(12):
        position, seen = jumped(world, 8.0), world.observation()
        apart = (position.unsqueeze(2) - position.unsqueeze(1)).norm(dim=-1)
        errors.append((seen["ranges"] - apart)[:, upper])
        assert torch.equal(seen["ranges"], seen["ranges"].mT)
    error = torch.stack(errors)  # [K, B, 45]
    assert (error - error.mean(0)).abs().max() < 2 * 2 * 0.2
    assert (error.amax(0) - error.amin(0)).max() > 0.2  # it does drift
    # It is a_i + a_j plus what changes: a least squares fit of a leaves no more than the skews.
    pairs = upper.nonzero()
    design = torch.zeros(45, 10, dtype=torch.float64)
    design.scatter_(1, pairs, 1.0)
    every = error.flatten(0, 1).mT.double()
    a = torch.linalg.lstsq(design, every).solution
    assert (design @ a - every).abs().max() < 2 * 2 * 0.2
    offsets = world._placed[-1]["offset"]
    assert float(offsets.std()) == pytest.approx(0.3, rel=5 / math.sqrt(800))


def test_clocks_by_hand() -> None:
    clock = Clock(offset=0.5, skew=0.2, period=100.0)
    placed = clock.place(noise.row_keys(torch.arange(3)), 4)
    world = World(make_scenario("campus-v0", n_uavs=4, clock_offset=0.5, clock_skew=0.2), 3)
    world.reset(0)
    again = world._placed[-1]
    assert torch.equal(again["offset"], placed["offset"])
    period = 2 * math.pi / placed["rate"]
    assert (period > 50).all()
    assert (period < 200).all()
    for name, value in (("offset", -0.1), ("skew", math.inf), ("period", 0.0)):
        with pytest.raises(ValueError, match=f"Clock: {name}="):
            replace(clock, **{name: value})


# ---------------------------------------------------------------- flights


@pytest.mark.parametrize("flight", FLIGHTS)
def test_flights_are_smooth_and_never_pass_through_the_building(flight: str) -> None:
    truth = path(flight, 4)
    p, v = truth.position, truth.velocity
    assert (p >= 0).all()
    assert (p <= torch.tensor(SIZE)).all()
    outside = torch.maximum(LOW - p, p - HIGH).amax(-1)
    assert outside.min() > 5
    assert not depth(p[:, 1:], p[:, :-1], (BUILDING,)).any()
    assert v.norm(dim=-1).max() < {"s1": 8.5, "s2": 5.0, "s3": 8.0 + 1e-9}[flight]
    assert (v.diff(dim=1).norm(dim=-1) / 0.1).max() < {"s1": 2.5, "s2": 1.5, "s3": 1.0}[flight]
    fine = path(flight, 3, dt=1e-3, seconds=8.0)
    slope = (fine.position[:, 2:] - fine.position[:, :-2]) / 2e-3
    torch.testing.assert_close(slope, fine.velocity[:, 1:-1], rtol=0, atol=1e-5)
    assert (fine.attitude.norm(dim=-1) - 1).abs().max() < 1e-12
    assert (p[0] - p[1]).norm(dim=-1).max() > 1  # seeds differ


def test_the_court_is_flown_in_an_eight_and_in_circles() -> None:
    truth = path("s1", 2).position
    middle, ring = truth.mean(2), truth - truth.mean(2, keepdim=True)
    radius = ring[..., :2].norm(dim=-1)
    court = torch.tensor(COURT)
    away = (middle[..., :2] - court).norm(dim=-1)
    assert away[:, :600].max() == pytest.approx(25.0, abs=0.1)  # the eight's ends
    assert away[:, 300].max() < 0.1  # its crossing
    assert away[:, 600:].max() < 1e-9
    torch.testing.assert_close(radius[:, :600], torch.full_like(radius[:, :600], 8.0))
    assert radius[:, 600:].max() == pytest.approx(24.0, abs=0.01)
    wide = (radius[0, 600:, 0] > 16).int().diff().abs().sum()
    assert wide == 4  # out and in, twice


def test_the_team_splits_about_the_building_and_meets_again() -> None:
    truth = path("s2", 8).position
    beside = (truth[..., 0] > LOW[0]) & (truth[..., 0] < HIGH[0])
    side = (truth[..., 1] - 60.0).sign()
    first, second = side[:, :, :5], side[:, :, 5:]
    assert (first == first[:, :1, :1]).all()
    assert (second == -first[:, :1, :1]).all()
    assert len(side[:, 0, 0].unique()) == 2  # which goes where is drawn
    assert beside.all(-1).any(1).all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_network_breaks_in_two_and_is_whole_again(seed: int) -> None:
    world = World(make_scenario("campus-v0"), 1)
    seen, whole = world.reset(seed), []
    for _ in range(world.scenario.horizon):
        links = torch.maximum(seen["links"], seen["range_mask"])
        whole.append(parts(links)[0])
        if whole[-1] == 2:
            label = connected_components(links[0].numpy() > 0, directed=False)[1]
            assert len(set(label[:5])) == len(set(label[5:])) == 1
        world.advance(torch.zeros(1, 10, 9))
        seen = world.observation()
    assert whole[0] == whole[-1] == 1
    assert set(whole) == {1, 2}
    broken = np.flatnonzero(np.array(whole) == 2)
    assert len(broken) > 200  # steps, 20 s
    assert np.mean(np.array(whole)[broken[0] : broken[-1]] == 2) > 0.98


def test_the_court_is_open() -> None:
    world = World(make_scenario("campus-v0", flight="s1"), 3)
    world.reset(0)
    for _ in range(6):
        jumped(world, 19.0)
        assert float(world.observation()["range_mask"].sum()) == 3 * 90


def test_patrols_go_everywhere_each_in_its_own_way() -> None:
    truth = path("s3", 4, dt=1.0).position
    court = truth[..., 0] < 100
    behind = truth[..., 0] > HIGH[0]
    assert court.any(1).all()  # every UAV is in zone A at some time
    assert behind.any(1).double().mean() > 0.6  # most see the building's far side
    assert 0.1 < float(court.double().mean()) < 0.9
    start = truth[:, 0].flatten(0, 1)
    assert len(start.unique(dim=0)) == 40


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        (Patrol((BUILDING,), ((0, 1),)), "routes .* must be equally long lists"),
        (Patrol((BUILDING,), ((0, 0), (0,))), "routes .* must be equally long lists"),
        (Patrol((BUILDING,), ((0,),), max_speed=0.0), "max_speed must be positive"),
        (Split(((0.0, 48.0, 0.0), (99.0, 72.0, 20.0))), r"approach: .* is no box .* in the arena"),
        (Split(BUILDING, height=(6.0, 99.0)), r"approach: .* is no box"),
    ],
)
def test_flights_that_do_not_fit_are_refused(motion: Motion, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        motion.start(noise.row_keys(torch.arange(1)), Arena(3, 4, 0.1, (0.0,) * 3, SIZE))


# ---------------------------------------------------------------- what is measured and believed


def test_the_campus_is_as_documented() -> None:
    scenario = make_scenario("campus-v0")
    arena = scenario.arena
    assert (arena.n_uavs, arena.dt, scenario.horizon, scenario.anchor_uavs) == (10, 0.1, 1000, 3)
    assert [make_scenario("campus-v0", flight=f).horizon for f in FLIGHTS] == [1200, 1000, 9000]
    assert scenario.network.radius == 400.0
    assert scenario.network.walls == (BUILDING,)
    own = (Ins(0.3, 0.2, 60.0), PositionFix(0.1, 3))
    ranging = Ranging(RangeNoise(0.2), walls=(BUILDING,), excess=0.08, clock=Clock(0.2, 0.1))
    assert scenario.sensors == (*own, ranging)
    assert scenario.believed.sensors == (*own, Ranging(RangeNoise(std=0.2), clock=Clock(0.2, 0.1)))
    assert scenario.believed.process == InsDriven(20.0)
    # Concrete by ITU-R P.2040-1, eq. 31: 1636 σ / √ε dB/m, σ = 0.0326 f^0.8095 S/m at f GHz.
    attenuation = 1636 * 0.0326 * 4**0.8095 / math.sqrt(5.31)
    assert scenario.network.wall_loss == pytest.approx(0.06 * attenuation, rel=0.02)
    assert ranging.excess == pytest.approx(0.06 * (math.sqrt(5.31) - 1), rel=0.03)


def test_the_bound_knows_of_the_building() -> None:
    """What comes through it tells less, and a range that is lost tells nothing."""
    steps = 30
    bounds = {}
    for name, overrides in {
        "none": {"wall_loss": math.inf},
        "some": {"wall_loss": 0.0, "nlos_bias": 3.0},
        "all": {"wall_loss": 0.0, "nlos_bias": 0.0},
    }.items():
        motion = Split(BUILDING, period=4.0, approach=45.0)
        scenario = replace(make_scenario("campus-v0", **overrides), motion=motion)
        bounds[name] = posterior_bound(scenario, 2, steps=steps)
    assert bounds["all"].rmse < bounds["some"].rmse < bounds["none"].rmse
    assert torch.equal(bounds["all"].scored[0, 0], torch.arange(10) >= 3)


def test_the_reference_is_as_far_off_as_satellites_are() -> None:
    reference = SatelliteReference(cep=2.0, vertical=1.5, shared=0.5, time=20.0)
    seeds = torch.arange(300)
    error = reference.errors(seeds, 400, 4, 3, 0.1)
    assert error.shape == (300, 400, 4, 3)
    horizontal = np.linalg.norm(error[..., :2], axis=-1)
    assert np.mean(horizontal < 2.0) == pytest.approx(0.5, abs=0.03)
    std = error.std((0, 1, 2))
    np.testing.assert_allclose(std / std[0], [1, 1, 1.5], rtol=0.06)
    assert np.mean(error[:, 0, 0, 0] * error[:, 200, 0, 0]) / std[0] ** 2 == pytest.approx(
        math.exp(-1), abs=0.2
    )
    assert np.mean(error[..., 0, :] * error[..., 1, :]) / np.mean(error**2) == pytest.approx(
        0.5, abs=0.06
    )
    np.testing.assert_array_equal(reference.errors(seeds[7:8], 50, 4, 3, 0.1)[0], error[7, :50])
    with pytest.raises(ValueError, match="shared=2 is not allowed"):
        SatelliteReference(shared=2)


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"flight": "s4"}, "flight='s4' is not allowed: one of s1, s2, s3"),
        ({"n_uavs": 1}, "n_uavs=1 is not allowed: at least two UAVs"),
        ({"dt": 0.0}, "dt=0.0 is not allowed: a number > 0 in s"),
        ({"anchor_share": 1.0}, "anchor_uavs=10 is not allowed: from 0 to fewer than the 10 UAVs"),
        ({"wall_loss": -1.0}, "wall_loss=-1.0 is not allowed: a number ≥ 0 in dB/m"),
        ({"wall_excess": -1.0}, "wall_excess=-1.0 is not allowed: a number ≥ 0 in m/m"),
        ({"clock_offset": -1.0}, "clock_offset=-1.0 is not allowed: a number ≥ 0 in m"),
        ({"clock_skew": -1.0}, "clock_skew=-1.0 is not allowed: a number ≥ 0 in m"),
        ({"gps_cep": -1.0}, "gps_cep=-1.0 is not allowed: a number ≥ 0 in m"),
        ({"horizon": 0}, "horizon=0 is not allowed: a whole number ≥ 1"),
    ],
)
def test_wrong_overrides_are_named(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        make_scenario("campus-v0", **overrides)
    assert str(caught.value).startswith("campus-v0: ")
    assert "\n" not in str(caught.value)


def test_walls_that_let_signals_through_need_a_radius() -> None:
    with pytest.raises(ValueError, match=r"wall_loss=3\.0 is not allowed: 0 or infinite, unless"):
        Network(wall_loss=3.0)


# ---------------------------------------------------------------- faces, seeds, pictures


@pytest.mark.parametrize("overrides", [{}, {"flight": "s3"} | TROUBLE], ids=["plain", "trouble"])
def test_both_faces_work(overrides: dict[str, Any]) -> None:
    parallel_api_test(parallel_env("campus-v0", horizon=12, **overrides), num_cycles=30)
    parallel_seed_test(lambda: parallel_env("campus-v0", horizon=12, **overrides))
    check_env_specs(CoLocEnv("campus-v0", num_envs=2, horizon=6, **overrides), seed=3)


@pytest.mark.parametrize("flight", FLIGHTS)
def test_a_row_of_a_batch_is_its_own_world_whatever_the_window(
    flight: str, rows_are_their_own_worlds: Callable[[Scenario, int], None]
) -> None:
    rows_are_their_own_worlds(make_scenario("campus-v0", flight=flight, dt=0.5, **TROUBLE), 90)


def test_rows_that_are_reset_alone_are_worlds_of_their_seeds() -> None:
    scenario = make_scenario("campus-v0", flight="s3", **TROUBLE)
    fresh, world = World(scenario), World(scenario, 3, window=20)
    world.reset(0)
    idle = torch.zeros(3, 10, 9)
    for _ in range(33):
        world.advance(idle)
    seen = world.reset(torch.tensor([0, 8, 0]), torch.tensor([False, True, False]))
    alone = fresh.reset(8)
    for _ in range(50):
        for name, leaf in alone.leaves.items():
            assert torch.equal(seen[name][1:2], leaf), name
        world.advance(idle)
        fresh.advance(idle[:1])
        seen, alone = world.observation(), fresh.observation()


@pytest.mark.parametrize("flight", FLIGHTS)
def test_flights_are_drawn_with_their_building(flight: str) -> None:
    scenario = make_scenario("campus-v0", flight=flight)
    world, renderer = World(scenario), Renderer(scenario)
    world.reset(0)
    renderer.record(world, torch.zeros(1, 10, 9))
    world.step(torch.zeros(1, 10, 9))
    frame = renderer.render(world, "rgb_array")
    open_field = replace(scenario, network=replace(scenario.network, walls=()))
    empty = Renderer(open_field)
    empty.record(world, torch.zeros(1, 10, 9))
    assert not np.array_equal(frame, empty.render(world, "rgb_array"))
