"""Scenario families: every override works, every wrong one is named, believed is not true."""

import inspect
import typing
from dataclasses import replace
from typing import Any

import pytest
import torch

from coloc_env.motion import MOTIONS
from coloc_env.observation import all_leaves, box, observation_space, state_bounds
from coloc_env.scenario import ConstantVelocity, Inertial, Prior
from coloc_env.scenarios import SCENARIOS, make_scenario
from coloc_env.sensors import AnchorRanging, Imu, Landmarks, RangeNoise, Ranging
from coloc_env.world import World


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"n_uav": 3}, r"unknown option 'n_uav' \(did you mean 'n_uavs'\?\); known: room, dt"),
        ({"n_uavs": 2.5}, "n_uavs=2.5 is not allowed: a whole number from 1 to 10000 is needed"),
        ({"n_uavs": True}, "n_uavs=True is not allowed: a whole number from 1 to 10000 is needed"),
        ({"n_uavs": 0}, "n_uavs=0 is not allowed: a whole number from 1 to 10000"),
        ({"nlos": 1.5}, "nlos=1.5 is not allowed: a number from 0 to 1 is needed"),
        ({"nlos": float("nan")}, "nlos=nan is not allowed: a number from 0 to 1 is needed"),
        ({"uwb_std": -0.1}, "uwb_std=-0.1 is not allowed: a number ≥ 0 in m is needed"),
        ({"motion": "hover"}, "motion='hover' is not allowed: one of circle, line"),
        ({"room": (30.0, 20.0)}, "room=.* is not allowed: 3 numbers"),
        ({"dt": 0.0}, "dt=0.0 is not allowed: a number > 0 in s is needed"),
        ({"room": (30.0, 20.0, 0.0)}, "room=.* is not allowed: 3 numbers > 0 in m"),
        ({"room": (1e308, 20.0, 5.0)}, "room=.* is not allowed: 3 numbers > 0 in m"),
        (
            {"uwb_std": float("inf")},
            "uwb_std=inf is not allowed: a number ≥ 0 in m, at most 1e.12, is needed",
        ),
        ({"max_speed": 0.0}, "max_speed=0.0 is not allowed: a number > 0 in m/s or none"),
        ({"horizon": 0}, "horizon=0 is not allowed: a whole number ≥ 1"),
        ({"reward": "best"}, "reward='best' is not allowed: one of error, squared, team, log_sc"),
        ({"prior": "none"}, "prior='none' is not allowed: one of gaussian, uniform"),
        ({"failure_rate": 2.0}, "failure_rate=2.0 is not allowed: a number from 0 to 1"),
        ({"comm_radius": -1.0}, "comm_radius=-1.0 is not allowed: a number > 0 in m or none"),
        ({"walls": (1.0, 2.0)}, "walls=.* is not allowed: six numbers a box"),
        ({"anchors": 99}, "anchors=99 is not allowed: 1 to 16"),
        ({"nlos_anchor": 2, "anchors": 2}, "blocked=.* is not allowed: indices of the 2 anchors"),
        ({"kidnapped": (1,)}, r"kidnapped=\(1,\) is not allowed: only with kidnap_at"),
        ({"landmarks": -1}, "landmarks=-1 is not allowed: a whole number ≥ 0"),
        ({"uwb_delay": -1}, "uwb_delay=-1 is not allowed: a whole number ≥ 0"),
    ],
)
def test_wrong_overrides_are_named(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        make_scenario("indoor-v0", **overrides)
    assert str(caught.value).startswith("indoor-v0: ")
    assert "\n" not in str(caught.value)


def test_unknown_scenarios_are_named() -> None:
    with pytest.raises(
        ValueError, match=r"unknown scenario 'indoors-v0' \(did you mean 'indoor-v0"
    ):
        make_scenario("indoors-v0")


@pytest.mark.parametrize("name", SCENARIOS)
def test_families_take_keywords_with_types_and_say_what_they_are(name: str) -> None:
    family = SCENARIOS[name]
    kinds = {p.kind for p in inspect.signature(family).parameters.values()}
    assert kinds <= {inspect.Parameter.KEYWORD_ONLY}
    assert family.__doc__
    for option, parameter in SCENARIOS.options_of(name).items():
        assert parameter.annotation is not inspect.Parameter.empty, option
        assert parameter.default is not inspect.Parameter.empty, option
        typing.get_args(parameter.annotation)


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_flies_indoors(motion: str) -> None:
    world = World(make_scenario("indoor-v0", motion=motion), 8)
    world.reset(0)
    room = torch.tensor([30.0, 20.0, 5.0], dtype=torch.float64)
    for _ in range(100):
        position = world.truth.position
        assert (position >= 0).all()
        assert (position <= room).all()
        world.advance(torch.zeros(8, 6, 9))


def test_indoor_is_as_published() -> None:
    scenario = make_scenario("indoor-v0")
    assert scenario.agents == [f"uav_{i}" for i in range(6)]
    assert (scenario.arena.dt, scenario.horizon) == (0.1, 1000)
    assert scenario.sensors == (Imu(), Landmarks(), Ranging(RangeNoise(std=0.2)))
    assert scenario.believed.sensors == scenario.sensors
    assert scenario.believed.process == Inertial()
    assert scenario.believed.slots == 6


def test_what_is_believed_is_not_what_is_true() -> None:
    contaminated = make_scenario(
        "indoor-v0", nlos=0.3, uwb_tail=0.1, false_matches=0.2, landmark_dropout=0.1, imu_bias=True
    )
    plain = make_scenario("indoor-v0", believed_imu_bias=True)
    assert contaminated.believed.sensors == plain.believed.sensors
    assert contaminated.sensors != plain.sensors
    assert contaminated.believed.process == Inertial(0.1, 0.01)
    unsuspecting = make_scenario("indoor-v0", imu_bias=True, believed_imu_bias=False)
    assert unsuspecting.believed.process == Inertial()
    assert make_scenario("indoor-v0", imu=False).believed.process == ConstantVelocity(0.1)
    other = replace(plain, believed_prior=Prior(position_std=7.0))
    assert other.believed.prior.position_std == 7.0
    assert other.prior == plain.prior


def test_the_prior_leaf() -> None:
    world = World(make_scenario("indoor-v0", prior_std=3.0), 400)
    prior, truth = world.reset(0)["prior"].double(), world.truth
    width = all_leaves(world.scenario)["prior"].width
    assert prior.shape[-1] == width == 15
    parts = prior.split((3, 3, 4, 3, 1, 1), -1)
    n = prior[..., 0].numel()
    for mean, true, std in ((parts[0], truth.position, 3.0), (parts[1], truth.velocity, 0.2)):
        error = (mean - true).flatten(0, 1)
        assert ((error.std(0) / std - 1).abs() < 5 / (2 * n) ** 0.5).all()
        assert (error.mean(0).abs() < 5 * std / n**0.5).all()
    angle = 2 * (parts[2] * truth.attitude).sum(-1).abs().clamp(max=1).arccos()
    expected = 0.05 * 3**0.5
    assert abs(float((angle**2).mean()) ** 0.5 / expected - 1) < 5 / n**0.5
    assert (parts[3] == 3.0).all()
    torch.testing.assert_close(parts[4], torch.full_like(parts[4], 0.2), rtol=1e-6, atol=0)
    torch.testing.assert_close(parts[5], torch.full_like(parts[5], 0.05), rtol=1e-6, atol=0)


def test_a_uniform_prior_tells_the_arena_alone() -> None:
    prior = World(make_scenario("indoor-v0", prior="uniform"), 5).reset(0)["prior"]
    mean, std = prior[..., :3], prior[..., 10:13]
    torch.testing.assert_close(mean, torch.tensor([15.0, 10.0, 2.5]).expand_as(mean))
    room = torch.tensor([30.0, 20.0, 5.0])
    torch.testing.assert_close(std, (room / 12**0.5).expand_as(std))


def test_anchors_stand_in_corners_and_along_walls() -> None:
    room = torch.tensor([30.0, 20.0, 5.0])
    places = World(make_scenario("indoor-v0", anchors=16), 1).reset(0)["anchor_map"][0, 0]
    share = places.unflatten(-1, (16, 3)) / room
    assert len(share.unique(dim=0)) == 16
    assert ((share == 0) | (share == 0.5) | (share == 1)).all()
    assert ((share == 0.5).sum(-1) <= 1).all()
    assert isinstance(make_scenario("indoor-v0", anchors=1).sensors[-1], AnchorRanging)


def test_spaces_follow_the_sensors() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=20, anchors=2, landmarks=4)
    space = observation_space(all_leaves(scenario))
    widths = {name: box.shape[0] for name, box in space.items() if box.shape is not None}
    assert widths == {
        "imu": 6,
        "landmarks": 12,
        "landmark_mask": 4,
        "ranges": 16,
        "range_mask": 16,
        "anchor_ranges": 2,
        "anchor_range_mask": 2,
        "links": 16,
        "neighbours": 16,
        "messages": 144,
        "message_mask": 16,
        "prior": 15,
        "landmark_map": 12,
        "anchor_map": 6,
    }
    assert box(state_bounds(scenario)).shape == (20 * 12,)


def test_two_sensors_may_not_deliver_one_leaf() -> None:
    scenario = make_scenario("indoor-v0")
    with pytest.raises(ValueError, match="indoor-v0: two sensors deliver the leaf 'imu'"):
        all_leaves(replace(scenario, sensors=(Imu(), Imu())))
