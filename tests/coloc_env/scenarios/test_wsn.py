"""``wsn-v0``: the room, the path, the noise and the three cases of the NN-HPFF paper."""

from typing import Any

import numpy as np
import pytest
import torch
from pettingzoo.test import parallel_api_test, parallel_seed_test
from torch import Tensor
from torchrl.envs import check_env_specs

from coloc_env.envs.pettingzoo import CoLocParallelEnv, parallel_env
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.motion import Kidnapped, Square
from coloc_env.observation import all_leaves
from coloc_env.scenario import ConstantVelocity, Prior, Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import AnchorRanging, RangeNoise
from coloc_env.world import World

CORNERS = ((0.0, 0.0), (10.0, 10.0), (10.0, 0.0), (0.0, 10.0))
BELIEVED = {1: (0.04, 1.0), 2: (0.04 / 25, 1.0), 3: (9 * 0.04, 0.0036)}  # r in m², q in m²/s⁴


def ranging(scenario: Scenario) -> tuple[AnchorRanging, AnchorRanging]:
    """The scenario's one sensor: as it is, and as the team believes."""
    (true,), (believed,) = scenario.sensors, scenario.believed_sensors
    assert isinstance(true, AnchorRanging)
    assert isinstance(believed, AnchorRanging)
    return true, believed


