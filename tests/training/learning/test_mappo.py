"""IPPO and MAPPO: what their losses see and train, values at the horizon, exact continuation."""

import csv
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from agents import make
from agents.policies.actor import Actor
from agents.policies.learned import PolicyAgent
from coloc_env.scenarios import make_scenario
from training.evaluation.record import record
from training.learning import mappo
from training.learning import run as runs
from training.learning.collectors import world_seed
from training.learning.mappo import policy_of
from training.learning.registry import TRAININGS

SCENARIO = "indoor-v0:motion=random:horizon=10:n_uavs=3"
SMALL: dict[str, Any] = {
    "scenario": SCENARIO,
    "worlds": 4,
    "epochs": 2,
    "steps": 5,
    "passes": 2,
    "minibatches": 2,
    "hidden": 8,
    "score_runs": 0,
}
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "mappo-recurrent-ekf": ("mappo", {}),
    "mappo-fed-back": ("mappo", {"feedback": 0.5, "gamma": 0.9, "minibatches": 5, "worlds": 6}),
    "mappo-variants": (
        "mappo",
        {"variants": "nlos=0.3/false_matches=0.1", "recurrent": False, "entropy": 0.01},
    ),
    "ippo-alone": ("ippo", {"base": "none", "recurrent": False}),
    "ippo-recurrent-alone": ("ippo", {"base": "none", "gamma": 0.99}),
}
ROWS = 4 * 3


def quiet(what: str, done: int, total: int) -> None:
    pass


def outcome(folder: Path, name: str) -> dict[str, bytes]:
    """Weights and metrics of a finished run."""
    files = [folder / f"{name}.safetensors", *sorted((folder / "metrics/scalars").glob("*.csv"))]
    return {file.name: file.read_bytes() for file in files}


def build(name: str = "mappo", **options: Any) -> runs.Training:
    return TRAININGS[name](**SMALL | options)


def parts(training: runs.Training) -> tuple[Any, Any]:
    """The loss and the collectors."""
    trainer: Any = training.trainer
    return trainer.loss_module, training.collector


def batches(training: runs.Training, epoch: int = 0) -> list[TensorDictBase]:
    """An epoch's, without training on them."""
    several = parts(training)[1].make(epoch)
    found = [batch.clone() for batch in several]
    several.shutdown()
    return found


def actor_of(training: runs.Training) -> Actor:
    assert isinstance(training.module, Actor)
    return training.module


def loud(training: runs.Training) -> None:
    """Away from the small first weights, so that what is read, and remembered, matters."""
    torch.manual_seed(5)
    actor = actor_of(training)
    with torch.no_grad():
        actor.head.layer.weight.copy_(0.5 * torch.randn_like(actor.head.layer.weight))


# ---------------------------------------------------------------- runs


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest) -> tuple[str, dict[str, Any]]:
    name, options = KINDS[request.param]
    return name, SMALL | options


