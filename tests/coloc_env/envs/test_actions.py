"""Action modes: displacements and fixes by closed forms, both faces alike, wrong use in words."""

import pickle
import re
import warnings
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from scipy.spatial.transform import Rotation
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import check_env_specs

from agents.wrappers.correction import with_base
from coloc_env.envs.action_checks import checked_tensor
from coloc_env.envs.action_mode import ActionMode
from coloc_env.envs.actions import make_mode
from coloc_env.envs.displacement import Displacement
from coloc_env.envs.fixes import fixes, relative_fixes
from coloc_env.envs.mode_runner import ModeRunner
from coloc_env.envs.pettingzoo import CoLocParallelEnv, env, parallel_env
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv
from coloc_env.motion import Arena, RandomVelocity
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.scenario import Prior, Scenario, Wheeled
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Imu, LandmarkBearings, Odometry, Ranging
from coloc_env.sensors.base import Leaf
from coloc_env.world import World

N = 3
MODES = ("displacement", "correction")


def indoor(**overrides: Any) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": N, "horizon": 6, "motion": "random"} | overrides)


def plane() -> Scenario:
    """Ground robots that see some landmarks twice a step."""
    sensors = (Odometry(), LandmarkBearings(count=5, radius=20.0, share=0.8, depth=2))
    return Scenario(
        name="plane",
        arena=Arena(2, N, 0.1, (0.0, 0.0), (10.0, 8.0)),
        horizon=6,
        motion=RandomVelocity(),
        sensors=sensors,
        network=Network(),
        prior=Prior(position_std=0.5, velocity_std=0.1),
        process=Wheeled(),
        believed_sensors=sensors,
    )


def batched(scenario: Scenario, mode: str, worlds: int = 1, seed: int = 0) -> CoLocEnv:
    made = CoLocEnv(scenario, worlds, seed=seed)
    return with_base(made) if mode == "correction" else made.with_action(mode)


def single(scenario: Scenario, mode: str) -> CoLocParallelEnv:
    made = parallel_env(scenario)
    return with_base(made) if mode == "correction" else made.with_action(mode)


def simulate(made: CoLocEnv, actions: Tensor) -> list[TensorDictBase]:
    """What is seen before each step [K entries], with the rewards of the action taken in it."""
    now, seen = made.reset(), []
    for action in actions.unbind(2):
        now["uav", "action"] = action
        done, now = made.step_and_maybe_reset(now)
        seen.append(done)
    return seen


def truth(state: Tensor, dim: int = 3, n: int = N) -> Tensor:
    """True positions in a flat state, whatever follows the truth there."""
    width = 2 * dim + (4 if dim == 3 else 1) + 2
    return state[..., : n * width].unflatten(-1, (n, width))[..., :dim]


# ---------------------------------------------------------------- displacement


@pytest.mark.parametrize("scenario", [indoor(), plane()], ids=["indoor", "plane"])
def test_displacements_add_up_from_the_prior(scenario: Scenario) -> None:
    """Estimates are prior + Σ actions, each cut at ±1 m an axis; the reward is their error."""
    dim = scenario.arena.dim
    actions = 3 * torch.rand(2, N, 6, dim) - 1.5
    assert (actions.abs() > 1).any()
    estimate = None
    for step, seen in enumerate(simulate(batched(scenario, "displacement", 2), actions)):
        observation = seen["uav", "observation"]
        if estimate is None:
            estimate = observation["prior"][..., :dim].numpy().astype(np.float64)
            assert (observation["last_action"] == 0).all()
        else:
            last = actions[:, :, step - 1].numpy().clip(-1, 1)
            np.testing.assert_array_equal(observation["last_action"], last)
        apart = estimate - truth(seen["state"], dim).numpy()
        np.testing.assert_allclose(seen["state"][:, -N * dim :], apart.reshape(2, -1), atol=1e-5)
        estimate = estimate + actions[:, :, step].numpy().astype(np.float64).clip(-1, 1)
        error = np.linalg.norm(estimate - truth(seen["state"], dim).numpy(), axis=-1)
        np.testing.assert_allclose(seen["next", "uav", "reward"][..., 0], -error, atol=2e-6)
        received = seen["next", "uav", "observation", "messages"].unflatten(-1, (N, 3 * dim))
        np.testing.assert_allclose(received[0, 0, 1:, :dim], estimate[0, 1:], atol=1e-5)
        assert (received[0, 0, 1:, dim:] == 0).all(), "no velocity, a standard deviation of 1 m"


