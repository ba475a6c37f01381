"""Hybrid filters: never or always restarted, from what, and that each row goes its own way."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torchrl.envs import InitTracker, TransformedEnv

from agents import Localizer, make
from agents.particle.failure import FailureDetector
from agents.particle.hybrid import HybridFilter
from agents.policies.adapters import LocalizerPolicy, ParallelPolicy
from agents.weights import untrained
from coloc_env.envs.pettingzoo import CoLocParallelEnv
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

NEVER, ALWAYS = "nnhpff:bank=false:weights=none:threshold=1", "hpff:bank=false:quantile=1e-12"
MAINS = ("pf@particles=60", "apf@particles=40@bounds=30,60", "pfnn@weights=none", "ekf")


def wsn(**overrides: Any) -> Scenario:
    return make_scenario("wsn-v0", **{"n_uavs": 2} | overrides)


def room(**overrides: Any) -> Scenario:
    few: dict[str, Any] = {"n_uavs": 2, "anchors": 4, "landmarks": 6, "landmark_radius": 40.0}
    return make_scenario("indoor-v0", **few | overrides)


SCENES = {"wsn": wsn, "room": room}


def hybrid(name: str, scenario: Scenario) -> Any:
    made = make(name, scenario)
    assert isinstance(made, HybridFilter)
    return made


def judge() -> FailureDetector:
    """A network that is neither always nor never of the opinion that a filter has failed."""
    network = untrained(FailureDetector, 1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.mul_(4.0)
    return network


def resets(localizer: Localizer, run: Any) -> Tensor:
    """[K, B, N]"""
    found = [localizer.diagnostics(belief)["resets_per_run"] for belief in run.beliefs[1:]]
    return torch.stack(found)


# ---------------------------------------------------------------- never and always


@pytest.mark.parametrize("main", MAINS)
@pytest.mark.parametrize("scene", SCENES)
def test_without_resets_it_is_the_main_filter(
    scene: str, main: str, tools: SimpleNamespace
) -> None:
    scenario = SCENES[scene]()
    one, alone = make(f"{NEVER}:main={main}", scenario), make(main.replace("@", ":"), scenario)
    ours, theirs = (tools.play(localizer, scenario, [0, 1], 8) for localizer in (one, alone))
    for k in range(8):
        tools.assert_same(ours.estimates[k], theirs.estimates[k])
        tools.assert_same(ours.beliefs[k + 1].main, theirs.beliefs[k + 1])
    assert not resets(one, ours).any()
    assert torch.equal(one.mean(ours.beliefs[-1]), alone.mean(theirs.beliefs[-1]))


@pytest.mark.parametrize("main", MAINS)
@pytest.mark.parametrize("scene", SCENES)
def test_with_a_reset_at_every_step_it_says_what_the_auxiliary_says(
    scene: str, main: str, tools: SimpleNamespace
) -> None:
    scenario = SCENES[scene]()
    one, alone = make(f"{ALWAYS}:main={main}", scenario), make("emvf", scenario)
    run = tools.play(one, scenario, [0, 1], 6)
    expected = tools.replay(alone, run.observations)
    assert resets(one, run).all()
    for ours, theirs in zip(run.estimates, expected.estimates, strict=True):
        assert torch.equal(ours.position, theirs.position.to(ours.position))
        assert torch.equal(ours.velocity, theirs.velocity.to(ours.velocity))
        assert torch.equal(ours.covariance, theirs.covariance)
    tools.assert_same(run.beliefs[-1].auxiliary, expected.beliefs[-1])
    # The main filter goes on from there.
    away = one.mean(run.beliefs[-1])[..., : scenario.arena.dim] - run.estimates[-1].position
    spread = run.estimates[-1].covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert (away.abs() < 5 * spread / 30**0.5 + 1e-6).all()


def test_any_auxiliary_that_knows_a_gaussian_will_do(tools: SimpleNamespace) -> None:
    scenario = wsn()
    one = make(f"{ALWAYS}:main=pf@particles=50:auxiliary=ekf@iterations=3", scenario)
    run = tools.play(one, scenario, [0, 1], 6)
    expected = tools.replay(make("ekf:iterations=3", scenario), run.observations)
    restarted = resets(one, run) > 0
    assert restarted[1:].all()
    position = expected.position.to(run.position)
    assert torch.equal(run.position[restarted], position[restarted])


# ---------------------------------------------------------------- restarting


def gaussian(localizer: Any, seed: int = 0) -> tuple[Tensor, Tensor]:
    """States [2, 2, S] and covariances, correlated, of what a filter may be restarted from."""
    process, g = localizer.process, torch.Generator().manual_seed(seed)
    e = process.error_size
    state = torch.randn(2, 2, process.state_size, generator=g, dtype=torch.float64)
    if process.attitude_size == 4:
        state[..., 6:10] = torch.nn.functional.normalize(state[..., 6:10], dim=-1)
    root = 0.1 * torch.randn(2, 2, e, e, generator=g, dtype=torch.float64)
    return state, root @ root.mT + 1e-4 * torch.eye(e)


@pytest.mark.parametrize("scene", ["wsn", "room"])
def test_particles_begin_anew_with_the_mean_and_covariance_given(
    scene: str, tools: SimpleNamespace
) -> None:
    count = 20_000
    scenario = SCENES[scene]()
    localizer: Any = make(f"pf:particles={count}", scenario)
    belief = tools.play(localizer, scenario, [0, 1], 1).beliefs[-1]
    state, covariance = gaussian(localizer)
    found = localizer.restart_from(belief, torch.ones(2, 2, dtype=torch.bool), state, covariance)
    centre = state.float().unsqueeze(2)
    error = localizer.process.boxminus(found.particles, centre).double()
    std = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((error.mean(2) / std).abs() < 5 / count**0.5).all()
    sampled = error.mT @ error / count
    scaled = (sampled - covariance) / (std.unsqueeze(-1) * std.unsqueeze(-2))
    assert (scaled.abs() < 5 * (2 / count) ** 0.5).all()
    assert (found.log_weights == found.log_weights[..., :1]).all()
    torch.testing.assert_close(
        found.log_weights.logsumexp(-1), torch.zeros(2, 2), rtol=0, atol=1e-4
    )
    assert len(found.particles[..., 0].unique()) > 0.9 * 4 * count
    assert torch.equal(found.last, state[..., : 2 * scenario.arena.dim].float())


def test_draws_differ_from_step_to_step_and_uav_to_uav(tools: SimpleNamespace) -> None:
    scenario = wsn()
    localizer: Any = make("pf:particles=50", scenario)
    run = tools.play(localizer, scenario, [0, 1], 2)
    state, covariance = gaussian(localizer)
    state, covariance = (x[:1, :1].expand(2, 2, *x.shape[2:]) for x in (state, covariance))
    rows = torch.ones(2, 2, dtype=torch.bool)
    clouds = [
        localizer.restart_from(belief, rows, state, covariance).particles.flatten(0, 1)
        for belief in run.beliefs[1:]
    ]
    every = torch.cat(clouds)[..., 0]
    assert len(every.unique()) == every.numel()


@pytest.mark.parametrize("name", ["pf:particles=50", "apf", "pfnn:weights=none", "ekf"])
def test_other_uavs_are_not_touched(name: str, tools: SimpleNamespace) -> None:
    """Bit for bit; and what is touched does not depend on them."""
    scenario = room()
    localizer: Any = make(name, scenario)
    belief = tools.play(localizer, scenario, [0, 1], 6).beliefs[-1]
    kept = belief.clone()
    rows = torch.tensor([[True, False], [False, False]])
    state, covariance = gaussian(localizer)
    found = localizer.restart_from(belief, rows, state, covariance)
    tools.assert_same(belief, kept)
    for b, i in ((0, 1), (1, 0), (1, 1)):
        tools.assert_same(found[b : b + 1, i : i + 1], belief[b : b + 1, i : i + 1])
    every = localizer.restart_from(belief, torch.ones_like(rows), state, covariance)
    tools.assert_same(found[:1, :1], every[:1, :1])
    mean = localizer.mean(found)[0, 0] - localizer.mean(belief)[0, 0]
    assert mean[:3].abs().max() > 0.1


def test_adaptive_filters_begin_with_their_first_count(tools: SimpleNamespace) -> None:
    scenario = room()
    localizer: Any = make("apf:particles=120:bounds=50,400", scenario)
    belief = tools.play(localizer, scenario, [0, 1], 12).beliefs[-1]
    assert (belief.count != 120).all()
    rows = torch.tensor([[True, False], [False, True]])
    state, covariance = gaussian(localizer)
    found = localizer.restart_from(belief, rows, state, covariance)
    assert (found.count[rows] == 120).all()
    assert torch.equal(found.count[~rows], belief.count[~rows])
    slot = torch.arange(found.log_weights.shape[-1])
    dead = found.log_weights[rows] == -torch.inf
    assert torch.equal(dead, (slot >= 120).expand_as(dead))
    buried = found.particles[rows][:, 120:]
    assert torch.equal(buried, state.float()[rows].unsqueeze(1).expand_as(buried))


# ---------------------------------------------------------------- when it restarts


def heard_from(observation: Observation, anchors: list[int], change: Any) -> Observation:
    mask = observation["anchor_range_mask"]
    kept = torch.zeros(mask.shape[-1])
    kept[anchors] = 1.0
    return change(observation, anchor_range_mask=mask * kept)


@pytest.mark.parametrize("anchors", [[], [2]], ids=["silence", "one anchor"])
def test_an_auxiliary_that_knows_nothing_restarts_nothing(
    anchors: list[int], tools: SimpleNamespace
) -> None:
    """Even though the main filter is said to have failed, if there is a range to say so."""
    scenario = wsn()
    one, alone = make(f"{ALWAYS}:main=pf@particles=60", scenario), make("pf:particles=60", scenario)
    seen = [
        heard_from(o, anchors, tools.change)
        for o in tools.play(alone, scenario, [0, 1], 6).observations
    ]
    ours, theirs = tools.replay(one, seen), tools.replay(alone, seen)
    for k in range(6):
        tools.assert_same(ours.estimates[k], theirs.estimates[k])
        tools.assert_same(ours.beliefs[k + 1].main, theirs.beliefs[k + 1])
    failed = torch.stack([belief.probability for belief in ours.beliefs[1:]])
    assert (failed == float(bool(anchors))).all()
    assert not resets(one, ours).any()


def test_a_threshold_is_a_probability_that_must_be_exceeded(tools: SimpleNamespace) -> None:
    """Resets are those of the network's probabilities, whatever these are."""
    scenario = wsn()
    localizer = hybrid("nnhpff:bank=false:weights=none:main=pf@particles=60", scenario)
    localizer.learn(judge())
    run = tools.play(localizer, scenario, range(4), 20)
    found = torch.stack([belief.probability for belief in run.beliefs[1:]])
    assert found.min() < 0.4
    assert found.max() > 0.6
    assert torch.equal(resets(localizer, run) > 0, found > 0.5)


