"""Learned policies as localizers: their checkpoints, what is refused, and that they act alike."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, InitTracker, TransformedEnv, set_exploration_type

from agents import make
from agents.localizer import Localizer
from agents.policies.actor import Actor
from agents.policies.adapters import LocalizerPolicy, ParallelPolicy
from agents.policies.learned import PolicyAgent, actor_for, inputs_of, mode_of
from agents.weights import card_of, write
from agents.wrappers.correction import Correction
from coloc_env.envs.action_mode import ActionMode
from coloc_env.envs.displacement import Displacement
from coloc_env.envs.pettingzoo import parallel_env
from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv
from coloc_env.motion import Arena, RandomVelocity
from coloc_env.network import Network
from coloc_env.scenario import Prior, Scenario, Wheeled
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import LandmarkBearings, Odometry
from coloc_env.world import World
from training.learning.mappo import policy_of

N, WORLDS = 3, 2


def indoor(**overrides: Any) -> Scenario:
    return make_scenario("indoor-v0", **{"n_uavs": N, "horizon": 8, "motion": "random"} | overrides)


def plane() -> Scenario:
    sensors = (Odometry(), LandmarkBearings(count=5, radius=20.0))
    return Scenario(
        name="plane",
        arena=Arena(2, N, 0.1, (0.0, 0.0), (10.0, 8.0)),
        horizon=8,
        motion=RandomVelocity(),
        sensors=sensors,
        network=Network(),
        prior=Prior(position_std=0.5, velocity_std=0.1),
        process=Wheeled(),
        believed_sensors=sensors,
    )


def lively(mode: ActionMode, recurrent: bool = True, **options: Any) -> Actor:
    """A network whose actions are neither small nor all at their bounds."""
    torch.manual_seed(1)
    actor = actor_for(mode, hidden=8, recurrent=recurrent, **options)
    with torch.no_grad():
        actor.head.layer.weight[: mode.dim] = torch.randn(mode.dim, 8)
        actor.body.normal.scale.fill_(0.5)
    return actor.requires_grad_(False)


def modes(scenario: Scenario) -> list[ActionMode]:
    believed = scenario.believed
    return [
        Displacement(believed),
        Correction(believed, "ekf:robust=huber", 0.5),
        Correction(believed, "pf500:particles=40"),
    ]


def errors(agent: Localizer, scenario: Scenario, seed: int) -> Tensor:
    """Errors [K, B, N] of a localizer's estimates in worlds of its own."""
    world, found = World(scenario, WORLDS), []
    observation = world.reset(seed)
    belief = agent.reset(observation)
    for _ in range(scenario.horizon):
        belief, estimate = agent.step(belief, observation)
        found.append(world.step(estimate.action()).error)
        observation = world.observation()
    return torch.stack(found)


# ---------------------------------------------------------------- checkpoints


@pytest.mark.parametrize("name", ["mappo", "ippo", "sb3-ppo"])
@pytest.mark.parametrize("kind", [0, 1, 2])
def test_weights_come_back_from_their_files(name: str, kind: int, tmp_path: Path) -> None:
    """The same numbers, in the same mode on the same base, and the same estimates."""
    scenario = indoor()
    mode = modes(scenario)[kind]
    actor = lively(mode, recurrent=kind > 0, squash="tanh" if kind else "clip")
    file = tmp_path / "mine.safetensors"
    write(file, actor, {"training": name})
    drawn = torch.random.get_rng_state()
    agent = make(f"{name}:weights={file}", indoor())
    assert torch.equal(torch.random.get_rng_state(), drawn), (
        "loading draws from no shared generator"
    )
    assert isinstance(agent, PolicyAgent)
    assert agent.mode.settings == mode.settings
    assert agent.actor.architecture == actor.architecture
    for key, value in actor.state_dict().items():
        assert torch.equal(agent.actor.state_dict()[key], value), key
    assert not any(p.requires_grad for p in agent.actor.parameters())
    held = PolicyAgent.of(scenario.believed, actor, mode)
    assert torch.equal(errors(agent, scenario, 3), errors(held, scenario, 3))
    assert card_of(file)["architecture"]["inputs"] == inputs_of(mode)