def test_the_exact_displacement_earns_exactly_zero() -> None:
    """Where the difference to the truth is a float32 number, as it is within a factor of 2."""
    scenario = replace(indoor(), prior=Prior(position_std=0.2))
    made = batched(scenario, "displacement", 8)
    now, exact = made.reset(), 0
    estimate = now["uav", "observation", "prior"][..., :3]
    for _ in range(6):
        target = truth(now["state"])
        action = target - estimate
        assert (action.abs() < 1).all(), "or the truth is out of reach"
        now["uav", "action"] = action
        ratio = target / estimate
        near = ((ratio >= 0.5) & (ratio <= 2)).all(-1)
        estimate = estimate + action
        now = made.step(now)["next"]
        reward = now["uav", "reward"][..., 0]
        assert (reward[near] == 0).all()
        assert (reward > -1e-5).all()
        exact += int(near.sum())
    assert exact > 0.8 * 6 * 8 * N


@given(st.lists(st.floats(-5, 5, width=32), min_size=2 * N * 2, max_size=2 * N * 2))
@settings(max_examples=40, deadline=None)
def test_a_memory_is_the_sum_of_its_actions(numbers: list[float]) -> None:
    scenario = plane()
    mode = Displacement(scenario.believed)
    observation = World(scenario, 2).reset(0)
    memory = mode.reset(observation)
    action = torch.tensor(numbers).view(2, N, 2)
    for times in (1, 2, 3):
        memory, estimate = mode.estimate(memory, action)
        moved = estimate[..., :2] - observation["prior"][..., :2]
        torch.testing.assert_close(moved, times * action.clamp(-1, 1), atol=1e-5, rtol=0)
        assert torch.equal(mode.reference(memory), estimate[..., :2])


def test_errors_in_the_state_are_cut_at_its_bounds() -> None:
    made = parallel_env(indoor(horizon=120), action="displacement")
    made.reset(seed=0)
    for _ in range(115):
        made.step({agent: np.array([1.0, 0.0, 0.0], np.float32) for agent in made.agents})
    errors = made.state()[-3 * N :].reshape(N, 3)
    assert (errors[:, 0] > 75).all()
    assert made.state_space.contains(made.state())
    for _ in range(4):
        made.step({agent: np.array([1.0, 0.0, 0.0], np.float32) for agent in made.agents})
    assert made.state()[-3 * N :].max() <= 100.0


# ---------------------------------------------------------------- fixes and attitude


def test_a_noiseless_landmark_fixes_the_true_position() -> None:
    scenario = indoor(landmark_std=0.0, landmark_radius=12.0)
    world = World(scenario, 3)
    observation = world.reset(0)
    for _ in range(4):
        attitude = world.truth.attitude.to(torch.float32)
        places, mask = fixes(scenario.believed, observation, attitude)
        position = world.truth.position.to(torch.float32)
        assert torch.equal(mask, observation["landmark_mask"] > 0)
        assert 0 < mask.sum() < mask.numel()
        expected = position.unsqueeze(-2).expand_as(places)
        torch.testing.assert_close(places[mask], expected[mask], atol=2e-5, rtol=0)
        elsewhere = position + torch.tensor([1.0, -2.0, 0.5])
        leaves, _, _ = relative_fixes(scenario.believed, observation, attitude, elsewhere)
        some = mask.any(-1)
        expected = torch.tensor([-1.0, 2.0, -0.5]).expand(int(some.sum()), 3)
        torch.testing.assert_close(leaves["fix_mean"][some], expected, atol=2e-5, rtol=0)
        share = mask.double().mean(-1, keepdim=True)
        torch.testing.assert_close(leaves["fix_share"].double(), share, atol=1e-7, rtol=0)
        world.advance(torch.zeros(3, N, 9))
        observation = world.observation()


