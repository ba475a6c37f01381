"""Corrections on a base localizer: what they are scaled by, what they see, what they feed back."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.registry import LOCALIZERS, make
from agents.wrappers.correction import Correction, CorrectionMemory, with_base
from coloc_env.envs.displacement import Displacement
from coloc_env.envs.pettingzoo import parallel_env
from coloc_env.envs.sb3 import CoLocVecEnv
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

Step = tuple[dict[str, Tensor], CorrectionMemory, Tensor]
N, WORLDS = 3, 2
BASES = (
    *("dead_reckoning", "ekf", "ekf:robust=huber+temporal", "ekf_joint", "ekf_trust:weights=none"),
    *(
        "pf500:particles=40",
        "apf:particles=60:bounds=40,90",
        "pfnn:weights=none:particles=60:bounds=40,90",
    ),
)
ANCHORED = {"imu": False, "landmarks": 0, "anchors": 6, "uwb": False, "uwb_dropout": 0.3}


def indoor(**overrides: Any) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": N, "horizon": 6, "motion": "random"} | overrides)


def huber_mean(seen: NDArray) -> NDArray:
    """One step from the median, those beyond the median distance at a weight of c over theirs."""
    if not len(seen):
        return np.zeros(seen.shape[-1])
    middle = (len(seen) - 1) // 2
    distance = np.linalg.norm(seen - np.sort(seen, axis=0)[middle], axis=-1)
    typical = np.sort(distance)[middle]
    weight = np.array([1.0 if x <= typical else typical / x for x in distance])
    return np.average(seen, axis=0, weights=weight)


class Flight:
    """A mode at work in worlds of its own, step by step."""

    def __init__(self, scenario: Scenario, base: str = "ekf", feedback: float = 0.0) -> None:
        self.scenario = scenario
        self.mode = Correction(scenario.believed, base, feedback)
        self.world = World(scenario, WORLDS)
        self.observation = self.world.reset(7)
        self.memory = self.mode.reset(self.observation)

    def steps(self, action: Tensor, count: int) -> Iterator[Step]:
        """Leaves, the memory with them, and the estimate, under the same action in every step."""
        for _ in range(count):
            self.memory, leaves = self.mode.observe(self.memory, self.observation)
            before = self.memory
            self.memory, estimate = self.mode.estimate(self.memory, action)
            yield leaves, before, estimate
            self.world.advance(estimate)
            self.observation = self.world.observation()


# ---------------------------------------------------------------- nothing corrected


@pytest.mark.parametrize("base", BASES)
def test_no_correction_is_the_base_itself(base: str) -> None:
    """Estimates, standard deviations and rewards of the localizer alone, over an episode."""
    scenario = indoor(nlos=0.3)
    env = with_base(CoLocEnv(scenario, WORLDS, seed=3), base)
    localizer, world = make(base, scenario), World(scenario, WORLDS)
    now, observation = env.reset(), world.reset(3)
    belief = localizer.reset(observation)
    for _ in range(scenario.horizon):
        belief, estimate = localizer.step(belief, observation)
        action = estimate.action()
        seen = now["uav", "observation"]
        assert torch.equal(seen["base_estimate"], action)
        assert torch.equal(seen["base_std"], action[..., 6:].exp())
        error = now["state"][:, -3 * N :].unflatten(-1, (N, 3))
        expected = action[..., :3].double() - world.truth.position
        torch.testing.assert_close(error.double(), expected, atol=1e-5, rtol=0)
        step = world.step(action)
        now["uav", "action"] = torch.zeros(WORLDS, N, 3)
        now = env.step(now)["next"]
        assert torch.equal(now["uav", "reward"][..., 0], step.reward)
        observation = world.observation()


# ---------------------------------------------------------------- scale


@pytest.mark.parametrize("overrides", [{}, {"false_matches": 0.3}, {"landmark_radius": 5.0}])
def test_an_action_counts_in_what_the_base_may_be_off(overrides: dict[str, Any]) -> None:
    """2 (σ + |Huber mean of the fixes|), at most 1 m; the rest of the estimate is the base's."""
    action = torch.tensor([0.5, -1.0, 0.25]).expand(WORLDS, N, 3)
    short = far = 0
    for leaves, _, estimate in Flight(indoor(**overrides)).steps(action, 5):
        base = leaves["base_estimate"].numpy().astype(np.float64)
        apart = leaves["landmark_fixes"].numpy().astype(np.float64).reshape(WORLDS, N, -1, 3)
        mask = leaves["landmark_fix_mask"].numpy() > 0
        for b, n in np.ndindex(WORLDS, N):
            robust = huber_mean(apart[b, n][mask[b, n]])
            reach = 2 * (np.exp(base[b, n, 6:]) + np.abs(robust))
            short, far = short + (reach < 1).sum(), far + (reach > 1).sum()
            expected = base[b, n, :3] + np.minimum(reach, 1) * action[b, n].numpy()
            np.testing.assert_allclose(estimate[b, n, :3], expected, atol=2e-5)
        assert torch.equal(estimate[..., 3:], leaves["base_estimate"][..., 3:])
    assert short > 0
    assert far > 0 or "false_matches" not in overrides