def errors(name: str, scenario: Scenario) -> Tensor:
    """Errors in m [K, B] of the first robot in ten worlds."""
    localizer, world = make(name, scenario), World(scenario, 10)
    observation, found = world.reset(0), []
    belief = localizer.reset(observation)
    for _ in range(60):
        belief, estimate = localizer.step(belief, observation)
        found.append((estimate.position - world.truth.position).norm(dim=-1)[:, 0])
        world.advance(estimate.action())
        observation = world.observation()
    return torch.stack(found)


def test_a_kidnapped_robot_is_found_again() -> None:
    """By the hybrid filter within a window, and not by its main filter alone."""
    hybrids, alone = (
        errors(name, wsn(n_uavs=1, kidnap_at=3.0))
        for name in ("hpff:bank=false:main=pf@particles=500", "pf:particles=500")
    )
    assert hybrids[5:30].max() < 0.6
    assert hybrids[32:].max() < 0.6
    assert alone[32:42].min() > 2


# ---------------------------------------------------------------- rows


MIXED = (
    "hpff:bank=false:quantile=0.8:main=pf@particles=60",
    "nnhpff:bank=false:weights=none:main=apf@particles=40@bounds=30,60",
)


@pytest.mark.parametrize("name", MIXED)
def test_a_row_of_a_batch_is_its_own_run(name: str, tools: SimpleNamespace) -> None:
    """Also where only other rows are restarted."""
    scenario = wsn(uwb_dropout=0.2)
    localizer = hybrid(name, scenario)
    if name.startswith("nn"):
        localizer.learn(judge())
    many = tools.play(localizer, scenario, range(5), 12)
    some = resets(localizer, many).flatten(1).mean(1)
    assert ((some > 0) & (some < 1)).sum() > 5
    for seed in (0, 2, 4):
        alone = tools.play(localizer, scenario, [seed], 12)
        for one, whole in zip(alone.estimates, many.estimates, strict=True):
            tools.assert_same(one, whole[seed : seed + 1])
        tools.assert_same(alone.beliefs[-1], many.beliefs[-1][seed : seed + 1])


