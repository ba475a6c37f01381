"""``swarm-v0``: the box and its layouts, who is scored, and ranges as the ST-DCL paper has them."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from pettingzoo.test import parallel_api_test, parallel_seed_test
from torchrl.envs import check_env_specs

from coloc_env import noise
from coloc_env.bounds import posterior_bound
from coloc_env.envs.pettingzoo import CoLocParallelEnv, parallel_env
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.motion import Kinematics
from coloc_env.observation import action_bounds, all_leaves
from coloc_env.scenario import REWARDS, InsDriven, Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Ins, PositionFix, RangeNoise, Ranging
from coloc_env.world import World

MOTIONS = ["random", "line", "circle", "helix", "weave"]
TROUBLE: dict[str, Any] = {
    "n_uavs": 10,
    "anchor_share": 0.3,
    "layout": "u",
    "nlos": 0.3,
    "nlos_time": 4.0,
    "nlos_kind": "exponential",
    "uwb_tail": 0.2,
    "link_failure": 0.3,
    "message_loss": 0.1,
    "failure_rate": 0.3,
}


# ---------------------------------------------------------------- as published


def test_the_swarm_is_the_papers() -> None:
    scenario = make_scenario("swarm-v0")
    arena = scenario.arena
    assert (arena.n_uavs, arena.dt, scenario.horizon, scenario.anchor_uavs) == (200, 1.0, 100, 30)
    assert (arena.low, arena.high) == ((0.0, 0.0, 0.0), (10e3, 10e3, 5e3))
    assert scenario.network.radius == 5e3
    assert scenario.prior.position_std == 50.0
    error = RangeNoise(
        10.0, nlos=0.15, nlos_bias=25.0, nlos_kind="constant", tail_std=50.0, impulse_size=500.0
    )
    own = (Ins(0.5, 0.3, 60.0), PositionFix(0.1, 30))
    assert scenario.sensors == (*own, Ranging(error))
    assert scenario.believed.sensors == (*own, Ranging(RangeNoise(std=10.0)))
    assert scenario.believed.process == InsDriven()
    assert scenario.believed.slots == 200
    widths = {name: leaf.width for name, leaf in all_leaves(scenario).items()}
    assert widths == {
        "ins": 3,
        "position_fix": 3,
        "position_fix_mask": 1,
        "ranges": 200,
        "range_mask": 200,
        "links": 200,
        "messages": 1800,
        "message_mask": 200,
        "prior": 15,
    }


def test_without_anchors_nobody_has_a_fix() -> None:
    scenario = make_scenario("swarm-v0", anchor_share=0.0)
    assert scenario.anchor_uavs == 0
    assert "position_fix" not in all_leaves(scenario)


def test_actions_reach_as_far_as_the_swarm_does() -> None:
    low, high = action_bounds(make_scenario("swarm-v0").arena)
    assert low == [-5e3, -5e3, -2.5e3] + [-200.0] * 3 + [-10.0] * 3
    assert high == [15e3, 15e3, 7.5e3] + [200.0] * 3 + [10.0] * 3
    assert action_bounds(make_scenario("indoor-v0").arena)[1][3:6] == [50.0] * 3


def test_ranges_are_biased_on_a_share_of_the_links() -> None:
    world = World(make_scenario("swarm-v0", uwb_std=0.0, n_uavs=100, comm_radius=4e3), 2)
    seen, position = world.reset(0), world.truth.position
    apart = (position.unsqueeze(1) - position.unsqueeze(2)).norm(dim=-1)
    near = (apart <= 4e3) & ~torch.eye(100, dtype=torch.bool)
    assert torch.equal(seen["range_mask"] > 0, near)
    error = (seen["ranges"] - apart)[near]
    late = (error > 12.5).double()
    torch.testing.assert_close(error, 25.0 * late, rtol=0, atol=2e-3)
    links = late.numel() / 2
    assert float(late.mean()) == pytest.approx(0.15, abs=5 * (0.1275 / links) ** 0.5)


@pytest.mark.parametrize("layout", ["random", "u", "o"])
def test_layouts(layout: str) -> None:
    """Nobody in the hole, and the rest filled evenly."""
    world = World(make_scenario("swarm-v0", layout=layout, v_max=100.0, n_uavs=100), 4)
    world.reset(0)
    size = torch.tensor([10e3, 10e3, 5e3], dtype=torch.float64)
    for _ in range(100):
        share = (world.truth.position / size).flatten(0, 1)
        x, y = share[:, 0], share[:, 1]
        assert ((share >= 0) & (share <= 1)).all()
        between, front, back = (x > 0.3) & (x < 0.7), y < 0.3, y > 0.7
        hole = between & ~front & ~(back if layout == "o" else torch.zeros_like(back))
        assert bool(hole.any()) == (layout == "random")
        world.advance(torch.zeros(4, 100, 9))
    open_ = {"random": 1.0, "u": 0.72, "o": 0.84}[layout]
    expected = 0.12 / open_
    for part in (between & front, between & back & (layout != "u")):
        spread = 5 * math.sqrt(expected / 400)
        assert float(part.double().mean()) == pytest.approx(
            expected if part.any() else 0.0, abs=spread
        )


# ---------------------------------------------------------------- motions


def paths(motion: str, seeds: list[int], steps: int = 101, **overrides: Any) -> Kinematics:
    scenario = make_scenario("swarm-v0", motion=motion, **overrides)
    carry = scenario.motion.start(noise.row_keys(torch.tensor(seeds)), scenario.arena)
    each = torch.arange(steps).expand(len(seeds), -1)
    return scenario.motion.advance(carry, each, scenario.arena)[0]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("layout", ["random", "u", "o"])
@pytest.mark.parametrize("v_max", [5.0, 50.0, 100.0])
def test_motions_keep_to_their_layout_and_speed(motion: str, layout: str, v_max: float) -> None:
    truth = paths(motion, [0, 1], 400, layout=layout, v_max=v_max)
    size = torch.tensor([10e3, 10e3, 5e3], dtype=torch.float64)
    share = (truth.position / size).flatten(0, 2)
    assert ((share >= 0) & (share <= 1)).all()
    x, y = share[:, 0], share[:, 1]
    hole = (x > 0.3) & (x < 0.7) & (y > 0.3) & ((y < 0.7) | (layout == "u"))
    assert bool(hole.any()) == (layout == "random")
    speed = truth.velocity.norm(dim=-1)
    assert 0.95 * v_max < speed.max() <= v_max


@pytest.mark.parametrize("v_max", [10.0, 50.0, 80.0])
@pytest.mark.parametrize("motion", ["circle", "helix", "weave"])
def test_turns_are_plausible(motion: str, v_max: float) -> None:
    """At most 15 m/s², of which much is used at high speed; velocities are exact at fine steps."""
    dt = 0.01
    truth = paths(motion, [2], 2001, v_max=v_max, dt=dt)
    middle = (truth.position[:, 2:] - truth.position[:, :-2]) / (2 * dt)
    force = (truth.velocity[:, 2:] - truth.velocity[:, :-2]).norm(dim=-1) / (2 * dt)
    free = truth.velocity.diff(dim=1)[..., 2].abs() < 0.02 * v_max
    free = free[:, 1:] & free[:, :-1]  # a helix is reflected at floor and ceiling
    assert free.double().mean() > 0.99
    assert force[free].max() <= 15.0
    assert force[free].max() > (9.0 if v_max >= 50 else 0.5)
    torch.testing.assert_close(middle[free], truth.velocity[:, 1:-1][free], rtol=0, atol=1e-3)


def test_lines_are_straight() -> None:
    velocity = paths("line", [0, 1]).velocity
    assert torch.equal(velocity.abs(), velocity[:, :1].abs().expand_as(velocity))


def test_a_weave_is_dense_and_the_other_motions_are_not() -> None:
    """A UAV comes within 100 m of most of its group of ten in 100 s, and again and again."""
    met, again, nearest = {}, {}, {}
    for motion in MOTIONS:
        position = paths(motion, [0]).position
        i, j = torch.triu_indices(200, 200, 1)
        apart = (position[:, :, i] - position[:, :, j]).norm(dim=-1)
        close = apart < 100.0
        met[motion] = float(close.any(1).sum() * 2 / 200)  # others met by a UAV
        started = close[:, 1:] & ~close[:, :-1]
        again[motion] = float(started.sum() * 2 / 200)  # encounters of a UAV in 100 s
        far = torch.full((200,), math.inf, dtype=torch.float64).diag()
        nearest[motion] = float((torch.cdist(position, position) + far).amin(-1).median())
    assert met["weave"] > 7.0
    assert again["weave"] > 15.0
    assert nearest["weave"] < 120.0
    for motion in MOTIONS[:-1]:
        assert met[motion] < 0.3
        assert again[motion] < 0.3
        assert nearest[motion] > 500.0


def test_anchor_uavs_are_spread_over_the_groups_of_a_weave() -> None:
    position = paths("weave", [4]).position[0]
    first = position[:, :20].mean(0)  # one UAV of each group of ten
    reach = (position.mean(0).unsqueeze(1) - first).norm(dim=-1).argmin(-1)
    assert torch.equal(reach[:30], torch.arange(30) % 20)


# ---------------------------------------------------------------- anchors


def test_anchor_uavs_know_where_they_are_and_are_not_scored() -> None:
    world = World(make_scenario("swarm-v0", n_uavs=10, anchor_share=0.3), 50)
    seen = world.reset(0)
    mask = seen["position_fix_mask"][..., 0]
    assert torch.equal(mask, (torch.arange(10) < 3).float().expand(50, 10))
    error = (seen["position_fix"] - world.truth.position)[:, :3]
    assert float(error.std()) == pytest.approx(0.1, rel=5 / (2 * 450) ** 0.5)
    assert not seen["position_fix"][:, 3:].any()
    step = world.step(torch.zeros(50, 10, 9))
    assert torch.equal(step.scored, (torch.arange(10) >= 3).expand(50, 10))
    assert not step.error[:, :3].any()
    assert (step.error[:, 3:] > 0).all()
    assert (world.state().unflatten(-1, (10, -1))[..., -1] == step.scored).all()


@pytest.mark.parametrize("reward", REWARDS)
def test_anchor_uavs_earn_nothing_and_their_infos_show_it(reward: str) -> None:
    env = parallel_env("swarm-v0", n_uavs=4, anchor_share=0.5, horizon=3, reward=reward)
    _, infos = env.reset(seed=0)
    assert {info["scored"] for info in infos.values()} == {0.0}
    still = {agent: np.zeros(9, np.float32) for agent in env.agents}
    _, rewards, _, _, infos = env.step(still)
    assert [rewards[a] != 0 for a in env.possible_agents] == [False, False, True, True]
    assert [infos[a]["scored"] for a in env.possible_agents] == [0.0, 0.0, 1.0, 1.0]
    for anchor in env.possible_agents[:2]:
        assert infos[anchor]["error"] == infos[anchor]["episode_rmse"] == 0.0
    if reward == "team":
        scored = [infos[a]["error"] for a in env.possible_agents[2:]]
        assert rewards["uav_2"] == rewards["uav_3"] == pytest.approx(-sum(scored) / 2)


def test_the_bound_is_that_of_those_who_are_scored() -> None:
    bound = posterior_bound(make_scenario("swarm-v0", n_uavs=6, anchor_share=0.5), 2, steps=5)
    assert torch.equal(bound.scored, (torch.arange(6) >= 3).expand(2, 5, 6))
    assert bound.mse[..., :3].max() < 3 * 0.1**2 + 1e-9
    assert bound.mse[..., 3:].min() > 3 * 0.1**2


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"n_uavs": 0}, "n_uavs=0 is not allowed: a whole number from 1 to 10000"),
        ({"dt": 0.0}, "dt=0.0 is not allowed: a number > 0 in s"),
        ({"size": (1e3, 1e3, 0.0)}, "size=.* is not allowed: 3 numbers > 0 in m"),
        ({"size": (1e3, 1e3)}, "size=.* is not allowed: 3 numbers"),
        ({"layout": "w"}, "layout='w' is not allowed: one of random, u, o"),
        ({"motion": "zigzag"}, "motion='zigzag' .*: one of random, line, circle, helix, weave"),
        ({"v_max": 0.0}, "v_max=0.0 is not allowed: a number > 0 in m/s"),
        (
            {"motion": "circle", "v_max": 150.0, "layout": "u"},
            r"v_max=150.0 is not allowed with motion='circle': .* 1500 m .* room for 1499.5 m",
        ),
        (
            {"motion": "weave", "size": (300.0, 150.0, 100.0)},
            "v_max=50.0 is not allowed with motion='weave': .* 177.083 m .* room for 74.5 m",
        ),
        ({"anchor_share": 1.1}, "anchor_share=1.1 is not allowed: a number from 0 to 1"),
        ({"anchor_share": -0.1}, "anchor_share=-0.1 is not allowed: a number from 0 to 1"),
        ({"anchor_share": 0.9, "n_uavs": 3}, "anchor_uavs=3 is not allowed: .* fewer than the 3"),
        ({"anchor_std": -1.0}, "anchor_std=-1.0 is not allowed: a number ≥ 0 in m"),
        ({"nlos_time": 0.0}, "nlos_time=0.0 is not allowed: a number > 0 in s or none"),
        ({"ins_bias": -1.0}, "ins_bias=-1.0 is not allowed: a number ≥ 0 in m/s"),
        ({"ins_bias_time": 0.0}, "ins_bias_time=0.0 is not allowed: a number > 0 in s"),
        ({"link_failure": 1.5}, "link_failure=1.5 is not allowed: a number from 0 to 1"),
        ({"failure_rate": 1.5}, "failure_rate=1.5 is not allowed: a number from 0 to 1"),
        ({"comm_radius": 0.0}, "comm_radius=0.0 is not allowed: a number > 0 in m or none"),
        ({"horizon": 0}, "horizon=0 is not allowed: a whole number ≥ 1"),
        ({"reward": "best"}, "reward='best' is not allowed"),
        ({"anchors": 0.3}, "unknown option 'anchors' .*; known: .*anchor_share, anchor_std"),
    ],
)
def test_wrong_overrides_are_named(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        make_scenario("swarm-v0", **overrides)
    assert str(caught.value).startswith("swarm-v0: ")
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- faces and seeds


def truth(env: CoLocParallelEnv) -> dict[str, np.ndarray]:
    """The true position and velocity, from the privileged state."""
    rows = env.state().reshape(len(env.possible_agents), -1)
    surely = np.full(3, -3.0, np.float32)
    return {a: np.concatenate((rows[env.possible_agents.index(a)][:6], surely)) for a in env.agents}


WOVEN = {**TROUBLE, "motion": "weave"}


@pytest.mark.parametrize(
    "overrides", [{"n_uavs": 5}, TROUBLE, WOVEN], ids=["plain", "trouble", "woven"]
)
def test_both_faces_work(overrides: dict[str, Any]) -> None:
    parallel_api_test(parallel_env("swarm-v0", horizon=12, **overrides), num_cycles=30)
    parallel_seed_test(lambda: parallel_env("swarm-v0", horizon=12, **overrides))
    check_env_specs(CoLocEnv("swarm-v0", num_envs=2, horizon=6, **overrides), seed=3)


def test_the_truth_as_an_action_costs_nothing_over_the_whole_path() -> None:
    env = parallel_env("swarm-v0", n_uavs=8)
    env.reset(seed=1)
    steps = 0
    while env.agents:
        _, rewards, _, _, infos = env.step(truth(env))
        assert set(rewards.values()) == {0.0}
        steps += 1
    assert steps == 100
    assert all(info["episode_max"] == 0 for info in infos.values())


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_row_of_a_batch_is_its_own_world_whatever_the_window(
    motion: str, rows_are_their_own_worlds: Callable[[Scenario, int], None]
) -> None:
    rows_are_their_own_worlds(make_scenario("swarm-v0", motion=motion, **TROUBLE), 90)


def test_rows_that_are_reset_alone_are_worlds_of_their_seeds() -> None:
    """With what lasts over steps (biases, NLOS) drawn again."""
    scenario = make_scenario("swarm-v0", **TROUBLE)
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


def test_a_seed_fixes_the_whole_episode() -> None:
    def episode(seed: int) -> list[Any]:
        env = parallel_env("swarm-v0", **TROUBLE)
        seen, _ = env.reset(seed=seed)
        brought = [seen]
        while env.agents:
            still = dict.fromkeys(env.agents, np.ones(9, np.float32))
            brought.append(env.step(still)[0])
        return brought

    first, again, other = episode(3), episode(3), episode(4)
    assert len(first) == 101
    for a, b in zip(first, again, strict=True):
        assert a.keys() == b.keys()
        for uav in a:
            assert all(np.array_equal(a[uav][leaf], b[uav][leaf]) for leaf in a[uav])
    assert not np.array_equal(first[0]["uav_0"]["ranges"], other[0]["uav_0"]["ranges"])