def test_no_correction_is_larger_than_a_metre() -> None:
    """However unsure the base and however large the action; at σ ≥ ½ m it is exactly one."""
    action = torch.tensor([1.0, -7.0, 3.0]).expand(WORLDS, N, 3)
    flight = Flight(indoor(prior_std=4.0, landmarks=0), "dead_reckoning")
    for leaves, _, estimate in flight.steps(action, 3):
        offset = estimate[..., :3] - leaves["base_estimate"][..., :3]
        expected = torch.tensor([1.0, -1.0, 1.0]).expand_as(offset)
        torch.testing.assert_close(offset, expected, atol=1e-5, rtol=0)
    seen = flight.mode.observe(flight.memory, flight.observation)[1]["last_action"]
    assert seen[0, 0].tolist() == [1.0, -1.0, 1.0]


def test_where_there_are_only_ranges_their_clipped_pull_counts() -> None:
    """The mean over the anchors heard of unit vector × residual, residuals cut at ±2 σ."""
    scenario = indoor(uwb_impulse=0.3, **ANCHORED)
    flight = Flight(scenario)
    sigma = 0.2
    cut = 0
    for leaves, memory, estimate in flight.steps(torch.ones(WORLDS, N, 3), 5):
        seen, base = flight.observation, leaves["base_estimate"].numpy().astype(np.float64)
        anchors = seen["anchor_map"][0, 0].numpy().astype(np.float64).reshape(-1, 3)
        mean = flight.mode.base.mean(memory.belief).numpy()
        for b, n in np.ndindex(WORLDS, N):
            apart = mean[b, n, :3] - anchors
            distance = np.linalg.norm(apart, axis=-1)
            residual = seen["anchor_ranges"][b, n].numpy() - distance
            heard = seen["anchor_range_mask"][b, n].numpy() > 0
            pull = np.zeros((2, 3))
            if heard.any():
                unit = (apart / distance[:, None])[heard]
                short = residual[heard].clip(-2 * sigma, 2 * sigma)
                pull[0] = (unit * residual[heard][:, None]).mean(0)
                pull[1] = (unit * short[:, None]).mean(0)
                cut += (short != residual[heard]).sum()
            np.testing.assert_allclose(leaves["residuals"][b, n, :6], pull.ravel(), atol=1e-4)
            reach = np.minimum(2 * (np.exp(base[b, n, 6:]) + np.abs(pull[1])), 1.0)
            np.testing.assert_allclose(estimate[b, n, :3], base[b, n, :3] + reach, atol=1e-4)
    assert cut > 0
    assert "fix_mean" not in leaves
    assert "attitude" not in leaves