def test_false_masks_leave_nothing() -> None:
    scenario = indoor()
    observation = World(scenario, 2).reset(0)
    attitude = observation["prior"][..., 6:10]
    position = observation["prior"][..., :3]

    def relative(**changed: Tensor) -> dict[str, Tensor]:
        seen = Observation({**observation.leaves, **changed})
        return relative_fixes(scenario.believed, seen, attitude, position)[0]

    nothing = relative(landmark_mask=torch.zeros_like(observation["landmark_mask"]))
    assert set(nothing) == {"landmark_fixes", "landmark_fix_mask", "fix_mean", "fix_share"}
    assert all((leaf == 0).all() for leaf in nothing.values())
    behind = observation["landmark_mask"].repeat_interleave(3, -1) == 0
    garbled = relative(landmarks=observation["landmarks"].masked_fill(behind, 1e3))
    assert behind.any()
    for name, leaf in relative().items():
        assert torch.equal(garbled[name], leaf), name


def test_without_noise_the_leaves_lead_to_the_truth() -> None:
    """Attitude known and turned exactly, landmarks seen exactly: the fixes' mean is the way."""
    scenario = indoor(landmark_std=0.0, gyro_std=0.0, landmark_radius=40.0)
    scenario = replace(scenario, prior=Prior(position_std=1.0, attitude_std=0.0))
    made = batched(scenario, "displacement", 2)
    for seen in simulate(made, 2 * torch.rand(2, N, 6, 3) - 1):
        observation = seen["uav", "observation"]
        error = seen["state"][:, -3 * N :].unflatten(-1, (N, 3))
        assert (observation["fix_share"] == 1).all()
        torch.testing.assert_close(observation["fix_mean"], -error, atol=1e-4, rtol=0)
        each = observation["landmark_fixes"].unflatten(-1, (-1, 3))
        expected = -error.unsqueeze(-2).expand_as(each)
        torch.testing.assert_close(each, expected, atol=1e-4, rtol=0)


def quaternion(wxyz: NDArray) -> Rotation:
    return Rotation.from_quat(wxyz[..., [1, 2, 3, 0]].reshape(-1, 4))


def test_the_attitude_follows_the_gyroscope() -> None:
    scenario = indoor(gyro_std=0.3)
    attitude = None
    for seen in simulate(batched(scenario, "displacement", 2), torch.zeros(2, N, 6, 3)):
        observation = seen["uav", "observation"]
        if attitude is None:
            attitude = quaternion(observation["prior"].numpy()[..., 6:10].astype(np.float64))
        else:
            rate = observation["imu"].numpy()[..., 3:].astype(np.float64).reshape(-1, 3)
            attitude = attitude * Rotation.from_rotvec(rate * scenario.arena.dt)
        found = quaternion(observation["attitude"].numpy().astype(np.float64))
        np.testing.assert_allclose((found.inv() * attitude).magnitude(), 0, atol=1e-5)


def test_the_heading_follows_the_odometry() -> None:
    scenario = plane()
    heading = None
    for seen in simulate(batched(scenario, "displacement", 2), torch.zeros(2, N, 6, 2)):
        observation = seen["uav", "observation"]
        turn = observation["odometry"].numpy()[..., 2].astype(np.float64)
        given = observation["prior"].numpy()[..., 4].astype(np.float64)
        heading = given if heading is None else heading + scenario.arena.dt * turn
        found = observation["attitude"].numpy()[..., 0]
        np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * heading), atol=1e-5)


def test_without_a_gyroscope_the_attitude_stays_the_priors() -> None:
    for seen in simulate(
        batched(indoor(imu=False, landmarks=0), "displacement"), torch.zeros(1, N, 4, 3)
    ):
        observation = seen["uav", "observation"]
        assert torch.equal(observation["attitude"], observation["prior"][..., 6:10])
        assert "fix_mean" not in observation.keys()  # noqa: SIM118


def test_turn_rates_are_the_sensors_own() -> None:
    leaves = {"imu": torch.arange(6.0).view(1, 1, 6), "odometry": torch.arange(3.0).view(1, 1, 3)}
    assert Imu().turn_rate(leaves).flatten().tolist() == [3.0, 4.0, 5.0]
    assert Odometry().turn_rate(leaves).flatten().tolist() == [2.0]
    assert Ranging().turn_rate(leaves) is None
    assert Ranging().fix_slots == 0


