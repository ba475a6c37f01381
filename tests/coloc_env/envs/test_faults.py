"""What agents may do to a face: edits in place, nonsense for actions and seeds, no seed at all."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pettingzoo
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from agents.wrappers.correction import with_base
from agents.wrappers.single_uav import single_uav
from coloc_env.envs.pettingzoo import CoLocParallelEnv, env, parallel_env
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

SETTINGS: dict[str, Any] = {"anchors": 4, "n_uavs": 2, "horizon": 7}
STEPS = 7
MODES = ("estimate", "displacement", "correction")
VALUE = 7.7e7  # what a vandal writes


def equal(one: Any, other: Any) -> bool:
    """Whether nested dictionaries of arrays are the same."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[k], other[k]) for k in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(equal, one, other))
    return bool(np.array_equal(one, other))


def copied(x: Any) -> Any:
    if isinstance(x, dict):
        return {key: copied(value) for key, value in x.items()}
    if isinstance(x, tuple | list):
        return [copied(value) for value in x]
    return np.array(x)


def vandalize(x: Any) -> None:
    """Write into every array that can be written to, and empty every dictionary of numbers."""
    if isinstance(x, dict):
        for key, value in x.items():
            vandalize(value)
            if not isinstance(value, dict | np.ndarray):
                x[key] = VALUE
    elif isinstance(x, tuple | list):
        for value in x:
            vandalize(value)
    elif isinstance(x, np.ndarray) and x.flags.writeable:
        x[...] = VALUE


def single(mode: str, **settings: Any) -> CoLocParallelEnv:
    made = parallel_env(**{**SETTINGS, **settings})
    return with_base(made) if mode == "correction" else made.with_action(mode)


def many(mode: str, **settings: Any) -> CoLocEnv:
    made = CoLocEnv(num_envs=3, seed=4, **{**SETTINGS, **settings})
    return with_base(made) if mode == "correction" else made.with_action(mode)


# ---------------------------------------------------------------- edits in place


@pytest.mark.parametrize("n_uavs", [1, 2])
@pytest.mark.parametrize("mode", MODES)
def test_edits_in_place_reach_nobody_on_the_parallel_face(mode: str, n_uavs: int) -> None:
    def episode(harm: Callable[[Any], None]) -> list[Any]:
        made = single(mode, n_uavs=n_uavs, failure_rate=0.5)
        found = []
        for _ in range(2):
            made.reset(seed=3)
            now: Any = made.reset(seed=5)
            while True:
                found.append(copied((list(now), made.state())))
                harm((list(now), made.state()))
                if not made.agents:
                    break
                width = made.action_space("uav_0").shape
                now = made.step({agent: np.full(width, 0.5, np.float32) for agent in made.agents})
        return found

    assert equal(episode(vandalize), episode(lambda _: None))


def test_edits_of_one_agent_in_place_do_not_reach_another_nor_itself_later() -> None:
    made = parallel_env(**SETTINGS)
    observations, _ = made.reset(seed=0)
    before = copied(observations["uav_1"])
    vandalize(observations["uav_0"])
    assert equal(observations["uav_1"], before)
    cycle = env(**SETTINGS)
    cycle.reset(seed=0)
    own = copied(cycle.observe("uav_0"))
    vandalize(cycle.observe("uav_0"))
    assert equal(cycle.observe("uav_0"), own)


def test_a_picture_does_not_show_what_agents_did_to_their_observations() -> None:
    made = parallel_env(render_mode="rgb_array", **SETTINGS)
    observations, _ = made.reset(seed=0)
    clean = made.render()
    vandalize(observations)
    assert np.array_equal(made.render(), clean)


@pytest.mark.parametrize("mode", MODES)
def test_edits_in_place_reach_nothing_on_the_torchrl_face(mode: str) -> None:
    """Every entry of every tensordict; worlds restart one by one, in the middle of a window too."""

    def entries(now: TensorDictBase, harm: bool) -> dict[Any, torch.Tensor]:
        found = {key: now[key].clone() for key in now.keys(True, True)}
        for key in found if harm else ():
            now[key].fill_(VALUE if now[key].is_floating_point() else True)
        return found

    def rollout(harm: bool) -> list[dict[Any, torch.Tensor]]:
        made = many(mode, failure_rate=0.5)
        now = made.reset()
        found = [entries(now, harm)]
        for step in range(2 * STEPS):
            now = TensorDict({"uav": {"action": torch.full((3, 2, made.mode.width), 0.5)}}, [3])
            found.append(entries(made.step(now)["next"], harm))
            over = found[-1]["done"]
            if step == 2:
                over = torch.tensor([[False], [True], [False]])
            if bool(over.any()):
                found.append(entries(made._reset(TensorDict({"_reset": over}, [3])), harm))
        return found

    clean = rollout(False)
    assert len(clean) > 2 * STEPS + 2, "some worlds restart alone"
    for mine, theirs in zip(rollout(True), clean, strict=True):
        assert mine.keys() == theirs.keys()
        for key in mine:
            assert torch.equal(mine[key], theirs[key]), key