# ---------------------------------------------------------------- leaves


def test_leaves_are_what_they_are_said_to_be() -> None:
    scenario = indoor(false_matches=0.1)
    flight, last = Flight(scenario, feedback=0.0), None
    action = torch.tensor([0.1, 0.2, -0.3]).expand(WORLDS, N, 3)
    dt = scenario.arena.dt
    for leaves, memory, _ in flight.steps(action, 4):
        assert {name: leaf.shape for name, leaf in leaves.items()} == {
            name: (WORLDS, N, leaf.width) for name, leaf in flight.mode.leaves.items()
        }
        attitude = flight.mode.base.mean(memory.belief)[..., 6:10]
        torch.testing.assert_close(leaves["attitude"], attitude.float())
        fixes = leaves["landmark_fixes"].unflatten(-1, (-1, 3)).double().numpy()
        mask = leaves["landmark_fix_mask"].numpy() > 0
        residuals = leaves["residuals"].unflatten(-1, (6, 3)).numpy()
        for b, n in np.ndindex(WORLDS, N):
            seen = fixes[b, n][mask[b, n]]
            np.testing.assert_allclose(leaves["fix_mean"][b, n], seen.mean(0), atol=1e-5)
            median = np.sort(seen, axis=0)[(len(seen) - 1) // 2]
            np.testing.assert_allclose(residuals[b, n, 0], median, atol=1e-5)
            np.testing.assert_allclose(residuals[b, n, 1], huber_mean(seen), atol=1e-5)
            np.testing.assert_allclose(residuals[b, n, 2], seen.std(0), atol=1e-5)
        if last is not None:
            assert torch.equal(leaves["last_action"], action)
            moved = last[..., :3] + dt * last[..., 3:6]
            innovation = leaves["base_estimate"][..., :3] - moved
            np.testing.assert_allclose(residuals[:, :, 5], innovation, atol=1e-6)
        last = leaves["base_estimate"]


def test_without_measurements_only_the_innovation_is_left() -> None:
    scenario = indoor(landmarks=0, uwb=False)
    env = with_base(CoLocEnv(scenario), "dead_reckoning")
    seen = env.rollout(3)["uav", "observation"]
    assert seen["residuals"].shape[-1] == 3
    assert "fix_mean" not in seen.keys()  # noqa: SIM118
    assert env.mode.features == ("base_std", "residuals", "last_action")


@pytest.mark.parametrize("base", ["ekf", "pf500:particles=40", "ekf_joint"])
def test_a_policy_finds_its_features_and_its_settings(base: str) -> None:
    mode = Correction(indoor().believed, base, 0.5)
    assert set(mode.features) <= set(mode.leaves)
    assert mode.settings == {"name": "correction", "base": base, "feedback": 0.5}


# ---------------------------------------------------------------- feedback


@pytest.mark.parametrize("base", ["ekf", "ekf_joint", "pf500:particles=40"])
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_feedback_moves_the_base(base: str, share: float) -> None:
    """By its share of the correction, and by nothing else that it believes."""
    flight = Flight(indoor(), base, share)
    action = torch.tensor([0.5, -1.0, 0.25]).expand(WORLDS, N, 3)
    for leaves, before, estimate in flight.steps(action, 3):
        offset = (estimate - leaves["base_estimate"])[..., :3]
        assert (offset.abs() > 0.01).all()
        localizer, after = flight.mode.base, flight.memory
        mean, moved = localizer.mean(before.belief), localizer.mean(after.belief)
        torch.testing.assert_close(
            (moved - mean)[..., :3].float(), share * offset, atol=2e-5, rtol=0
        )
        torch.testing.assert_close(moved[..., 3:], mean[..., 3:], atol=1e-6, rtol=0)
        if base.startswith("pf"):
            shift = (after.belief.particles - before.belief.particles)[..., :3]
            expected = (share * offset).unsqueeze(-2).expand_as(shift)
            torch.testing.assert_close(shift, expected, atol=2e-5, rtol=0)
            assert torch.equal(after.belief.log_weights, before.belief.log_weights)
            last = (after.belief.last - before.belief.last)[..., :3]
            torch.testing.assert_close(last, share * offset, atol=2e-5, rtol=0)
        else:
            assert torch.equal(after.belief.covariance, before.belief.covariance)


def test_dead_reckoning_keeps_what_it_was_fed() -> None:
    """It is linear in its position: the base is then off by the sum of the corrections' shares."""
    scenario = indoor(landmarks=0, prior_std=4.0)  # σ ≥ ½ m: every unit of action is a metre
    action = torch.tensor([0.5, -1.0, 0.1]).expand(WORLDS, N, 3)
    fed = Flight(scenario, "dead_reckoning", 0.25).steps(action, 5)
    free = Flight(scenario, "dead_reckoning").steps(action, 5)
    for step, ((ours, _, _), (theirs, _, _)) in enumerate(zip(fed, free, strict=True)):
        apart = (ours["base_estimate"] - theirs["base_estimate"])[..., :3]
        torch.testing.assert_close(apart, 0.25 * step * action, atol=1e-4, rtol=0)


@pytest.mark.parametrize("base", ["ekf", "pf500:particles=40"])
def test_without_feedback_the_base_never_knows(base: str) -> None:
    """Where UAVs do not hear each other either: messages carry what was corrected."""
    scenario = indoor(uwb=False)
    wild = Flight(scenario, base).steps(torch.ones(WORLDS, N, 3), 5)
    calm = Flight(scenario, base).steps(torch.zeros(WORLDS, N, 3), 5)
    for (ours, _, corrected), (theirs, _, estimate) in zip(wild, calm, strict=True):
        assert torch.equal(ours["base_estimate"], theirs["base_estimate"])
        assert not torch.equal(corrected, estimate)


@pytest.mark.parametrize("base", ["ekf:robust=huber+temporal", "apf:particles=60:bounds=40,90"])
def test_a_reset_of_some_rows_starts_their_base_alone(base: str) -> None:
    scenario = indoor(n_uavs=2, failure_rate=1.0, horizon=9)
    env, row = with_base(CoLocEnv(scenario, 3, seed=0), base, 0.5), 1
    now, kept, ended = env.reset(), [], []
    for _ in range(14):
        now["uav", "action"] = torch.full((3, 2, 3), 0.5)
        done, now = env.step_and_maybe_reset(now)
        kept.append(done[row])
        ended.append(done["next", "done"][:, 0].tolist())
    ends = [step for step, flags in enumerate(ended) if flags[row]]
    assert any(flags[row] != any(flags) for flags in ended), "others end at other times"
    start, stop = ends[0] + 1, (ends[1] + 1 if len(ends) > 1 else 14)
    alone = with_base(CoLocEnv(scenario, seed=row + 3), base, 0.5)
    now = alone.reset()
    for step in range(start, stop):
        for name, leaf in now["uav", "observation"].items():
            found = kept[step]["uav", "observation", name]
            torch.testing.assert_close(found, leaf[0], atol=1e-4, rtol=1e-4, msg=name)
        now["uav", "action"] = torch.full((1, 2, 3), 0.5)
        now = alone.step(now)["next"]
    assert stop > start + 1


# ---------------------------------------------------------------- faces and wrong use


def test_every_face_takes_a_base() -> None:
    scenario = indoor()
    for env in (
        CoLocEnv(scenario, 2, seed=5),
        parallel_env(scenario, render_mode="rgb_array"),
        CoLocVecEnv(scenario, 2, seed=5, leaves=["imu"], render_mode="rgb_array"),
    ):
        based = with_base(env, "ekf:robust=huber", 0.25)
        assert type(based) is type(env)
        assert based.scenario is scenario
        assert based.mode.settings == {
            "name": "correction",
            "base": "ekf:robust=huber",
            "feedback": 0.25,
        }
        assert env.mode.name == "estimate"
        if not isinstance(env, CoLocEnv):
            assert based.render_mode == "rgb_array"
    flat = with_base(CoLocVecEnv(scenario, 2, seed=5, leaves=["imu"]))
    assert flat.leaves == ("imu",)
    flat.reset()
    assert flat.get_attr("seed") == [5] * N + [6] * N
    batch = with_base(CoLocEnv(scenario, 2, seed=5))
    batch.reset()
    assert batch.world.seeds.tolist() == [5, 6]


class Stateless(Localizer[Observation]):
    """Estimates the prior, and has no state to show."""

    name = "test_stateless"

    def reset(self, observation: Observation) -> Any:
        return make("dead_reckoning", self.believed).reset(observation)

    def step(self, belief: Any, observation: Observation) -> tuple[Any, Estimate]:
        return make("dead_reckoning", self.believed).step(belief, observation)


class Immovable(Stateless):
    """Shows a state that nobody can move."""

    name = "test_immovable"

    def mean(self, belief: Any) -> Tensor:
        return belief.state


@pytest.fixture
def _more_bases() -> Iterator[None]:
    LOCALIZERS.register("test_stateless")(Stateless)
    LOCALIZERS.register("test_immovable")(Immovable)
    yield
    LOCALIZERS.remove("test_stateless")
    LOCALIZERS.remove("test_immovable")


@pytest.mark.parametrize(
    ("base", "feedback", "words"),
    [
        ("efk", 0.0, "unknown agent 'efk' (did you mean 'ekf'?); known: "),
        ("ekf:robst=huber", 0.0, "ekf: unknown option 'robst' (did you mean 'robust'?)"),
        ("ekf:robust=hubr", 0.0, "ekf: robust='hubr' is not allowed: none, or some of huber"),
        ("ekf", 1.5, "feedback=1.5 is not allowed: a share in [0, 1]"),
        ("ekf", -0.1, "feedback=-0.1 is not allowed: a share in [0, 1]"),
        ("ekf", float("nan"), "feedback=nan is not allowed: a share in [0, 1]"),
        (
            "test_stateless",
            0.5,
            "base='test_stateless' with feedback=0.5 is not allowed: it cannot",
        ),
        (
            "test_immovable",
            0.5,
            "base='test_immovable' with feedback=0.5 is not allowed: it cannot",
        ),
        (
            "mappo:weights=none",
            1.0,
            "base='mappo:weights=none' with feedback=1.0 is not allowed: it",
        ),
    ],
)
@pytest.mark.usefixtures("_more_bases")
def test_wrong_bases_are_named(base: str, feedback: float, words: str) -> None:
    scenario = indoor()
    for env in (CoLocEnv(scenario), parallel_env(scenario), CoLocVecEnv(scenario)):
        with pytest.raises(ValueError, match=re.escape(words)) as error:
            with_base(env, base, feedback)
        assert "\n" not in str(error.value)


@pytest.mark.usefixtures("_more_bases")
def test_a_base_that_cannot_be_moved_serves_without_feedback() -> None:
    env = with_base(CoLocEnv(indoor(), seed=0), "test_immovable")
    plain = with_base(CoLocEnv(indoor(), seed=0), "dead_reckoning")
    assert torch.equal(env.rollout(2)["state"][:, 0], plain.rollout(2)["state"][:, 0])


def test_a_base_that_does_not_serve_the_scenario_is_named() -> None:
    with pytest.raises(ValueError, match="ekf: Landmarks are in the body frame"):
        with_base(CoLocEnv(indoor(imu=False, landmarks=4)))


def test_a_mode_made_elsewhere_does_not_fit() -> None:
    mode = Correction(indoor().believed)
    with pytest.raises(ValueError, match="the action mode was made for another scenario"):
        parallel_env(indoor(), action=mode)
    with pytest.raises(ValueError, match="the action mode was made for another scenario"):
        CoLocEnv(indoor(), action=Displacement(indoor().believed))


# ---------------------------------------------------------------- bases without a mean state

BARE = [
    ("swarm-v0", "map", {"n_uavs": 20, "horizon": 8}),
    ("swarm-v0", "stdcl", {"n_uavs": 20, "horizon": 8}),
    ("stein2d-v0", "cspf", {"horizon": 8}),
    ("indoor-v0", "mappo:weights=none", {"n_uavs": 3, "horizon": 8}),
]


@pytest.mark.parametrize(("name", "base", "settings"), BARE)
def test_any_localizer_with_an_estimate_serves_as_a_base(
    name: str, base: str, settings: dict[str, Any]
) -> None:
    """What is corrected is the localizer's own run, by 2 σ an axis, of which a hundredth of a large
    arena is the most."""
    scenario = make_scenario(name, **settings)
    d, n = scenario.arena.dim, scenario.arena.n_uavs
    longest = max(b - a for a, b in zip(scenario.arena.low, scenario.arena.high, strict=True))
    env = with_base(CoLocEnv(scenario, 2, seed=3), base)
    localizer, world = make(base, scenario), World(scenario, 2)
    now, seen = env.reset(), world.reset(3)
    belief, before = localizer.reset(seen), None
    for _ in range(4):
        belief, estimate = localizer.step(belief, seen)
        action = estimate.action()
        leaves = now["uav", "observation"]
        assert not {"attitude", "landmark_fixes", "fix_mean"} & set(leaves.keys())
        torch.testing.assert_close(leaves["base_estimate"], action)
        torch.testing.assert_close(leaves["base_std"], action[..., 2 * d :].exp())
        assert leaves["residuals"].shape[-1] == d
        if before is not None:
            ahead = before[..., :d] + scenario.arena.dt * before[..., d : 2 * d]
            # float32 has steps of 0.0005 m at 5 km
            torch.testing.assert_close(
                leaves["residuals"], action[..., :d] - ahead, atol=2e-3, rtol=0
            )
        before = action
        push = torch.linspace(-1, 1, 2 * n * d).view(2, n, d)
        now["uav", "action"] = push
        now = env.step(now)["next"]
        most = max(1.0, longest / 100)
        scale = (2 * action[..., 2 * d :].exp()).clamp(max=most)
        moved = torch.cat((action[..., :d] + scale * push, action[..., d:]), -1)
        step = world.step(moved)
        torch.testing.assert_close(now["uav", "reward"][..., 0], step.reward)
        seen = world.observation()


@pytest.mark.parametrize(("name", "base", "settings"), BARE)
def test_bases_without_a_state_serve_every_face_and_restart_by_row(
    name: str, base: str, settings: dict[str, Any]
) -> None:
    scenario = make_scenario(name, **settings)
    single, rows = with_base(parallel_env(scenario), base), with_base(CoLocVecEnv(scenario), base)
    observations, _ = single.reset(seed=2)
    assert single.observation_space("uav_0").contains(observations["uav_0"])
    flat = rows.reset()
    assert flat.shape == (scenario.arena.n_uavs, 3 * scenario.arena.dim)
    assert rows.leaves == ("base_std", "residuals", "last_action")
    batch = with_base(CoLocEnv(scenario, 2, seed=2), base)
    now = batch.reset()
    now["uav", "action"] = torch.zeros_like(batch.action_spec.rand()["uav", "action"])
    after = batch.step(now)["next"]
    again = batch._reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
    kept, stayed = again["uav", "observation", "base_estimate"], after["uav", "observation"]
    assert torch.equal(kept[1], stayed["base_estimate"][1])
    fresh = with_base(CoLocEnv(scenario, 1, seed=4), base).reset()
    torch.testing.assert_close(kept[0], fresh["uav", "observation", "base_estimate"][0])