@pytest.fixture(scope="module")
def unbroken(
    kind: tuple[str, dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, bytes]:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    runs.start(*kind, folder, quiet)
    assert not (folder / "state.safetensors").exists()
    return outcome(folder, kind[0])


def test_every_layer_moves(
    kind: tuple[str, dict[str, Any]], unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    """From the weights that the training started from; what normalizes its inputs stays."""
    name, options = kind
    first = TRAININGS[name](**options).module.state_dict()
    file = tmp_path / "weights.safetensors"
    file.write_bytes(unbroken[f"{name}.safetensors"])
    ended = load_file(file)
    assert ended.keys() == first.keys()
    assert any("lstm" in key for key in ended) == options.get("recurrent", True)
    for key, value in ended.items():
        assert torch.isfinite(value).all()
        if ".normal." in key:
            assert torch.equal(value, first[key]), key
        else:
            assert (value != first[key]).any(), key


def test_interrupted_after_an_epoch(
    kind: tuple[str, dict[str, Any]],
    unbroken: dict[str, bytes],
    tmp_path: Path,
    interrupted: Callable[..., Any],
) -> None:
    """In the second epoch, with its first batch trained on: to the same bits as if it never had
    been, whatever else was drawn meanwhile."""
    with interrupted(mappo, "_figures", 4):
        runs.start(*kind, tmp_path / "run", quiet)
    assert (tmp_path / "run/state.safetensors").exists()
    torch.manual_seed(77)
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run", kind[0]) == unbroken


def test_other_seeds_train_other_weights(tmp_path: Path) -> None:
    short = SMALL | {"epochs": 1, "recurrent": False}
    for seed, folder in ((0, "a"), (0, "b"), (1, "c")):
        torch.manual_seed(seed + 9)  # nothing hangs on what was drawn before
        runs.start("ippo", short | {"seed": seed}, tmp_path / folder, quiet)
    a, b, c = (outcome(tmp_path / folder, "ippo") for folder in "abc")
    assert a == b
    assert a["ippo.safetensors"] != c["ippo.safetensors"]


def test_it_learns_to_localize(tmp_path: Path) -> None:
    """From nothing but the landmarks: a few thousand steps cut the error to a third."""
    options = SMALL | {"scenario": SCENARIO.replace("10", "40"), "base": "none", "recurrent": False}
    options |= {"worlds": 16, "epochs": 6, "steps": 20, "passes": 3, "minibatches": 4, "hidden": 32}
    runs.start("mappo", options | {"learning_rate": 0.01}, tmp_path / "run", quiet)
    with (tmp_path / "run/metrics/scalars/rmse.csv").open() as file:
        lines = [(int(frames), float(value)) for frames, value in csv.reader(file)]
    assert [frames for frames, _ in lines] == [960 * (k + 1) for k in range(12)]
    assert lines[-1][1] < 0.33 * lines[0][1]


def test_card_and_scores(tmp_path: Path) -> None:
    """Who is scored, in which worlds; the weights are an agent that does as well as scored."""
    options = SMALL | {"epochs": 1, "variants": "nlos=0.3/false_matches=0.1", "score_runs": 2}
    weights = runs.start("mappo", options, tmp_path / "run", quiet)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["command"].startswith(f"coloc train mappo --set scenario={SCENARIO} --set worlds=4")
    assert card["frames"] == ROWS * 10
    assert card["options"]["learning_rate"] == 1e-3
    assert card["architecture"]["mode"] == {"name": "correction", "base": "ekf", "feedback": 0.0}
    scores = card["scores"]
    assert (scores["runs"], scores["seeds"]) == (2, [0, 1])
    common = "motion=random:horizon=10:n_uavs=3"
    assert set(scores["rmse"]) == {f"{common}:nlos=0.3", f"{common}:false_matches=0.1"}
    scenario = make_scenario("indoor-v0", motion="random", horizon=10, n_uavs=3, nlos=0.3)
    found = scores["rmse"][f"{common}:nlos=0.3"]
    assert set(found) == {"mappo", "ekf", "ekf:robust=huber"}
    for agent in found:
        one = make(f"mappo:weights={weights}" if agent == "mappo" else agent, scenario)
        recorded = record(one, scenario, torch.arange(2))
        expected = float(np.sqrt(np.square(recorded.error).mean()))
        assert found[agent] == pytest.approx(expected, rel=1e-4)


def test_without_a_base_the_rivals_are_filters(tmp_path: Path) -> None:
    options = SMALL | {"epochs": 1, "base": "none", "recurrent": False, "score_runs": 1}
    weights = runs.start("ippo", options, tmp_path / "run", quiet)
    card = json.loads(weights.with_suffix(".json").read_text())
    (found,) = card["scores"]["rmse"].values()
    assert set(found) == {"ippo", "dead_reckoning", "ekf:robust=huber"}
    agent = make(f"ippo:weights={weights}", make_scenario("indoor-v0"))
    assert isinstance(agent, PolicyAgent)
    assert agent.mode.settings == {"name": "displacement"}


# ---------------------------------------------------------------- epochs


def test_every_epoch_flies_worlds_of_its_own() -> None:
    training = build(variants="nlos=0.3/nlos=0.1/nlos=0.2/nlos=0.0", recurrent=False)
    seen: list[int] = []
    for epoch in range(2):
        several = parts(training)[1].make(epoch)
        for collector in several.collectors:
            env = collector.env
            while hasattr(env, "base_env"):
                env = env.base_env
            seen += env.env.world.seeds.tolist()
        several.shutdown()
    assert sorted(seen) == [world_seed(0, 0, 4) + i for i in range(8)]


def test_variants_share_the_batch_world_by_world() -> None:
    """Each row is one of a training in that variant's worlds alone."""
    together = batches(build(variants="nlos=0.3/landmark_std=1.0", recurrent=False, base="none"))[0]
    assert together.shape == (ROWS, 5)
    for half, variant in enumerate(("nlos=0.3", "landmark_std=1.0")):
        name, value = variant.split("=")
        overrides: dict[str, Any] = {name: float(value)}
        scenario = make_scenario("indoor-v0", motion="random", horizon=10, n_uavs=3, **overrides)
        env = mappo.environment(scenario, 2, world_seed(0, 0, 4) + 2 * half, "none", 0.0)
        first = env.reset()
        rows = slice(6 * half, 6 * half + 6)
        assert torch.equal(together["state"][rows, 0], first["state"])
        assert torch.equal(together["observation"][rows, 0], first["observation"])


def test_the_learning_rate_falls_linearly() -> None:
    training = build(epochs=4, learning_rate=0.02)
    trainer: Any = training.trainer
    for epoch in range(4):
        parts(training)[1].make(epoch).shutdown()
        rates = {group["lr"] for group in trainer.optimizer.param_groups}
        assert list(rates) == pytest.approx([0.02 * (1 - epoch / 4)])


def test_networks_read_inputs_of_usual_size() -> None:
    """Observations, and the state for MAPPO's critic, are about 0 ± 1 after normalizing."""
    training = build(scenario=SCENARIO.replace("10", "40"), worlds=16, steps=40, recurrent=False)
    loss, _ = parts(training)
    batch: Any = torch.cat([b.flatten() for b in batches(training)])
    actor = actor_of(training)
    critic = loss.critic_network.module
    for body, seen in (
        (actor.body, batch["observation"]),
        (critic.body, torch.cat((batch["observation"], batch["state"]), -1)),
    ):
        assert body.normal.shift.shape == seen.shape[-1:]
        with torch.no_grad():
            normal = body.normal(seen)
        moving = seen.std(0) > 1e-3
        assert moving.float().mean() > 0.8
        assert normal[:, moving].median(0).values.abs().max() < 2.5
        spread = normal[:, moving].quantile(0.84, 0) - normal[:, moving].quantile(0.16, 0)
        assert 1 < spread.median() < 4


# ---------------------------------------------------------------- losses


@pytest.mark.parametrize(("name", "recurrent"), [("mappo", True), ("mappo", False), ("ippo", True)])
def test_before_training_a_batch_is_as_likely_as_it_was(name: str, recurrent: bool) -> None:
    """The loss finds the probabilities that the collector noted, batch by batch: its networks,
    their memory and what they read are those that flew. (A ratio of 1 is where PPO begins.)"""
    training = build(name, recurrent=recurrent, passes=1)
    loud(training)
    loss, _ = parts(training)
    first, second = batches(training)
    assert not torch.allclose(first["action_log_prob"], second["action_log_prob"])
    policy = policy_of(actor_of(training))
    for batch in (first, second):
        read = ["observation", "is_init", *(["hidden", "cell"] if recurrent else [])]
        with torch.no_grad(), set_recurrent_mode(True):
            found = policy.get_dist(batch.select(*read)).log_prob(batch["action"])
        torch.testing.assert_close(found, batch["action_log_prob"], atol=1e-3, rtol=1e-3)
        with torch.no_grad():
            loss.value_estimator(batch)
            found = loss(batch)
        assert float(found["clip_fraction"]) == 0
        assert abs(float(found["kl_approx"])) < 1e-4
    if recurrent:
        forgotten = second.select("observation", "is_init", "hidden", "cell")
        forgotten["hidden"].zero_()
        with torch.no_grad(), set_recurrent_mode(True):
            found = policy.get_dist(forgotten).log_prob(second["action"])
        assert (found - second["action_log_prob"]).abs().max() > 0.05, "or memory plays no part"


class Recording:
    """A logger that keeps all values."""

    def __init__(self) -> None:
        self.values: dict[str, list[float]] = {}

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        self.values.setdefault(name, []).append(float(value))


@pytest.mark.parametrize("recurrent", [False, True])
def test_training_reads_what_was_flown(recurrent: bool) -> None:
    """From the buffer, in minibatches of rows: as long as nothing is learned, all is as likely as
    it was, the steps of an episode's second half with the memory of its first."""
    training = build(recurrent=recurrent, learning_rate=1e-12, minibatches=5)
    loud(training)
    trainer: Any = training.trainer
    trainer.logger = found = Recording()
    trainer.train()
    assert len(found.values["max_ratio"]) == 4
    assert found.values["max_ratio"] == pytest.approx([1.0] * 4, abs=1e-3)
    assert found.values["mean_ratio"] == pytest.approx([1.0] * 4, abs=1e-3)
    assert found.values["clip_fraction"] == [0.0] * 4


def constant(training: runs.Training, value: float) -> None:
    """A critic that always says ``value``."""
    loss, _ = parts(training)
    with torch.no_grad():
        for key, parameter in loss.named_parameters():
            if key.startswith("critic") and "head" in key:
                parameter.zero_() if "weight" in key else parameter.fill_(value)


@pytest.mark.parametrize(("gamma", "decay"), [(0.0, 0.95), (0.9, 1.0), (0.9, 0.0), (0.99, 0.95)])
def test_the_horizon_bootstraps(gamma: float, decay: float) -> None:
    """Generalized advantages of a critic that always says v, in numpy: a truncated step, like one
    in the middle, is worth r + γ v; nothing of the next episode comes in."""
    value = 7.0
    training = build(gamma=gamma, gae_lambda=decay, steps=10)
    constant(training, value)
    loss, _ = parts(training)
    (batch,) = batches(training)
    assert batch["next", "truncated"][:, -1].all()
    assert not batch["next", "terminated"].any()
    with torch.no_grad():
        loss.value_estimator(batch)
    rewards = batch["next", "reward"][..., 0].numpy().astype(np.float64)
    advantage, after = np.zeros_like(rewards), np.zeros(len(rewards))
    for t in reversed(range(10)):
        error = rewards[:, t] + gamma * value - value
        advantage[:, t] = after = error + gamma * decay * after
    np.testing.assert_allclose(batch["state_value"][..., 0], value, atol=1e-5)
    np.testing.assert_allclose(batch["advantage"][..., 0], advantage, atol=1e-3)
    np.testing.assert_allclose(batch["value_target"][..., 0], advantage + value, atol=1e-3)
    last = batch["value_target"][:, -1, 0].numpy()
    np.testing.assert_allclose(last, rewards[:, -1] + gamma * value, atol=1e-4)


def test_a_truncation_in_the_midst_of_a_batch_stops_the_sum() -> None:
    """Two episodes in one batch, where a collector is asked for more than an episode."""
    training = build(gamma=0.9, gae_lambda=1.0, recurrent=False, base="none")
    constant(training, 5.0)
    loss, _ = parts(training)
    scenario = make_scenario("indoor-v0", motion="random", horizon=4, n_uavs=3)
    env = mappo.environment(scenario, 2, 0, "none", 0.0)
    torch.manual_seed(0)
    with torch.no_grad():
        batch = env.rollout(8, policy_of(actor_of(training)), break_when_any_done=False)
        loss.value_estimator(batch)
    rewards = batch["next", "reward"][..., 0].double().numpy()
    for t, steps in ((3, 1), (0, 4), (4, 4), (7, 1)):
        factors = 0.9 ** np.arange(steps)
        expected = rewards[:, t : t + steps] @ factors + 0.9**steps * 5.0
        np.testing.assert_allclose(batch["value_target"][:, t, 0], expected, atol=1e-3)


def gradients(training: runs.Training) -> Mapping[str, Tensor]:
    loss, _ = parts(training)
    (batch, _) = batches(training)
    with torch.no_grad():
        loss.value_estimator(batch)
    found = loss(batch)
    sum(found[key] for key in found.keys() if key.startswith("loss_")).backward()  # noqa: SIM118
    return {key: p.grad for key, p in loss.named_parameters()}


@pytest.mark.parametrize("name", ["mappo", "ippo"])
@pytest.mark.parametrize("recurrent", [False, True])
def test_every_part_of_both_networks_is_trained(name: str, recurrent: bool) -> None:
    """Each has a gradient, and the optimizer holds it."""
    training = build(name, recurrent=recurrent)
    loud(training)
    found = gradients(training)
    trainer: Any = training.trainer
    held = {id(p) for group in trainer.optimizer.param_groups for p in group["params"]}
    loss, _ = parts(training)
    assert {id(p) for p in loss.parameters()} == held
    assert {id(p) for p in training.module.parameters()} <= held
    assert len(found) == (8 if recurrent else 6) + 6
    for key, gradient in found.items():
        assert gradient is not None, key
        assert gradient.abs().max() > 0, key


def test_only_mappos_critic_sees_the_team() -> None:
    widths = {}
    for name in ("mappo", "ippo"):
        loss, _ = parts(build(name))
        widths[name] = loss.critic_network.module.body.layers[0].in_features
        assert list(loss.critic_network.in_keys) == (
            ["observation", "state"] if name == "mappo" else ["observation"]
        )
    truth = 3 * (3 + 3 + 4 + 2) + 3 * 3  # of each UAV, and its base's error
    assert widths["mappo"] - widths["ippo"] == truth
    for name in ("mappo", "ippo"):
        assert sum(actor_of(build(name)).architecture["inputs"].values()) == widths["ippo"]


# ---------------------------------------------------------------- wrong use


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"worlds": 0}, "worlds=0 is not allowed: a whole number"),
        ({"minibatches": 0}, "minibatches=0 is not allowed: a whole number"),
        ({"hidden": 0}, "hidden=0 is not allowed: a whole number"),
        ({"seed": -1}, "seed=-1 is not allowed: a whole number"),
        ({"learning_rate": 0.0}, "learning_rate=0.0 is not allowed: a number > 0"),
        ({"clip": -0.2}, "clip=-0.2 is not allowed: a number > 0"),
        ({"gamma": 1.5}, "gamma=1.5 is not allowed: a number from 0 to 1"),
        ({"entropy": -1.0}, "entropy=-1.0 is not allowed: a number from 0 to 1"),
        ({"steps": 11}, "steps=11 is not allowed: at most 10"),
        ({"worlds": 5, "variants": "nlos=0.1/nlos=0.2"}, "worlds=5 must be a multiple of the 2 va"),
        ({"variants": "nlos=0.1/nloss=0.2"}, "unknown option 'nloss' (did you mean 'nlos'?)"),
        (
            {"variants": "landmarks=0/nlos=0.3"},
            "variants='landmarks=0/nlos=0.3' must have one hori",
        ),
        ({"variants": "n_uavs=2/n_uavs=3"}, "variants='n_uavs=2/n_uavs=3' must have one horizon"),
        ({"variants": "horizon=10/horizon=30"}, "must have one horizon, one number of UAVs, and"),
        ({"base": "efk"}, "unknown agent 'efk' (did you mean 'ekf'?)"),
        ({"feedback": 2.0}, "feedback=2.0 is not allowed: a number from 0 to 1"),
        ({"recurrent": "yes"}, "recurrent='yes' is not allowed: true or false is needed"),
        ({"scenario": "indor-v0"}, "unknown scenario 'indor-v0' (did you mean 'indoor-v0'?)"),
        ({"scenario": f"{SCENARIO}:failure_rate=0.1"}, "UAVs that fail do not fit rows of one UAV"),
        ({"epoch": 3}, "unknown option 'epoch' (did you mean 'epochs'?)"),
    ],
)
def test_one_clear_line(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        runs.start("mappo", SMALL | options, tmp_path / "run", quiet)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


def test_a_damaged_run_is_not_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = SMALL | {"recurrent": False, "base": "none"}

    def dies(what: str, done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runs.start("mappo", options, tmp_path / "run", dies)
    state = tmp_path / "run/state.safetensors"
    state.write_bytes(state.read_bytes()[:-9])
    with pytest.raises(ValueError, match="damaged"):
        runs.resume(tmp_path / "run", quiet)