@pytest.mark.parametrize("mode", MODES)
def test_edits_in_place_reach_nothing_on_the_flat_faces(mode: str) -> None:
    def vectors(harm: Callable[[Any], None]) -> list[Any]:
        made: Any = CoLocVecEnv(num_worlds=2, seed=4, **SETTINGS)
        made = with_base(made) if mode == "correction" else made.with_action(mode)
        now = [made.reset()]
        found = []
        for _ in range(STEPS + 2):
            state = made.env_method("state")
            found.append(copied((now, state)))
            harm((now, state))
            now = [*made.step(np.full((made.num_envs, *made.action_space.shape), 0.5))[:2]]
        return found

    def alone(harm: Callable[[Any], None]) -> list[Any]:
        made = single_uav(base="ekf" if mode == "correction" else "none", **SETTINGS)
        now: Any = made.reset(seed=4)
        found = []
        for _ in range(STEPS):
            found.append(copied(now))
            harm(now)
            now = list(made.step(np.full(made.action_space.shape, 0.5)))
        return found

    assert equal(vectors(vandalize), vectors(lambda _: None))
    assert equal(alone(vandalize), alone(lambda _: None))


def test_edits_in_place_do_not_reach_the_world_s_later_steps() -> None:
    scenario = make_scenario("indoor-v0", **SETTINGS)

    def steps(harm: bool) -> list[torch.Tensor]:
        world = World(scenario, 2)
        found, now = [], world.reset(0)
        for step in range(STEPS):
            found.append(torch.cat((*now.leaves.values(), world.truth.position), -1))
            for leaf in now.leaves.values() if harm else ():
                leaf.fill_(VALUE)
            if step == 3:
                now = world.reset([9, 9], torch.tensor([True, False]))
                found.append(torch.cat(tuple(now.leaves.values()), -1))
                for leaf in now.leaves.values() if harm else ():
                    leaf.fill_(VALUE)
            world.advance(torch.zeros(2, 2, 9))
            now = world.observation()
        return found

    for mine, theirs in zip(steps(True), steps(False), strict=True):
        assert torch.equal(mine, theirs)


# ---------------------------------------------------------------- nonsense


def refused(words: str) -> Any:
    return pytest.raises(ValueError, match="^" + re.escape(words) + ".*$")


BAD_ACTIONS = {
    "complex": (np.zeros(9, complex), "is not made of real numbers"),
    "words": ("nine", "is not made of real numbers"),
    "nothing": (None, "is not made of real numbers"),
    "ragged": ([[0.0], [0.0, 1.0]], "is not made of real numbers"),
    "numerals": (["1"] * 9, "is not made of real numbers"),
    "NaN": (np.full(9, np.nan), "holds NaN or infinity"),
    "infinity": (np.full(9, np.inf), "holds NaN or infinity"),
    "beyond float32": (np.full(9, 1e300), "holds NaN or infinity"),
    "short": (np.zeros(8), "has shape (8,)"),
    "deep": (np.zeros((1, 9)), "has shape (1, 9)"),
    "scalar": (0.5, "has shape ()"),
}


@pytest.mark.parametrize("kind", BAD_ACTIONS)
def test_an_action_that_does_not_fit_is_named(kind: str) -> None:
    wrong, words = BAD_ACTIONS[kind]
    needed = "; (9,) finite numbers are needed with action=estimate: [position, velocity, log-std]"
    made = parallel_env(**SETTINGS)
    made.reset(seed=0)
    good = np.zeros(9, np.float32)
    before = made.state()
    with refused(f"indoor-v0: the action of uav_1 {words}{needed}"):
        made.step({"uav_0": good, "uav_1": wrong})
    assert np.array_equal(made.state(), before), "the world is where it was"
    made.step({"uav_0": good, "uav_1": [0] * 9})


def test_actions_of_a_wrong_type_are_named_on_the_torchrl_face() -> None:
    made = many("displacement")
    now = made.reset()
    now["uav", "action"] = torch.zeros(3, 2, 3, dtype=torch.complex64)
    with refused("indoor-v0: complex actions do not fit; (3,) finite numbers are needed"):
        made._step(now)
    made, other = many("estimate"), many("estimate")
    now, then = made.reset(), other.reset()
    now["uav", "action"] = torch.zeros(3, 2, 9, dtype=torch.float64)
    then["uav", "action"] = torch.zeros(3, 2, 9)
    doubled, plain = made._step(now), other._step(then)
    for key in plain.keys(True, True):
        assert doubled[key].dtype == plain[key].dtype, key
        assert torch.equal(doubled[key], plain[key]), key


BAD_SEEDS = (-1, 1.9, 2.0, True, 2**62, "7", float("nan"), 1j)