@given(
    position=st.tuples(st.floats(-20, 20), st.floats(-20, 20)),
    heading=st.floats(-3.1, 3.1),
)
@settings(max_examples=50, deadline=None)
def test_bearings_in_the_plane_fix_the_position(
    position: tuple[float, float], heading: float
) -> None:
    """Range and bearing as trigonometry has them, at two depths of three landmarks."""
    points = np.array([[0.0, 0.0], [7.0, -3.0], [25.0, 30.0]])
    x, y = (points - position).T
    assume(np.hypot(x, y).min() > 0.01)  # a range of 0 is none
    measured = np.stack((np.hypot(x, y), np.arctan2(y, x) - heading), -1)
    farther = measured + np.array([0.5, 0.0])
    measured = np.concatenate((measured, farther))
    mask = np.array([1, 0, 1, 1, 1, 1])
    leaves = {
        "landmark_bearings": torch.tensor(measured, dtype=torch.float64).view(1, 1, 12),
        "landmark_bearing_mask": torch.tensor(mask).view(1, 1, 6),
        "landmark_map": torch.tensor(points).view(1, 1, 6),
    }
    sensor = LandmarkBearings(count=3, depth=2)
    attitude = torch.tensor(heading, dtype=torch.float64).view(1, 1, 1)
    places, seen = sensor.fixes(leaves, attitude)
    assert sensor.fix_slots == 6
    assert seen[0, 0].tolist() == [bool(m) for m in mask]
    np.testing.assert_allclose(places[0, 0, [0, 2]], np.tile(position, (2, 1)), atol=1e-9)
    away = np.linalg.norm(places[0, 0, 3:].numpy() - position, axis=-1)
    np.testing.assert_allclose(away, 0.5, atol=1e-9)


# ---------------------------------------------------------------- faces


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("scenario", [indoor(message_delay=1), plane()], ids=["indoor", "plane"])
def test_both_faces_agree_step_by_step(scenario: Scenario, mode: str) -> None:
    """Every number, over two episodes, in the second row of two, too."""
    alone = batched(scenario, mode, seed=4)
    pair = batched(scenario, mode, 2, seed=3)
    wild = single(scenario, mode)
    names = list(wild.observation_space("uav_0"))
    rng = np.random.default_rng(0)
    a, b = alone.reset(), pair.reset()
    observations, _ = wild.reset(seed=4)
    for step in range(12):
        assert set(names) == set(a["uav", "observation"].keys())
        for name in names:
            expected = np.stack([seen[name] for seen in observations.values()])
            np.testing.assert_array_equal(a["uav", "observation", name][0], expected, name)
            if step < 6:
                found = b["uav", "observation", name][1]
                np.testing.assert_allclose(found, expected, atol=1e-5, err_msg=name)
        np.testing.assert_array_equal(a["state"][0], wild.state())
        assert wild.state_space.contains(wild.state())
        assert all(wild.observation_space(u).contains(seen) for u, seen in observations.items())
        action = rng.uniform(-1.2, 1.2, (N, scenario.arena.dim)).astype(np.float32)
        a["uav", "action"] = torch.from_numpy(action)[None]
        b["uav", "action"] = torch.from_numpy(action).expand(2, -1, -1)
        observations, rewards, _, truncated, _ = wild.step(
            dict(zip(wild.agents, action, strict=True))
        )
        (a_then, a), (b_then, b) = alone.step_and_maybe_reset(a), pair.step_and_maybe_reset(b)
        assert a_then["next", "uav", "reward"][0, :, 0].tolist() == list(rewards.values())
        if step < 6:
            found = b_then["next", "uav", "reward"][1, :, 0]
            np.testing.assert_allclose(found, list(rewards.values()), atol=1e-5)
        if all(truncated.values()):
            assert step % 6 == 5
            for name in names:
                expected = np.stack([seen[name] for seen in observations.values()])
                last = a_then["next", "uav", "observation", name][0]
                np.testing.assert_array_equal(last, expected, name)
            observations, _ = wild.reset()


@pytest.mark.parametrize("mode", MODES)
def test_a_reset_of_some_rows_starts_their_memory_alone(mode: str) -> None:
    """Worlds end when all their UAVs have failed; each episode is that of a world by itself."""
    scenario = indoor(n_uavs=2, failure_rate=1.0, horizon=9)
    torch.manual_seed(0)
    actions = 2 * torch.rand(3, 2, 25, 3) - 1
    seen: Any = torch.stack(simulate(batched(scenario, mode, 3), actions), 1)
    ends = seen["next", "done"][..., 0]
    assert not torch.equal(ends[0], ends[1])
    episodes = 0
    for row in range(3):
        stops = [0, *(ends[row].nonzero()[:, 0] + 1).tolist(), 25]
        for e, (start, stop) in enumerate(pairwise(stops)):
            if start == stop:
                continue
            episodes += 1
            alone = batched(scenario, mode, seed=row + 3 * e)
            again: Any = torch.stack(simulate(alone, actions[row : row + 1, :, start:stop]), 1)[0]
            part = seen[row, start:stop]
            for key in again.keys(True, True):
                ours, theirs = part[key].numpy(), again[key].numpy()
                np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-5, err_msg=str(key))
    assert episodes >= 9