@pytest.mark.parametrize("name", MIXED)
def test_a_step_changes_nothing_it_is_given(name: str, tools: SimpleNamespace) -> None:
    scenario = wsn(case=2)
    localizer = make(name, scenario)
    run = tools.play(localizer, scenario, range(5), 4)
    for k in range(4):
        belief, kept = run.beliefs[k], run.beliefs[k].clone()
        leaves = {name: leaf.clone() for name, leaf in run.observations[k].leaves.items()}
        after, estimate = localizer.step(belief, run.observations[k])
        tools.assert_same(belief, kept)
        assert all(torch.equal(run.observations[k][name], leaf) for name, leaf in leaves.items())
        tools.assert_same(after, run.beliefs[k + 1])
        tools.assert_same(estimate, run.estimates[k])


# ---------------------------------------------------------------- as a localizer


def test_what_it_is_made_of_can_be_seen(tools: SimpleNamespace) -> None:
    scenario = room()
    localizer = hybrid("hpff:bank=false:main=apf@particles=40@bounds=30,60", scenario)
    belief = tools.play(localizer, scenario, [0, 1], 3).beliefs[-1]
    figures = localizer.diagnostics(belief)
    parts = {"particles", "ess_share", "renewed", "bytes", "mahalanobis", "residual_rms", "failure"}
    assert set(figures) == {*parts, "resets_per_run"}
    assert torch.equal(figures["particles"], localizer.main.diagnostics(belief.main)["particles"])
    assert torch.equal(figures["mahalanobis"], belief.distance)
    assert not localizer.exchanges
    assert hybrid("hpff:bank=false:main=ekf@robust=cross", scenario).exchanges
    assert hybrid("hpff:bank=false:auxiliary=ekf@robust=cross", scenario).exchanges


