"""The batched world: each row is the world of its seed, and nothing handed out ever changes."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from coloc_env import noise
from coloc_env.envs.action_checks import checked_tensor
from coloc_env.envs.actions import Estimates
from coloc_env.motion import MOTIONS, Arena
from coloc_env.network import Network
from coloc_env.scenario import Prior, Scenario, Wheeled
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    LandmarkBearings,
    Odometry,
    RangeNoise,
    Ranging,
    UavBearings,
)
from coloc_env.world import World
from tests.sampling import crossed

Record = dict[str, Tensor]

WALL = (14.0, 8.0, 0.0, 16.0, 12.0, 5.0)
VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "nlos": {"nlos": 0.3},
    "tails": {"uwb_tail": 0.3},
    "uniform": {"uwb_uniform": 0.3},
    "impulse": {"uwb_impulse": 0.3},
    "dropouts": {"uwb_dropout": 0.3, "landmark_dropout": 0.3},
    "delay": {"uwb_delay": 2},
    "false matches": {"false_matches": 0.3},
    "range only": {"range_only": (0.3, 0.6)},
    "message loss": {"message_loss": 0.3},
    "message delay": {"message_delay": 2},
    "radius": {"comm_radius": 5.0, "motion": "random"},
    "walls": {"walls": WALL},
    "failures": {"failure_rate": 0.7, "horizon": 8},
    "biases": {"imu_bias": True},
    "anchors": {"anchors": 5},
    "uniform prior": {"prior": "uniform"},
    "many": {"n_uavs": 40, "comm_radius": 6.0, "message_loss": 0.2, "failure_rate": 0.2},
    "no imu": {"imu": False, "landmarks": 0},
    "log score": {"reward": "log_score"},
    "team": {"reward": "team", "failure_rate": 0.7, "horizon": 8},
} | {f"motion {name}": {"motion": name} for name in MOTIONS}


def actions_of(world: World, seeds: Tensor) -> Tensor:
    """What a row's team says, from the row's seed and own step alone."""
    n, width = world.scenario.arena.n_uavs, 3 * world.scenario.arena.dim
    keys = noise.fold(noise.row_keys(seeds), world.step_index)
    return noise.normal(keys, "test", n * width).unflatten(-1, (n, width))


def seen(world: World) -> Record:
    """All there is at the current step."""
    truth = world.truth
    record = {
        "position": truth.position,
        "velocity": truth.velocity,
        "attitude": truth.attitude,
        "state": world.state(),
        "alive": world.alive,
        "step": world.step_index,
    }
    return record | dict(world.observation().leaves)


def play(
    scenario: Scenario,
    seeds: Sequence[int],
    steps: int,
    window: int | None = None,
    resets: dict[int, tuple[list[bool], list[int]]] | None = None,
) -> Iterator[Record]:
    """Every step of a batch, with partial resets before the given steps."""
    world, now = World(scenario, len(seeds), window=window), torch.tensor(seeds)
    world.reset(now)
    scored: Record = {}
    for k in range(steps):
        if k in (resets or {}):
            rows, fresh = map(torch.tensor, (resets or {})[k])
            now = torch.where(rows, fresh, now)
            world.reset(now, rows)
        yield seen(world) | scored
        step = world.step(actions_of(world, now))
        scored = {
            "reward": step.reward,
            "error": step.error,
            "scored": step.scored,
            "terminated": step.terminated,
            "truncated": step.truncated,
        }


def same(batch: Record, row: int, single: Record, but: Sequence[str] = ()) -> None:
    assert batch.keys() == single.keys()
    for name, value in single.items():
        if name not in but:
            assert torch.equal(batch[name][row], value[0]), name


@pytest.mark.parametrize(("variant", "window"), crossed(VARIANTS, [None, 7], every=2))
def test_each_row_is_the_world_of_its_seed(variant: str, window: int | None) -> None:
    scenario = make_scenario("indoor-v0", **VARIANTS[variant])
    seeds = [3 * b + 5 for b in range(37)]
    batch = list(play(scenario, seeds, 10, window))
    for row in (0, 17, 36):
        for together, alone in zip(batch, play(scenario, [seeds[row]], 10), strict=True):
            same(together, row, alone)


def planar() -> Scenario:
    """Robots in the plane with every sensor that indoor-v0 lacks."""
    sensors = (
        Odometry(relative=0.1),
        LandmarkBearings(7, radius=9.0, share=0.8, depth=2),
        UavBearings(share=0.8),
    )
    return Scenario(
        name="planar",
        arena=Arena(2, 5, 0.1, (0.0, 0.0), (20.0, 12.0)),
        horizon=50,
        motion=MOTIONS["random_velocity"],
        sensors=sensors,
        network=Network(radius=8.0, loss=0.2),
        prior=Prior(),
        process=Wheeled(),
        believed_sensors=sensors,
    )


def tagged() -> Scenario:
    """Two UWB tags on lever arms, ranges delayed, heights, anchors within a radius."""
    tags = (((0.2, 0.0, 0.1), (-0.2, 0.1, 0.0)),) * 6
    sensors = (
        Ranging(RangeNoise(tail=0.2, dropout=0.1), tags, latency=2),
        AnchorRanging(((0.0, 0.0, 0.0), (9.0, 1.0, 2.0)), RangeNoise(nlos=0.2), tags, 12.0),
        Height(dropout=0.2),
    )
    scenario = make_scenario("indoor-v0", motion="aggressive")
    return dataclasses.replace(scenario, sensors=sensors)


@pytest.mark.parametrize("window", [None, 1, 7])
@pytest.mark.parametrize("make", [planar, tagged])
def test_each_row_is_the_world_of_its_seed_whatever_the_sensors(
    make: Callable[[], Scenario], window: int | None
) -> None:
    scenario = make()
    batch = list(play(scenario, range(37), 10, window))
    assert all(torch.isfinite(value).all() for record in batch for value in record.values())
    for row in (0, 17, 36):
        for together, alone in zip(batch, play(scenario, [row], 10), strict=True):
            same(together, row, alone)


@pytest.mark.parametrize("variant", ["plain", "motion random_velocity", "nlos", "biases", "many"])
@pytest.mark.parametrize("size", [2, 1024])
def test_any_batch_size(variant: str, size: int) -> None:
    scenario = make_scenario("indoor-v0", **VARIANTS[variant])
    size = min(size, 200) if variant == "many" else size
    batch = list(play(scenario, range(size), 3))
    for row in {0, 1, size // 2, size - 1}:
        for together, alone in zip(batch, play(scenario, [row], 3), strict=True):
            same(together, row, alone)


def compare_episodes(
    scenario: Scenario,
    seeds: list[int],
    steps: int,
    window: int | None,
    resets: dict[int, tuple[list[bool], list[int]]],
) -> None:
    """Every episode of every row against a world of its own."""
    batch = list(play(scenario, seeds, steps, window, resets))
    for row, seed in enumerate(seeds):
        starts = {0: seed} | {k: fresh[row] for k, (rows, fresh) in resets.items() if rows[row]}
        for begin, end in pairwise([*sorted(starts), steps]):
            alone = play(scenario, [starts[begin]], end - begin)
            for j, single in enumerate(alone):
                # What was scored before an episode's first step belongs to the episode before.
                late = ("reward", "error", "scored", "terminated", "truncated") if not j else ()
                same({k: v for k, v in batch[begin + j].items() if k not in late}, row, single)


MOMENTS = ["plain", "motion random_velocity", "message delay", "delay", "failures", "many"]


@pytest.mark.parametrize("window", [None, 7])  # others: at any moment, below
@pytest.mark.parametrize("variant", [*MOMENTS, "biases", "anchors"])
def test_rows_reset_alone(variant: str, window: int | None) -> None:
    resets = {
        3: ([False, True, False], [0, 40, 0]),
        4: ([True, False, True], [41, 0, 42]),
        5: ([True, True, True], [43, 44, 45]),
        12: ([False, False, True], [0, 0, 46]),
    }
    scenario = make_scenario("indoor-v0", **VARIANTS[variant])
    compare_episodes(scenario, [0, 1, 2], 20, window, resets)


@given(
    variant=st.sampled_from(MOMENTS),
    window=st.sampled_from([None, 1, 7, 64]),
    size=st.integers(2, 5),
    data=st.data(),
)
@settings(max_examples=15, deadline=None)
def test_rows_reset_alone_at_any_moment(
    variant: str, window: int | None, size: int, data: st.DataObject
) -> None:
    moments = data.draw(st.lists(st.integers(0, 17), max_size=4, unique=True))
    resets = {
        k: (
            data.draw(st.lists(st.booleans(), min_size=size, max_size=size)),
            data.draw(st.lists(st.integers(0, 99), min_size=size, max_size=size)),
        )
        for k in moments
    }
    scenario = make_scenario("indoor-v0", **VARIANTS[variant])
    compare_episodes(scenario, list(range(size)), 18, window, resets)


def test_a_reset_of_no_row_changes_nothing() -> None:
    world = World(make_scenario("indoor-v0"), 3)
    world.reset(0)
    world.step(torch.zeros(3, 6, 9))
    before = seen(world)
    world.reset(7, torch.zeros(3, dtype=torch.bool))
    for name, value in seen(world).items():
        assert torch.equal(value, before[name]), name


@pytest.mark.parametrize("window", [1, 4, None])
@pytest.mark.parametrize("variant", ["plain", "many", "message delay"])
def test_what_was_handed_out_never_changes(variant: str, window: int | None) -> None:
    world = World(make_scenario("indoor-v0", **VARIANTS[variant]), 3, window=window)
    kept: list[tuple[Tensor, Tensor]] = []

    def keep(record: Record) -> None:
        kept.extend((value, value.clone()) for value in record.values())

    seeds = torch.arange(3)
    keep(dict(world.reset(seeds).leaves))
    for k in range(12):
        if k in (3, 5, 8):
            rows = torch.tensor([k == 3, True, k == 8])
            seeds = seeds + 10
            keep(dict(world.reset(seeds, rows).leaves))
        action = actions_of(world, seeds)
        step = world.step(action)
        action.fill_(1e6)  # the caller's tensor stays the caller's
        keep(seen(world) | {"reward": step.reward, "error": step.error, "scored": step.scored})
    world.reset(0)
    assert all(torch.equal(value, copy) for value, copy in kept)


@pytest.mark.parametrize("variant", ["plain", "many", "anchors"])
def test_no_two_agents_or_rows_share_memory(variant: str) -> None:
    world = World(make_scenario("indoor-v0", **VARIANTS[variant]), 3)
    observation = world.reset(0)
    for _ in range(3):
        for name, leaf in observation.leaves.items():
            places = torch.zeros((), dtype=torch.int64)
            for size, stride in zip(leaf.shape, leaf.stride(), strict=True):
                places = places.unsqueeze(-1) + torch.arange(size) * stride
            assert len(places.flatten().unique()) == leaf.numel(), name
        for a in observation.leaves:
            for b in observation.leaves:
                x, y = observation[a], observation[b]
                apart = x.untyped_storage().data_ptr() != y.untyped_storage().data_ptr()
                assert a == b or apart, (a, b)
        world.step(actions_of(world, world.seeds))
        observation = world.observation()


@pytest.mark.parametrize("reward", ["error", "squared", "team"])
@pytest.mark.parametrize("motion", ["circle", "aggressive"])
def test_the_true_position_earns_exactly_zero(reward: str, motion: str) -> None:
    world = World(make_scenario("indoor-v0", reward=reward, motion=motion), 4)
    world.reset(0)
    for _ in range(5):
        action = torch.zeros(4, 6, 9)
        action[..., :3] = world.truth.position.to(torch.float32)
        state = world.state().unflatten(-1, (6, -1))
        assert torch.equal(action[..., :3], state[..., :3])
        step = world.step(action)
        assert (step.reward == 0).all()
        assert (step.error == 0).all()


def test_rewards_are_what_they_say() -> None:
    offset = torch.tensor([[3.0, 4.0, 0.0]]).expand(2, 6, 3)
    expected = {"error": -5.0, "squared": -25.0, "team": -5.0}
    for kind, value in expected.items():
        world = World(make_scenario("indoor-v0", reward=kind), 2)
        world.reset(0)
        target = world.truth.position.to(torch.float32)
        step = world.step(torch.cat((target + offset, torch.zeros(2, 6, 6)), -1))
        torch.testing.assert_close(step.reward, torch.full((2, 6), value), rtol=1e-5, atol=0)
    world = World(make_scenario("indoor-v0", reward="log_score"), 2)
    world.reset(0)
    log_std = torch.tensor([0.5, -0.3, 1.0]).expand(2, 6, 3)
    estimate = world.truth.position.to(torch.float32) + offset
    step = world.step(torch.cat((estimate, torch.zeros(2, 6, 3), log_std), -1))
    density = torch.distributions.Normal(estimate, log_std.exp())
    expected_score = density.log_prob(world.sensed.target[:, 0]).sum(-1)
    torch.testing.assert_close(step.reward, expected_score, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_message_arrives_one_step_and_its_delay_later(delay: int) -> None:
    world = World(make_scenario("indoor-v0", message_delay=delay), 2, window=4)
    observation = world.reset(0)
    for k in range(10):
        messages = observation["messages"].unflatten(-1, (6, 9))
        mask = observation["message_mask"]
        if k <= delay:
            assert (messages == 0).all()
            assert (mask == 0).all()
        else:
            others = 1 - torch.eye(6)
            assert torch.equal(mask, others.expand(2, -1, -1))
            sent = 100.0 * (k - 1 - delay) + torch.arange(6.0)
            expected = (others * sent).unsqueeze(-1).expand(2, 6, 6, 9)
            assert torch.equal(messages, expected)
        action = (100.0 * k + torch.arange(6.0))[None, :, None].expand(2, 6, 9)
        world.step(action)
        observation = world.observation()


def test_a_message_is_what_was_said_not_what_became_of_it() -> None:
    world = World(make_scenario("indoor-v0"), 1)
    world.reset(0)
    action = torch.arange(54.0).view(1, 9, 6).transpose(1, 2)  # strides are the caller's business
    said = action.clone()
    world.step(action)
    action.fill_(7.0)
    heard = (1 - torch.eye(6)).unsqueeze(-1) * said
    assert torch.equal(world.observation()["messages"][0].unflatten(-1, (6, 9)), heard)


def test_a_diverged_estimate_reaches_only_those_who_hear_it() -> None:
    world = World(make_scenario("indoor-v0", n_uavs=3, comm_radius=1e-3), 1)
    world.reset(0)
    action = torch.zeros(1, 3, 9)
    action[0, 1] = float("nan")
    world.step(action)
    assert (world.observation()["messages"] == 0).all()


def test_a_failed_uav_is_silent_unscored_and_stays_so() -> None:
    scenario = make_scenario("indoor-v0", failure_rate=1.0, horizon=10)
    for world in (World(scenario, 8), World(scenario, 8, window=3)):
        world.reset(0)
        terminated = torch.zeros(8, 6, dtype=torch.int64)
        sensed = ("imu", "landmarks", "landmark_mask", "ranges", "range_mask", "links")
        for k in range(10):
            before = world.alive
            step = world.step(torch.ones(8, 6, 9))
            assert torch.equal(step.scored, before)
            assert ((step.reward == 0) == ~before).all()
            terminated += step.terminated
            alive = world.alive
            assert torch.equal(step.terminated, before & ~alive)
            observation = world.observation()
            for name in (*sensed, "messages", "message_mask"):
                assert (observation[name][~alive] == 0).all(), name
            for name in ("links", "range_mask", "message_mask"):
                heard = observation[name].transpose(1, 2)[~alive]
                assert (heard == 0).all(), name
            content = observation["messages"].unflatten(-1, (6, 9)).transpose(1, 2)
            assert (content[~alive] == 0).all()
            assert bool(step.truncated.all()) == (k == 9)
        assert (terminated == 1).all()


def test_failures_at_given_steps() -> None:
    scenario = dataclasses.replace(make_scenario("indoor-v0"), failures=((2, 3), (4, 1)))
    world = World(scenario, 2)
    world.reset(0)
    failed = [
        world.step(torch.zeros(2, 6, 9)).terminated[0].nonzero().flatten().tolist()
        for _ in range(5)
    ]
    assert failed == [[4], [], [2], [], []]


def test_the_horizon_truncates() -> None:
    world = World(make_scenario("indoor-v0", horizon=3), 2)
    world.reset(0)
    over = [world.step(torch.zeros(2, 6, 9)).truncated.tolist() for _ in range(3)]
    assert over == [[False, False], [False, False], [True, True]]


def test_adding_a_sensor_shifts_nobodys_numbers() -> None:
    plain = list(play(make_scenario("indoor-v0"), [4], 5))
    for more in ({"anchors": 4}, {"imu": False}, {"landmarks": 0}, {"uwb": False}):
        other = list(play(make_scenario("indoor-v0", **more), [4], 5))
        for a, b in zip(plain, other, strict=True):
            for name in a.keys() & b.keys():
                assert torch.equal(a[name], b[name]), (more, name)
        assert plain[0].keys() != other[0].keys()


def test_more_landmarks_leave_the_first_where_they_were() -> None:
    few = World(make_scenario("indoor-v0", landmarks=5), 1).reset(0)["landmark_map"]
    many = World(make_scenario("indoor-v0", landmarks=9), 1).reset(0)["landmark_map"]
    assert torch.equal(many[..., :15], few)


def test_wrong_arguments_are_named() -> None:
    scenario = make_scenario("indoor-v0")
    with pytest.raises(ValueError, match="batch_size=0 is not allowed"):
        World(scenario, 0)
    with pytest.raises(ValueError, match="window=0 is not allowed"):
        World(scenario, 1, window=0)
    world = World(scenario, 2)
    with pytest.raises(ValueError, match="2 seeds are needed"):
        world.reset([1, 2, 3])
    world.reset(0)
    mode = Estimates(scenario.believed)
    with pytest.raises(ValueError, match=r"indoor-v0: actions of shape \(2, 6, 8\).*\(2, 6, 9\)"):
        checked_tensor(scenario, mode, torch.zeros(2, 6, 8), 2)
    bad = torch.zeros(2, 6, 9)
    bad[1, 4, 2] = float("inf")
    with pytest.raises(ValueError, match="indoor-v0: the action of uav_4 in world 1 holds NaN"):
        checked_tensor(scenario, mode, bad, 2)