@pytest.mark.parametrize("mode", MODES)
def test_a_pilot_gives_every_rows_leaves_when_some_start_anew(mode: str) -> None:
    scenario = indoor()
    world = World(scenario, 3)
    runner = ModeRunner(single(scenario, mode).mode, world)
    world.reset(0)
    runner.reset()
    for _ in range(2):
        world.step(runner.estimate(torch.full((3, N, 3), 0.7)))
        before = runner.observe()
    rows = torch.tensor([False, True, False])
    world.reset(10, rows)
    after = runner.reset(rows)
    fresh_world = World(scenario, 3)
    fresh_world.reset(10)
    fresh = ModeRunner(single(scenario, mode).mode, fresh_world).reset()
    for name, leaf in after.items():
        assert torch.equal(leaf[[0, 2]], before[name][[0, 2]]), name
        torch.testing.assert_close(leaf[1], fresh[name][1], atol=1e-5, rtol=1e-5)
    assert (after["last_action"][:, 0, 0] != 0).tolist() == [True, False, True]


@pytest.mark.parametrize("mode", MODES)
def test_specs_hold(mode: str) -> None:
    check_env_specs(batched(indoor(), mode, 2), seed=3)
    check_env_specs(batched(plane(), mode), seed=3)


@pytest.mark.parametrize("mode", MODES)
def test_pettingzoos_own_tests(mode: str, capsys: pytest.CaptureFixture[str]) -> None:
    parallel_api_test(single(indoor(failure_rate=0.8), mode), num_cycles=20)
    scenario = indoor()
    parallel_api_test(single(scenario, mode), num_cycles=15)
    parallel_seed_test(lambda: single(scenario, mode), num_cycles=7)
    aec = env(scenario, action=single(scenario, mode).mode)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning)  # of Dict observations
        api_test(aec, num_cycles=25)
        seed_test(lambda: env(scenario, action=single(scenario, mode).mode))
    assert "Passed API test" in capsys.readouterr().out


@pytest.mark.parametrize("mode", MODES)
def test_a_whole_episode_is_its_seeds(mode: str) -> None:
    def episode(seed: int) -> list[str]:
        made = single(indoor(), mode)
        rng = np.random.default_rng(1)
        entries = [repr(made.reset(seed=seed))]
        while made.agents:
            actions = {agent: rng.uniform(-1, 1, 3).astype(np.float32) for agent in made.agents}
            entries.append(repr((made.step(actions), made.state().tolist())))
        return entries

    first = episode(5)
    assert len(first) == 7
    assert episode(5) == first
    assert all(a != b for a, b in zip(episode(6), first, strict=True))


@pytest.mark.parametrize("mode", MODES)
def test_the_cycle_of_agents_is_the_parallel_episode(mode: str) -> None:
    scenario = indoor()
    aec, parallel = env(scenario, action=single(scenario, mode).mode), single(scenario, mode)
    aec.reset(seed=2)
    observations, _ = parallel.reset(seed=2)
    rng = np.random.default_rng(0)
    earned = dict.fromkeys(parallel.possible_agents, 0.0)
    expected = dict(earned)
    while parallel.agents:
        action = rng.uniform(-1, 1, (N, 3)).astype(np.float32)
        for agent in list(parallel.agents):
            i = parallel.possible_agents.index(agent)
            assert aec.agent_selection == agent
            seen, reward, _, _, _ = aec.last()
            earned[agent] += reward
            for name, leaf in observations[agent].items():
                np.testing.assert_array_equal(seen[name], leaf)
            aec.step(action[i])
        observations, rewards, *_ = parallel.step(dict(zip(parallel.agents, action, strict=True)))
        for agent, reward in rewards.items():
            expected[agent] += reward
    for agent in list(aec.agents):
        earned[agent] += aec.last()[1]
        aec.step(None)
    assert not aec.agents
    assert earned == pytest.approx(expected)