def test_an_untrained_policy_needs_no_file_and_hardly_corrects() -> None:
    scenario = indoor()
    agent, again = (make("mappo:weights=none", scenario) for _ in range(2))
    first = errors(agent, scenario, 0)
    assert torch.equal(first, errors(again, scenario, 0))
    world, ekf = World(scenario, WORLDS), make("ekf", scenario)
    observation = world.reset(0)
    _, estimate = ekf.step(ekf.reset(observation), observation)
    base = world.score(estimate.action())[0]
    assert 0 < (first[0] - base).abs().max() < 0.02


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A good checkpoint, to be spoilt."""
    file = tmp_path / "good.safetensors"
    write(file, lively(Correction(indoor().believed)), {})
    return file


def edit(file: Path, **changes: Any) -> None:
    """Change a card; ``architecture__key`` changes what is inside."""
    path = file.with_suffix(".json")
    card = json.loads(path.read_text())
    for key, value in changes.items():
        first, _, rest = key.partition("__")
        (card[first] if rest else card)[rest or first] = value
    path.write_text(json.dumps(card))


def refused(file: Path | str, words: str, scenario: Scenario | None = None) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        make(f"mappo:weights={file}", scenario or indoor())
    assert str(error.value).startswith("mappo: ")
    assert "\n" not in str(error.value)


def test_weights_of_another_kind_are_refused(tmp_path: Path) -> None:
    refused("pfnn", "pfnn.safetensors holds weights of kind 'pfnn': 'policy' is needed")
    root = Path(__file__).parents[3] / "checkpoints"
    for end in ("safetensors", "json"):
        shutil.copy(root / f"pfnn.{end}", tmp_path / f"mine.{end}")
    file = tmp_path / "mine.safetensors"
    refused(file, f"{file} holds weights of kind 'pfnn': 'policy' is needed")


def test_weights_for_other_leaves_are_refused(saved: Path, tmp_path: Path) -> None:
    refused(
        saved,
        f"{saved} was trained on the leaves base_std[3], fix_mean[3], residuals[18], "
        "last_action[3]: this scenario has base_std[3], residuals[9], last_action[3]",
        indoor(landmarks=0),
    )
    refused(saved, "this scenario has base_std[2], fix_mean[2], residuals[8], last_act", plane())
    flat = tmp_path / "flat.safetensors"
    write(flat, lively(Displacement(plane().believed)), {})
    refused(flat, "was trained on the leaves fix_mean[2], fix_share[1], last_action[2]: this ")
    make(f"mappo:weights={flat}", plane())


def test_a_base_that_does_not_serve_is_refused(saved: Path) -> None:
    refused(saved, "Landmarks are in the body frame", indoor(imu=False))
    edit(saved, architecture__mode={"name": "correction", "base": "ekg", "feedback": 0.0})
    refused(saved, "unknown agent 'ekg' (did you mean 'ekf'?)")


@pytest.mark.parametrize(
    ("mode", "words"),
    [
        ({"name": "thrust"}, "action mode 'thrust' is not one that policies have: correction, dis"),
        ({}, "action mode None is not one that policies have: correction, displacement"),
        ({"name": "correction", "bias": 1}, "action mode 'correction': "),
        ({"name": "correction", "feedback": 2.0}, "feedback=2.0 is not allowed: a share in [0, 1]"),
    ],
)
def test_an_unknown_mode_is_refused(mode: dict[str, Any], words: str, saved: Path) -> None:
    edit(saved, architecture__mode=mode)
    refused(saved, words)
    with pytest.raises(ValueError, match=re.escape(words)):
        mode_of(indoor().believed, mode)


def test_damaged_checkpoints_are_refused(saved: Path) -> None:
    whole = saved.read_bytes()
    saved.write_bytes(whole[:-7])
    refused(saved, f"{saved} is damaged, or good.json belongs to another file: their SHA-256")
    saved.write_bytes(whole)
    make(f"mappo:weights={saved}", indoor())
    edit(saved, architecture__hidden=9)
    refused(saved, "is needed")
    edit(saved, architecture__hidden=8, architecture__recurrent=False)
    refused(saved, f"{saved} holds ")
    card = saved.with_suffix(".json")
    card.unlink()
    refused(saved, f"{saved} lacks its card good.json: a checkpoint is the pair of them")
    saved.unlink()
    refused(saved, f"{saved}: no such file")


def test_a_card_that_describes_no_network_is_refused(saved: Path) -> None:
    kept = json.loads(saved.with_suffix(".json").read_text())
    for wrong in ({}, {"mode": {"name": "displacement"}}, kept["architecture"] | {"depth": 3}):
        edit(saved, architecture=wrong)
        refused(saved, f"{saved}: its card has an architecture that no policy has")
    edit(saved, architecture=kept["architecture"], features=["imu[6]"])
    refused(saved, f"{saved} was trained on the features imu[6]: base_std[3], fix_mean[3], ")


def test_an_unknown_name_is_refused() -> None:
    refused("mapo", "unknown checkpoint 'mapo'")


# ---------------------------------------------------------------- rollouts


@pytest.mark.parametrize("recurrent", [False, True])
@pytest.mark.parametrize("kind", [0, 1, 2])
@pytest.mark.parametrize("scenario", [indoor(nlos=0.3), plane()], ids=["indoor", "plane"])
def test_a_localizer_flies_as_the_policy_does(
    scenario: Scenario, kind: int, recurrent: bool
) -> None:
    """Mean actions of TorchRL's policy in CoLocEnv, through the view of one UAV a row."""
    mode = modes(scenario)[kind]
    actor = lively(mode, recurrent)
    expected = errors(PolicyAgent.of(scenario.believed, actor, mode), scenario, 5)
    env = PerUavEnv(CoLocEnv(scenario, WORLDS, seed=5, action=mode))
    policy, rows = policy_of(actor), WORLDS * N
    now, actions = env.reset(), []
    kept = {name: torch.zeros(rows, 1, 8) for name in ("hidden", "cell")}
    for step in range(scenario.horizon):
        seen = TensorDict({"observation": now["observation"], **kept}, [rows])
        seen["is_init"] = torch.full((rows, 1), step == 0)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            seen = policy(seen)
        if recurrent:
            kept = {name: seen["next", name] for name in kept}
        actions.append(seen["action"])
        now["action"] = seen["action"]
        now = env.step(now)["next"]
        found = -now["reward"].view(WORLDS, N)
        # Which particles survive hangs on rounding.
        torch.testing.assert_close(found, expected[step], atol=1e-2 if kind == 2 else 1e-4, rtol=0)
    together = torch.stack(actions)
    assert together.std() > 0.1
    assert (together.abs() < 0.99).float().mean() > 0.2