def ranged(scenario: Scenario, seeds: list[int], steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """True positions [K, B, N, 2], and ranges and their masks [K, B, N, A]."""
    world, found = World(scenario, len(seeds)), []
    seen = world.reset(seeds)
    for _ in range(steps):
        found.append((world.truth.position, seen["anchor_ranges"], seen["anchor_range_mask"]))
        world.advance(torch.zeros(len(seeds), scenario.arena.n_uavs, 6))
        seen = world.observation()
    position, ranges, mask = (torch.stack(part) for part in zip(*found, strict=True))
    return position, ranges, mask


def errors(worlds: int = 40, steps: int = 60, **overrides: Any) -> tuple[Tensor, Tensor]:
    """Errors in m of the ranges [K, B, N, A], and which of these arrived."""
    scenario = make_scenario("wsn-v0", **overrides)
    position, ranges, mask = ranged(scenario, list(range(worlds)), steps)
    anchors = torch.tensor(ranging(scenario)[0].anchors, dtype=torch.float64)
    distance = (position.unsqueeze(-2) - anchors).norm(dim=-1)
    return ranges - distance, mask > 0


# ---------------------------------------------------------------- the room and the path


def test_the_room_is_the_papers() -> None:
    scenario = make_scenario("wsn-v0")
    arena = scenario.arena
    assert (arena.dim, arena.n_uavs, arena.dt, scenario.horizon) == (2, 1, 0.1, 360)
    assert (arena.low, arena.high) == ((0.0, 0.0), (10.0, 10.0))
    true, believed = ranging(scenario)
    assert true == AnchorRanging(CORNERS, RangeNoise(std=0.2))
    assert believed == true
    assert scenario.prior == Prior(kind="uniform", max_speed=1.0, attitude_std=3.0)
    assert scenario.believed.process == ConstantVelocity(1.0, held=True)
    leaves = {"anchor_ranges", "anchor_range_mask", "anchor_map", "prior"}
    assert set(all_leaves(scenario)) == leaves | {"links", "messages", "message_mask"}


def test_the_path_is_a_square_with_a_side_in_a_hundred_steps() -> None:
    """The horizon ends it 60 steps after the third corner."""
    scenario = make_scenario("wsn-v0")
    world = World(scenario)
    world.reset(7)
    corners = {0: (2.0, 2.0), 100: (8.0, 2.0), 200: (8.0, 8.0), 300: (2.0, 8.0), 359: (2.0, 4.46)}
    sides = ((0.6, 0.0), (0.0, 0.6), (-0.6, 0.0), (0.0, -0.6))
    over = False
    for k in range(scenario.horizon):
        assert not over
        truth = world.truth
        if k in corners:
            assert truth.position[0, 0].tolist() == pytest.approx(corners[k], abs=1e-12)
        assert truth.velocity[0, 0].tolist() == pytest.approx(sides[k // 100], abs=1e-12)
        over = bool(world.step(torch.zeros(1, 1, 6)).truncated)
    assert over


@pytest.mark.parametrize("count", range(1, 9))
def test_anchors_stand_in_corners_then_along_walls(count: int) -> None:
    scenario = make_scenario("wsn-v0", anchors=count)
    places = World(scenario).reset(0)["anchor_map"][0, 0].unflatten(-1, (-1, 2)).tolist()
    middles = [[5.0, 0.0], [5.0, 10.0], [0.0, 5.0], [10.0, 5.0]]
    assert places == [*map(list, CORNERS), *middles][:count]


def test_several_robots_share_the_square_and_nothing_else() -> None:
    """Evenly spread along it, each with ranges of its own."""
    scenario = make_scenario("wsn-v0", n_uavs=4)
    position, ranges, _ = ranged(scenario, [3], 5)
    alone, _, _ = ranged(make_scenario("wsn-v0"), [3], 305)
    for uav in range(4):
        torch.testing.assert_close(position[:, 0, uav], alone[100 * uav : 100 * uav + 5, 0, 0])
    noise = ranges[:, 0] - (position[:, 0].unsqueeze(-2) - torch.tensor(CORNERS)).norm(dim=-1)
    assert len(noise.flatten().unique()) == noise.numel()
    assert {type(sensor) for sensor in scenario.sensors} == {AnchorRanging}


# ---------------------------------------------------------------- what is measured


@pytest.mark.parametrize("r", [1e-4, 0.04, 0.5])
def test_ranges_have_the_true_variance_and_no_bias(r: float) -> None:
    error, there = errors(uwb_std=r**0.5)
    count = error.numel()
    assert there.all()
    assert abs(float(error.mean())) < 4 * (r / count) ** 0.5
    assert float(error.var()) == pytest.approx(r, rel=4 * (2 / count) ** 0.5)
    kurtosis = float((error**4).mean() / error.var() ** 2)
    assert kurtosis == pytest.approx(3, abs=4 * (24 / count) ** 0.5)
    each = error.flatten(0, 2)
    correlation = torch.corrcoef(each.T) - torch.eye(4)
    assert correlation.abs().max() < 4.5 / len(each) ** 0.5
    following = (error[1:] * error[:-1]).mean() / error.var()
    assert abs(float(following)) < 4.5 / count**0.5


@pytest.mark.parametrize("kind", ["constant", "exponential"])
def test_every_range_to_the_nlos_anchor_is_long_and_no_other(kind: str) -> None:
    clean, _ = errors()
    error, _ = errors(nlos_anchor=2, nlos_bias=0.8, nlos_kind=kind)
    late = error - clean  # the noise is the same numbers
    assert not late[..., [0, 1, 3]].any()
    if kind == "constant":
        torch.testing.assert_close(
            late[..., 2], torch.full_like(late[..., 2], 0.8), atol=1e-5, rtol=0
        )
    else:
        own = late[..., 2].flatten()
        assert (own > -1e-5).all()
        assert float(own.mean()) == pytest.approx(0.8, rel=5 / len(own) ** 0.5)
        assert float(own.std()) == pytest.approx(0.8, rel=8 / len(own) ** 0.5)


@pytest.mark.parametrize("rise", [0.0, 20.0])
def test_ranges_to_the_biased_anchors_grow_too_long_and_no_others(rise: float) -> None:
    error, _ = errors(biased_anchors=2, anchor_bias=0.8, anchor_bias_rise=rise)
    late = error - errors()[0]
    assert not late[..., 2:].any()
    steps = torch.arange(len(late)) * 0.1
    share = (steps / rise).clamp_max(1.0) if rise else torch.ones_like(steps)
    expected = (0.8 * share).double().view(-1, 1, 1, 1).expand_as(late[..., :2])
    torch.testing.assert_close(late[..., :2], expected, atol=1e-5, rtol=0)


def test_some_ranges_to_all_anchors_are_long() -> None:
    late = errors(nlos=0.3, nlos_kind="constant")[0] - errors()[0]
    share = (late > 0.5).double().flatten(0, 2).mean(0)
    assert ((share - 0.3).abs() < 5 * (0.21 / 2400) ** 0.5).all()
    hit = late > 0.5
    torch.testing.assert_close(late[hit], torch.ones_like(late[hit]), atol=1e-5, rtol=0)


def test_ranges_are_lost_one_by_one() -> None:
    _, there = errors(uwb_dropout=0.2)
    count = there.numel()
    assert float(there.double().mean()) == pytest.approx(0.8, abs=4 * (0.16 / count) ** 0.5)
    assert len(there.flatten(0, 2).unique(dim=0)) == 16
    scenario = make_scenario("wsn-v0", uwb_dropout=0.2)
    _, ranges, mask = ranged(scenario, [0], 60)
    assert not ranges[mask == 0].any()


# ---------------------------------------------------------------- what is believed


@pytest.mark.parametrize("case", BELIEVED)
def test_cases_differ_in_belief_alone(case: int) -> None:
    scenario, ideal = make_scenario("wsn-v0", case=case), make_scenario("wsn-v0")
    (r, q), (true, believed) = BELIEVED[case], ranging(scenario)
    assert true == ranging(ideal)[0]
    assert believed.noise.std**2 == pytest.approx(r)
    assert believed.anchors == true.anchors
    process = scenario.believed.process
    assert isinstance(process, ConstantVelocity)
    assert process.held
    assert process.accel_std**2 == pytest.approx(q)
    assert torch.equal(ranged(scenario, [0], 20)[1], ranged(ideal, [0], 20)[1])


def test_beliefs_and_truth_are_set_apart() -> None:
    for case in BELIEVED:
        scenario = make_scenario(
            "wsn-v0", case=case, uwb_std=0.3**0.5, believed_uwb_std=0.5**0.5, q=0.7
        )
        true, believed = ranging(scenario)
        assert (true.noise.std**2, believed.noise.std**2) == pytest.approx((0.3, 0.5))
        process = scenario.believed.process
        assert isinstance(process, ConstantVelocity)
        assert process.accel_std**2 == pytest.approx(0.7)
    troubled = make_scenario("wsn-v0", nlos_anchor=1, nlos=0.2, uwb_dropout=0.1)
    assert troubled.believed == make_scenario("wsn-v0").believed


@pytest.mark.parametrize("speed", [0.25, 1.0, 3.0])
def test_the_prior_tells_the_room_and_a_top_speed(speed: float) -> None:
    world = World(make_scenario("wsn-v0", n_uavs=3, max_speed=speed), 50)
    prior = world.reset(0)["prior"]
    place, velocity, attitude, place_std, rest = prior.split((2, 2, 1, 2, 2), -1)
    assert (place == 5.0).all()
    assert not velocity.any()
    torch.testing.assert_close(place_std, torch.full_like(place_std, 10 / 12**0.5))
    torch.testing.assert_close(rest[..., 0], torch.full_like(rest[..., 0], speed / 3**0.5))
    assert (rest[..., 1] == 3.0).all()
    assert float(attitude.std()) > 1  # anywhere


def test_top_speeds_go_with_uniform_priors() -> None:
    assert Prior(velocity_std=0.3).velocity_spread == 0.3
    assert Prior(kind="uniform", velocity_std=0.3).velocity_spread == 0.3
    words = r"max_speed=.* is not allowed: a speed > 0, with kind="
    for wrong in ({"max_speed": 1.0}, {"kind": "uniform", "max_speed": 0.0}):
        with pytest.raises(ValueError, match=words):
            Prior(**wrong)  # type: ignore[arg-type]


# ---------------------------------------------------------------- kidnapping


def test_everyone_is_carried_across_the_room() -> None:
    plain, _, _ = ranged(make_scenario("wsn-v0", n_uavs=2), [0], 360)
    moved, ranges, _ = ranged(make_scenario("wsn-v0", n_uavs=2, kidnap_at=15.0), [0], 360)
    assert torch.equal(moved[:150], plain[:150])
    torch.testing.assert_close(moved[150:], 10 - plain[150:], rtol=0, atol=1e-12)
    jump = (moved[150] - moved[149]).norm(dim=-1)
    assert jump.min() > 6
    distance = (moved.unsqueeze(-2) - torch.tensor(CORNERS)).norm(dim=-1)
    assert (ranges - distance).abs().max() < 6 * 0.2  # ranges are those to where they are


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"case": 4}, "case=4 is not allowed: one of 1, 2, 3"),
        ({"case": "2"}, "case='2' is not allowed: one of 1, 2, 3"),
        ({"anchors": 0}, "anchors=0 is not allowed: 1 to 8"),
        ({"anchors": 9}, "anchors=9 is not allowed: 1 to 8"),
        ({"n_uavs": 0}, "n_uavs=0 is not allowed: a whole number from 1 to 10000"),
        ({"horizon": 0}, "horizon=0 is not allowed: a whole number ≥ 1"),
        ({"uwb_std": -0.1}, "uwb_std=-0.1 is not allowed: a number ≥ 0 in m is needed"),
        ({"believed_uwb_std": 0.0}, "believed_uwb_std=0.0 is not allowed: a number > 0 in m or"),
        ({"q": -1.0}, "q=-1.0 is not allowed: a number ≥ 0 in m²/s⁴ or none is needed"),
        ({"nlos_anchor": 4}, r"blocked=\(4,\) is not allowed: indices of the 4 anchors"),
        ({"nlos_anchor": 2, "anchors": 2}, "indices of the 2 anchors"),
        ({"biased_anchors": 5}, "offset=.* is not allowed: of at most 4 anchors"),
        ({"nlos_anchor": -1}, "nlos_anchor=-1 is not allowed: a whole number ≥ 0 or none"),
        ({"nlos_kind": "odd"}, "nlos_kind='odd' is not allowed: one of exponential, constant"),
        ({"nlos": 1.5}, "nlos=1.5 is not allowed: a number from 0 to 1"),
        ({"uwb_dropout": -0.1}, "uwb_dropout=-0.1 is not allowed: a number from 0 to 1"),
        ({"max_speed": 0.0}, "max_speed=0.0 is not allowed: a number > 0 in m/s"),
        ({"kidnap_at": 0.0}, "kidnap_at=0.0 is not allowed"),
        ({"kidnap_at": float("inf")}, "kidnap_at=inf is not allowed"),
        ({"reward": "best"}, "reward='best' is not allowed"),
        ({"anchor": 3}, r"unknown option 'anchor' \(did you mean 'anchors'\?\)"),
    ],
)
def test_wrong_overrides_are_named(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        make_scenario("wsn-v0", **overrides)
    assert str(caught.value).startswith("wsn-v0: ")
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- faces and seeds


def truth(env: CoLocParallelEnv) -> dict[str, np.ndarray]:
    """The true position and velocity, from the privileged state."""
    rows = env.state().reshape(len(env.possible_agents), -1)
    surely = np.full(2, -3.0, np.float32)
    return {a: np.concatenate((r[:4], surely)) for a, r in zip(env.agents, rows, strict=True)}


@pytest.mark.parametrize("overrides", [{}, {"n_uavs": 3, "uwb_dropout": 0.2, "case": 2}], ids=str)
def test_both_faces_work(overrides: dict[str, Any]) -> None:
    parallel_api_test(parallel_env("wsn-v0", horizon=12, **overrides), num_cycles=30)
    parallel_seed_test(lambda: parallel_env("wsn-v0", horizon=12, **overrides))
    check_env_specs(CoLocEnv("wsn-v0", num_envs=2, horizon=6, **overrides), seed=3)


def test_the_truth_as_an_action_costs_nothing_over_the_whole_path() -> None:
    env = parallel_env("wsn-v0", n_uavs=2)
    env.reset(seed=1)
    steps = 0
    while env.agents:
        _, rewards, _, _, infos = env.step(truth(env))
        assert set(rewards.values()) == {0.0}
        steps += 1
    assert steps == 360
    assert all(info["episode_max"] == 0 for info in infos.values())


TROUBLE: dict[str, Any] = {
    "n_uavs": 2,
    "nlos": 0.1,
    "nlos_anchor": 1,
    "uwb_dropout": 0.2,
    "kidnap_at": 20.0,
}


def test_a_row_of_a_batch_is_its_own_world() -> None:
    scenario = make_scenario("wsn-v0", **TROUBLE)
    seeds = [5, 0, 9, 2**40, 7]
    together = ranged(scenario, seeds, 360)
    for row in (0, 3, 4):
        alone = ranged(scenario, seeds[row : row + 1], 360)
        for one, many in zip(alone, together, strict=True):
            assert torch.equal(one, many[:, row : row + 1])


def test_a_seed_fixes_the_whole_episode() -> None:
    """And its ranges alone: the path has no chance in it."""

    def episode(seed: int) -> list[Any]:
        env = parallel_env("wsn-v0", **TROUBLE)
        seen, _ = env.reset(seed=seed)
        brought = [seen]
        while env.agents:
            still = dict.fromkeys(env.agents, np.ones(6, np.float32))
            brought.append(env.step(still)[0])
        return brought

    first, again, other = episode(3), episode(3), episode(4)
    assert len(first) == 361
    for a, b, c in zip(first, again, other, strict=True):
        for uav in a:
            assert all(np.array_equal(a[uav][leaf], b[uav][leaf]) for leaf in a[uav])
            differ = {leaf for leaf in a[uav] if not np.array_equal(a[uav][leaf], c[uav][leaf])}
            assert "anchor_ranges" in differ
            assert differ <= {"anchor_ranges", "anchor_range_mask", "prior"}


def test_the_motion_is_the_square_or_its_kidnapped_twin() -> None:
    square = Square(side=6.0, corner=(2.0, 2.0), period=40.0, sharp=True)
    assert make_scenario("wsn-v0").motion == square
    assert make_scenario("wsn-v0", kidnap_at=12.3).motion == Kidnapped(square, 123)