@pytest.mark.parametrize("seed", BAD_SEEDS)
def test_what_is_no_seed_is_named_at_every_face(seed: Any) -> None:
    words = f"seed={seed!r} is not allowed: a whole number from 0 to 2^62"
    named = refused(f"indoor-v0: {words}")
    with named:
        parallel_env(**SETTINGS).reset(seed=seed)
    with named:
        env(**SETTINGS).reset(seed=seed)
    with named:
        single_uav(**SETTINGS).reset(seed=seed)
    with named:
        CoLocVecEnv(seed=seed, **SETTINGS)
    with named:
        CoLocVecEnv(**SETTINGS).seed(seed)
    with named:
        CoLocEnv(seed=seed, **SETTINGS)
    with named:
        CoLocEnv(**SETTINGS)._set_seed(seed)
    world = World(make_scenario("indoor-v0", **SETTINGS), 2)
    for seeds in (seed, [seed, 0], [0, seed]) if seed != "7" else ([seed, 0], [0, seed]):
        with refused(f"World: {words}"):
            world.reset(seeds)


def test_tensors_of_seeds_are_looked_at_too() -> None:
    world = World(make_scenario("indoor-v0", **SETTINGS), 2)
    with refused("World: seed=-3 is not allowed: a whole number from 0 to 2^62"):
        world.reset(torch.tensor([0, -3]))
    for dtype in (torch.float64, torch.bool, torch.complex64):
        with refused("World: seed"):
            world.reset(torch.zeros(2, dtype=dtype))
    with refused("World: 2 seeds are needed, one a row, got (3,) of them"):
        world.reset(torch.arange(3))
    assert torch.equal(world.reset(np.array([5, 6]))["prior"], world.reset(5)["prior"])


# ---------------------------------------------------------------- no seed at all


def test_without_a_seed_worlds_are_random_and_the_seed_is_reported() -> None:
    """And the world can be had again by it."""
    seeds = set()
    for _ in range(2):
        batch = CoLocEnv(num_envs=2, **SETTINGS)
        first = batch.reset()
        seeds.add(batch.first_seed)
        assert batch.world.seeds.tolist() == [batch.first_seed, batch.first_seed + 1]
        again = CoLocEnv(num_envs=2, seed=batch.first_seed, **SETTINGS).reset()
        assert bool((first == again).all())

        vectors = CoLocVecEnv(num_worlds=2, **SETTINGS)
        rows = vectors.reset()
        seeds.add(vectors.first_seed)
        found = [info["seed"] for info in vectors.reset_infos]
        assert found == [vectors.first_seed] * 2 + [vectors.first_seed + 1] * 2
        same = CoLocVecEnv(num_worlds=2, seed=vectors.first_seed, **SETTINGS).reset()
        assert np.array_equal(rows, same)

        one = parallel_env(**SETTINGS)
        observations, infos = one.reset()
        seeds.add(one.seed)
        assert {info["seed"] for info in infos.values()} == {one.seed}
        assert equal(parallel_env(**SETTINGS).reset(seed=one.seed)[0], observations)

        alone = single_uav(**SETTINGS)
        seen, info = alone.reset()
        seeds.add(info["seed"])
        assert np.array_equal(single_uav(**SETTINGS).reset(seed=info["seed"])[0], seen)
    assert len(seeds) == 8


def test_seeds_go_on_from_episode_to_episode_and_are_reported() -> None:
    vectors = CoLocVecEnv(num_worlds=2, seed=10, **SETTINGS)
    vectors.reset()
    for _ in range(STEPS):
        vectors.step(np.zeros((4, 9), np.float32))
    assert [info["seed"] for info in vectors.reset_infos] == [12, 12, 13, 13]
    one = parallel_env(**SETTINGS)
    one.reset(seed=10)
    assert {info["seed"] for info in one.reset()[1].values()} == {11}


def test_a_rows_view_has_no_seed_of_its_own() -> None:
    whole = CoLocEnv(num_envs=2, **SETTINGS)
    rows = PerUavEnv(whole)
    rows.set_seed(9)
    rows.reset()
    assert whole.world.seeds.tolist() == [9, 10]


def test_pettingzoo_makes_an_environment_by_name() -> None:
    made = pettingzoo.make("parallel", "coloc/indoor-v0", n_uavs=2)
    assert made.reset(seed=3)[1]["uav_0"]["seed"] == 3


# ---------------------------------------------------------------- NaN of those who do not count


@pytest.mark.parametrize("kind", ["error", "squared", "team", "log_score"])
def test_what_is_not_scored_earns_nothing_whatever_it_is(kind: str) -> None:
    """A failed UAV's NaN, infinity or overflow is not 0 times something."""
    scenario = make_scenario("indoor-v0", reward=kind, n_uavs=3, horizon=40, failure_rate=1.0)
    for bad in (torch.nan, torch.inf, -torch.inf, 1e38):
        world, plain = World(scenario, 4), World(scenario, 4)
        world.reset(0)
        plain.reset(0)
        dead = 0
        for _ in range(39):
            zero = torch.zeros(4, 3, 9)
            wild = zero.masked_fill(~world.now.scored.unsqueeze(-1), bad)
            one, other = world.step(wild), plain.step(zero)
            assert torch.equal(one.reward, other.reward)
            assert torch.equal(one.error, other.error)
            assert not bool(one.reward[~one.scored].any())
            dead += int((~one.scored).sum())
        assert dead > 20