def test_the_faces_fly_alike() -> None:
    """PettingZoo's, and TorchRL's with the belief in the module or in the tensordict."""
    scenario = indoor()
    mode = modes(scenario)[1]
    agent = PolicyAgent.of(scenario.believed, lively(mode), mode)
    expected = errors(agent, scenario, 5)
    wild, policy = parallel_env(scenario), ParallelPolicy(agent)
    observations, _ = wild.reset(seed=5)
    for step in range(scenario.horizon):
        observations, rewards, *_ = wild.step(policy(observations))
        found = [-reward for reward in rewards.values()]
        np.testing.assert_allclose(found, expected[step, 0], atol=1e-4)
    for carry in ("module", "tensordict"):
        policy_there = LocalizerPolicy(agent, scenario, carry=carry)
        env = TransformedEnv(CoLocEnv(scenario, WORLDS, seed=5), InitTracker())
        env.append_transform(policy_there.make_tensordict_primer())
        rewards = env.rollout(scenario.horizon, policy_there)["next", "uav", "reward"][..., 0]
        torch.testing.assert_close(-rewards.movedim(1, 0), expected, atol=1e-4, rtol=1e-4)


def test_messages_carry_the_corrected_estimates() -> None:
    scenario = indoor()
    mode = modes(scenario)[1]
    agent = PolicyAgent.of(scenario.believed, lively(mode), mode)
    observation = World(scenario, WORLDS).reset(0)
    _, estimate = agent.step(agent.reset(observation), observation)
    base = mode.base.step(mode.base.reset(observation), observation)[1]  # type: ignore[attr-defined]
    assert (estimate.position - base.position).abs().min() > 1e-4
    variance = base.covariance.diagonal(dim1=-2, dim2=-1).float()
    expected = torch.diag_embed(variance)
    torch.testing.assert_close(estimate.covariance, expected, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(estimate.velocity, base.velocity.float())


def test_a_policy_looks_where_its_base_looks() -> None:
    """One that corrects a team's filter has to act for the team."""
    believed = indoor().believed
    for base, together in (("ekf", False), ("ekf_joint", True), ("ekf:robust=cross", True)):
        mode = Correction(believed, base)
        assert PolicyAgent.of(believed, lively(mode), mode).exchanges == together
    mode_alone = Displacement(believed)
    assert not PolicyAgent.of(believed, lively(mode_alone), mode_alone).exchanges


def test_a_collector_flies_it() -> None:
    """Over more than one episode, the network's memory restarting with each."""
    scenario = indoor()
    mode = modes(scenario)[0]
    agent = PolicyAgent.of(scenario.believed, lively(mode), mode)
    collector = Collector(
        CoLocEnv(scenario, WORLDS, seed=5),
        LocalizerPolicy(agent, scenario),
        frames_per_batch=WORLDS * 16,
        total_frames=WORLDS * 16,
        auto_register_policy_transforms=True,
    )
    (batch,) = [found.clone() for found in collector]
    collector.shutdown()
    assert isinstance(batch, TensorDictBase)
    found = -batch["next", "uav", "reward"][..., 0].movedim(1, 0)
    torch.testing.assert_close(found[:8], errors(agent, scenario, 5), atol=1e-5, rtol=1e-5)
    second = errors(agent, scenario, 5 + WORLDS)
    torch.testing.assert_close(found[8:], second, atol=1e-5, rtol=1e-5)