@pytest.mark.parametrize("mode", MODES)
def test_a_pickled_environment_goes_on_alike(mode: str) -> None:
    made = batched(indoor(n_uavs=2, failure_rate=0.5), mode, 2)
    now = made.reset()
    for _ in range(2):
        now["uav", "action"] = torch.full((2, 2, 3), 0.3)
        now = made.step_mdp(made.step(now))
    twin = pickle.loads(pickle.dumps(made))
    for _ in range(6):
        now["uav", "action"] = torch.full((2, 2, 3), -0.4)
        ours, after = made.step_and_maybe_reset(now.clone())
        theirs, _ = twin.step_and_maybe_reset(now.clone())
        assert bool((ours == theirs).all())
        now = after


def test_rollouts_stay_as_they_were_returned() -> None:
    for mode in MODES:
        made = batched(indoor(n_uavs=2, failure_rate=0.7), mode, 3)
        now, kept = made.reset(), []
        for _ in range(15):
            now["uav", "action"] = torch.rand(3, 2, 3)
            done, now = made.step_and_maybe_reset(now)
            kept.append((done, done.clone()))
        assert all(bool((seen == copy).all()) for seen, copy in kept)


# ---------------------------------------------------------------- wrong use


def refused(words: str) -> Any:
    return pytest.raises(ValueError, match=re.escape(words))


def test_an_unknown_mode_is_named() -> None:
    words = "action='displacment' is not allowed: estimate, displacement, or an ActionMode"
    for face in (parallel_env, env, CoLocEnv, CoLocVecEnv):
        with refused(words):
            face(indoor(), action="displacment")
    with refused(words):
        parallel_env(indoor()).with_action("displacment")


def test_a_mode_belongs_to_its_scenario() -> None:
    scenario = indoor()
    mode = make_mode(scenario, "displacement")
    assert parallel_env(scenario, action=mode).mode is mode
    for face in (parallel_env, env, CoLocEnv, CoLocVecEnv):
        with refused("indoor-v0: the action mode was made for another scenario"):
            face(indoor(), action=mode)


def test_actions_of_another_mode_do_not_fit() -> None:
    estimates, displacements = np.zeros(9, np.float32), np.zeros(3, np.float32)
    for mode, wrong, words in (
        ("displacement", estimates, "with action=displacement: displacement in m within [-1, 1]"),
        ("correction", estimates, "with action=correction: correction in units of what the base"),
        ("estimate", displacements, "with action=estimate: [position, velocity, log-std]"),
    ):
        wild = single(indoor(), mode)
        wild.reset(seed=0)
        state = wild.state()
        width = 9 if mode == "estimate" else 3
        with refused(f"has shape {wrong.shape}; ({width},) finite numbers are needed {words}"):
            wild.step(dict.fromkeys(wild.agents, wrong))
        assert np.array_equal(wild.state(), state)
        made = batched(indoor(), mode, 2)
        now = made.reset()
        now["uav", "action"] = torch.zeros(2, N, len(wrong))
        with refused(
            f"indoor-v0: actions of shape (2, 3, {len(wrong)}) do not fit: (2, 3, {width}) "
            "(worlds, UAVs, "
        ) as caught:
            made.step(now)
        assert f"is needed with action={mode}" in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_named(value: float) -> None:
    for mode in MODES:
        wild = single(indoor(), mode)
        wild.reset(seed=0)
        actions = {agent: np.zeros(3, np.float32) for agent in wild.agents}
        actions["uav_1"][2] = value
        with refused("indoor-v0: the action of uav_1 holds NaN or infinity; (3,) finite numbers"):
            wild.step(actions)
        made = batched(indoor(), mode, 2)
        now = made.reset()
        action = torch.zeros(2, N, 3)
        action[1, 2, 0] = value
        now["uav", "action"] = action
        with refused("indoor-v0: the action of uav_2 in world 1 holds NaN or infinity"):
            made.step(now)


def test_actions_of_another_number_of_worlds_do_not_fit() -> None:
    scenario = indoor()
    mode = make_mode(scenario, "displacement")
    with refused("indoor-v0: actions of shape (3, 3, 3) do not fit: (2, 3, 3) (worlds, UAVs"):
        checked_tensor(scenario, mode, torch.zeros(3, N, 3), 2)
    made = batched(scenario, "displacement", 2)
    made.reset()
    with refused("actions of shape (2, 2, 3) do not fit: (2, 3, 3)"):
        made._step(TensorDict({"uav": TensorDict({"action": torch.zeros(2, 2, 3)}, [2])}, [2]))