@pytest.mark.parametrize("main", MAINS)
def test_it_can_be_corrected_from_outside(main: str, tools: SimpleNamespace) -> None:
    scenario = room()
    localizer = make(f"hpff:bank=false:main={main}", scenario)
    belief = tools.play(localizer, scenario, [0, 1], 3).beliefs[-1]
    offset = torch.tensor([1.0, -2.0, 0.5]).expand(2, 2, 3)
    moved = localizer.shifted(belief, offset)
    apart = localizer.mean(moved) - localizer.mean(belief)
    torch.testing.assert_close(apart[..., :3].float(), offset, rtol=0, atol=1e-4)
    tools.assert_same(moved.auxiliary, belief.auxiliary)


def test_the_mahalanobis_distance_is_that_of_the_main_filters_estimate(
    tools: SimpleNamespace,
) -> None:
    """Before it is restarted."""
    scenario = wsn(uwb_dropout=0.3)
    one, alone = make(f"{ALWAYS}:main=ekf", scenario), make("ekf", scenario)
    run = tools.play(one, scenario, [0, 1], 5)
    for k, seen in enumerate(run.observations):
        _, estimate = alone.step(run.beliefs[k].main, seen)
        places = seen["anchor_map"].unflatten(-1, (4, 2)).double()
        expected = (estimate.position.unsqueeze(-2) - places).norm(dim=-1)
        r = (seen["anchor_ranges"] - expected) * seen["anchor_range_mask"]
        distance = (r**2).sum(-1) / 0.04
        torch.testing.assert_close(
            run.beliefs[k + 1].distance.double(), distance, rtol=1e-4, atol=1e-4
        )


# ---------------------------------------------------------------- faces


@pytest.mark.parametrize("carry", ["module", "tensordict"])
@pytest.mark.parametrize(
    "name", ["hpff:bank=false:quantile=0.8:main=pf@particles=60", "hpff:bank=false:main=ekf"]
)
def test_both_faces_act_alike(name: str, carry: str) -> None:
    scenario, seeds, steps = wsn(case=2, horizon=10), (4, 5), 10
    localizer = make(name, scenario)
    policy = LocalizerPolicy(localizer, scenario, carry)
    env = TransformedEnv(CoLocEnv(scenario, len(seeds), seed=seeds[0]), InitTracker())
    env.append_transform(policy.make_tensordict_primer())
    rollout = env.rollout(steps, policy)
    assert rollout.shape == (2, steps)
    for row, seed in enumerate(seeds):
        alone, world = ParallelPolicy(localizer), CoLocParallelEnv(scenario)
        observations, _ = world.reset(seed)
        for step in range(steps):
            actions = alone({agent: observations[agent] for agent in world.agents})
            for i, action in enumerate(actions.values()):
                found = rollout["uav", "action"][row, step, i].numpy()
                np.testing.assert_array_equal(found, action)
            observations, *_ = world.step(actions)


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("hpff:bank=false:main=emvf", "main='emvf' is not allowed: a particle or Kalman filter"),
        ("hpff:bank=false:main=hpff", "main='hpff' is not allowed: a particle or Kalman filter"),
        ("hpff:bank=false:main=ekf_joint", "main='ekf_joint' is not allowed"),
        ("hpff:bank=false:auxiliary=pf", "auxiliary='pf' is not allowed: emvf or a Kalman filter"),
        ("hpff:bank=false:auxiliary=hpff", "auxiliary='hpff' is not allowed"),
        ("hpff:bank=false:main=pff", "unknown agent 'pff'.*did you mean 'hpff'.*, pf, "),
        (
            "hpff:bank=false:main=pf@particle=200",
            "pf: unknown option 'particle'.*did you mean 'particles'",
        ),
        ("hpff:bank=false:main=pf@particles=5", "pf: particles='5' is not allowed"),
        ("hpff:bank=false:auxiliary=emvf@memory=1", "emvf: memory='1' is not allowed"),
        ("hpff:quantile=1", "quantile='1' is not allowed: a number > 0 and < 1"),
        ("hpff:threshold=0.5", "unknown option 'threshold'"),
        ("nnhpff:weights=none:threshold=1.5", "threshold='1.5' is not allowed: a number from"),
        ("nnhpff:weights=none:threshold=-1", "threshold='-1' is not allowed: a number from"),
        ("nnhpff:weights=pfnn", "holds weights of kind 'pfnn': 'nnhpff' is needed"),
        ("nnhpff:weights=nothere", "unknown checkpoint 'nothere'"),
    ],
)
def test_one_clear_line(name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        make(name, wsn())
    assert str(caught.value).startswith(name.split(":")[0] + ": ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["hpff", "nnhpff:weights=none"])
def test_there_must_be_anchors_to_judge_by(name: str) -> None:
    with pytest.raises(ValueError, match=r"hpff: the team has no distances to anchors"):
        make(name, make_scenario("indoor-v0"))


def test_options_of_its_parts_come_in_their_names() -> None:
    localizer: Any = hybrid(
        "hpff:bank=false:main=pf@particles=70@seed=3:auxiliary=emvf@memory=5", wsn()
    )
    assert (localizer.main.particles, localizer.main.seed) == (70, 3)
    assert localizer.auxiliary.size == 5