def test_flat_views_refuse_what_they_cannot_show() -> None:
    failing, whole = indoor(failure_rate=0.1), indoor()
    planned = replace(whole, failures=((0, 2),))
    for scenario in (failing, planned):
        for flat in (lambda s: CoLocVecEnv(s, 2), lambda s: PerUavEnv(CoLocEnv(s, 2))):
            with refused("indoor-v0: UAVs that fail do not fit rows of one UAV each"):
                flat(scenario)
    for flat in (
        lambda s: CoLocVecEnv(s, leaves=["imu", "fix_mean"]),
        lambda s: PerUavEnv(CoLocEnv(s), ["imu", "fix_mean"]),
    ):
        with refused("there is no leaf 'fix_mean'; known: ") as caught:
            flat(whole)
        assert "landmark_mask" in str(caught.value)


class Halves(ActionMode):
    """A mode of one's own: half of the action is the estimate."""

    name = "halves"
    meaning = "twice the estimate"

    @property
    def bounds(self) -> tuple[list[float], list[float]]:
        return [-100.0] * 3, [100.0] * 3

    def estimate(self, memory: None, action: Tensor) -> tuple[None, Tensor]:
        return None, torch.cat((0.5 * action, torch.zeros_like(action).repeat(1, 1, 2)), -1)


def test_a_mode_of_ones_own_acts_in_every_face() -> None:
    scenario = indoor()
    wild = parallel_env(scenario, action=Halves(scenario.believed))
    made = CoLocEnv(scenario, action=Halves(scenario.believed))
    assert set(wild.observation_space("uav_0")) == set(made.observation_spec["uav", "observation"])
    wild.reset(seed=0)
    position = wild.state().reshape(N, -1)[:, :3]
    assert set(wild.step(dict(zip(wild.agents, 2 * position, strict=True)))[1].values()) == {0.0}
    now = made.reset()
    now["uav", "action"] = 2 * truth(now["state"])
    assert (made.step(now)["next", "uav", "reward"] == 0).all()
    assert made.mode.settings == {"name": "halves"}


class Silent(Displacement):
    """A memory that no leaf shows."""

    name = "silent"
    leaves = {}  # noqa: RUF012

    def observe(self, memory: Any, observation: Observation) -> tuple[Any, dict[str, Tensor]]:
        return memory, {}


class Outspoken(Halves):
    """A leaf without a memory."""

    name = "outspoken"
    leaves = {"twice": Leaf(3)}  # noqa: RUF012

    def observe(self, memory: None, observation: Observation) -> tuple[None, dict[str, Tensor]]:
        return None, {"twice": 2 * observation["prior"][..., :3]}


@pytest.mark.parametrize("kind", [Silent, Outspoken])
def test_memory_and_leaves_need_not_go_together(kind: type[ActionMode]) -> None:
    """Where worlds restart one by one, too."""
    scenario = indoor(n_uavs=2, failure_rate=1.0, horizon=9)
    torch.manual_seed(0)
    actions = 2 * torch.rand(3, 2, 16, 3) - 1
    seen: Any = torch.stack(
        simulate(CoLocEnv(scenario, 3, seed=0, action=kind(scenario.believed)), actions), 1
    )
    ends = seen["next", "done"][..., 0]
    assert not torch.equal(ends[0], ends[1])
    for row in range(3):
        stop = int(ends[row].nonzero()[0]) + 1
        for seed, part in ((row, slice(0, stop)), (row + 3, slice(stop, stop + 2))):
            alone = CoLocEnv(scenario, seed=seed, action=kind(scenario.believed))
            again: Any = torch.stack(simulate(alone, actions[row : row + 1, :, part]), 1)[0]
            for key in again.keys(True, True):
                ours, theirs = seen[row, part][key].numpy(), again[key].numpy()
                np.testing.assert_allclose(ours, theirs, atol=1e-5, rtol=1e-5, err_msg=str(key))


def test_another_mode_starts_at_the_seed_that_was_given_last() -> None:
    made = batched(indoor(), "estimate", 2, 5)
    made.set_seed(9)
    again = made.with_action("displacement").reset()
    expected = batched(indoor(), "displacement", 2, 9).reset()
    assert torch.equal(again["state"], expected["state"])
