"""Trainings on tasks: exact continuation, what their losses see, clear refusals, and they learn."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from agents.policies.task_actor import TaskActor
from agents.policies.task_policy import TaskPolicy, load_policy
from agents.tasks import make_task
from agents.tasks.runner import rollout
from training.evaluation.score import FIRST_SEED
from training.learning import run as runs
from training.learning.registry import TRAININGS
from training.learning.tasks import ppo, qmix, sb3

SMALL: dict[str, Any] = {"worlds": 4, "epochs": 2, "hidden": 8, "score_worlds": 0}
_PPO: dict[str, Any] = SMALL | {"passes": 2, "minibatches": 2}
KINDS: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "numbers": ("task-mappo", ppo, _PPO | {"task": "survey-v0:horizon=6"}),
    "recurrent": ("task-mappo", ppo, _PPO | {"task": "relay-v0:horizon=6", "network": "recurrent"}),
    "attention": (
        "task-ippo",
        ppo,
        _PPO | {"task": "track-v0:horizon=6", "network": "attention", "moves": "headings"},
    ),
    "held": (
        "task-mappo",
        ppo,
        _PPO | {"task": "convoy-v0:reward=sigma:horizon=10", "moves": "corridor", "hold": 5},
    ),
    "candidates": (
        "task-ippo",
        ppo,
        _PPO
        | {
            "task": "schedule-v0:horizon=6",
            "network": "candidates",
            "difference": True,
            "gamma": 0.0,
        },
    ),
    "qmix": ("task-qmix", qmix, SMALL | {"task": "schedule-v0:horizon=6", "updates": 3}),
    "sb3": ("task-sb3-ppo", sb3, _PPO | {"task": "beacon-v0:horizon=6"}),
}


def quiet(what: str, done: int, total: int) -> None:
    pass


def outcome(folder: Path, name: str) -> dict[str, bytes]:
    """Weights and metrics of a finished run."""
    files = [folder / f"{name}.safetensors", *sorted((folder / "metrics/scalars").glob("*.csv"))]
    return {file.name: file.read_bytes() for file in files}


@pytest.mark.parametrize("kind", KINDS)
def test_interrupted_runs_end_in_the_same_weights(
    kind: str, tmp_path: Path, interrupted: Callable[..., Any]
) -> None:
    """In the second epoch; to the same bits, whatever else was drawn meanwhile."""
    torch.set_num_threads(1)
    name, module, options = KINDS[kind]
    runs.start(name, options, tmp_path / "unbroken", quiet)
    with interrupted(module, "Return" if kind == "sb3" else "figures", 2):
        runs.start(name, options, tmp_path / "run", quiet)
    assert (tmp_path / "run/state.safetensors").exists()
    torch.manual_seed(77)
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run", name) == outcome(tmp_path / "unbroken", name)


@pytest.mark.parametrize("kind", KINDS)
def test_every_layer_moves_and_the_weights_act(kind: str, tmp_path: Path) -> None:
    name, _, options = KINDS[kind]
    weights = runs.start(name, options, tmp_path / "run", quiet)
    first, ended = TRAININGS[name](**options).module.state_dict(), load_file(weights)
    assert ended.keys() == first.keys()
    for key, value in ended.items():
        assert (value != first[key]).any(), key
    task = make_task(options["task"])
    policy = load_policy(task, str(weights))
    again = load_policy(make_task(options["task"]), str(weights))
    a = [step.action for step in rollout(task, policy, torch.arange(3))]
    b = [step.action for step in rollout(again.task, again, torch.arange(3))]
    assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))
    if options.get("hold", 1) > 1:
        assert torch.equal(a[0], a[4])


@pytest.mark.parametrize("kind", ["numbers", "recurrent", "attention", "held", "candidates"])
def test_before_training_a_batch_is_as_likely_as_it_was(kind: str) -> None:
    """The loss finds the probabilities that the collector noted: its network, memory and what it
    reads are those that acted. (A ratio of 1 is where PPO begins.)"""
    name, _, options = KINDS[kind]
    training = TRAININGS[name](**options)
    actor, trainer = training.module, training.trainer
    assert isinstance(actor, TaskActor)
    torch.manual_seed(5)
    with torch.no_grad():
        actor.head.weight.copy_(torch.randn_like(actor.head.weight))
    maker: Any = training.collector
    (batch,) = list(maker.make(0))
    loss: Any = trainer.loss_module  # type: ignore[attr-defined]
    with torch.no_grad():
        loss.value_estimator(batch)
        found = loss(batch if kind == "recurrent" else batch.flatten())
    assert float(found["clip_fraction"]) == 0
    assert abs(float(found["kl_approx"])) < 1e-4
    assert float(batch["uav", "decision_log_prob"].std()) > 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_a_world_is_acted_in_alike_whoever_shares_its_batch(kind: str) -> None:
    name, _, options = KINDS[kind]
    actor = TRAININGS[name](**options).module
    assert isinstance(actor, TaskActor)
    actor.architecture = {**actor.architecture, "sampled": False}
    torch.manual_seed(3)
    with torch.no_grad():
        actor.head.weight.copy_(torch.randn_like(actor.head.weight))
    task = make_task(options["task"])
    many = list(rollout(task, TaskPolicy(task, actor), torch.arange(4)))
    one = list(rollout(task, TaskPolicy(task, actor), torch.tensor([2])))
    for x, y in zip(many, one, strict=True):
        assert torch.equal(x.action[2], y.action[0])


def test_nothing_comes_after_the_horizon() -> None:
    """The value to learn of an episode's last step is its reward, in units of the first returns'
    spread; that of others is what is left of the return, for λ = 1."""
    name, _, options = KINDS["numbers"]
    training: Any = TRAININGS[name](**options | {"gamma": 0.9, "gae_lambda": 1.0})
    (batch,) = list(training.collector.make(0))
    reward = batch["next", "uav", "reward"].clone()
    training.trainer._process_batch_hook(batch)
    unit = training.trainer.loss_module.critic_network_params["module", "unit"]
    left = torch.zeros_like(reward[:, 0])
    for t in reversed(range(reward.shape[1])):
        left = reward[:, t] + 0.9 * left
        torch.testing.assert_close(batch["uav", "value_target"][:, t], left / unit)


def test_masked_choices_are_never_made() -> None:
    task = make_task("schedule-v0", horizon=10)
    actor = TRAININGS["task-ippo"](**KINDS["candidates"][2]).module
    assert isinstance(actor, TaskActor)
    for step in rollout(task, TaskPolicy(task, actor), torch.arange(8)):
        mask = step.seen.mask
        assert mask is not None
        assert mask.gather(2, step.action.long().unsqueeze(-1)).all()
        assert not mask.all()


def test_scores_are_the_protocols(tmp_path: Path) -> None:
    name, _, options = KINDS["held"]
    weights = runs.start(name, options | {"score_worlds": 5}, tmp_path / "run", quiet)
    card = json.loads(weights.with_suffix(".json").read_text())
    task = make_task(options["task"]).with_options(reward="true")
    total = torch.zeros(5)
    for step in rollout(task, load_policy(task, str(weights)), FIRST_SEED + torch.arange(5)):
        total += step.reward.mean(-1)
    assert card["scores"]["return"] == pytest.approx(float(total.mean()), abs=1e-5)
    assert card["scores"]["first_seed"] == FIRST_SEED


@pytest.mark.slow
def test_it_learns_the_survey_from_nothing(tmp_path: Path) -> None:
    options = {"task": "survey-v0:horizon=30", "worlds": 32, "epochs": 5, "score_worlds": 0}
    runs.start("task-mappo", options | {"learning_rate": 0.003}, tmp_path / "run", quiet)
    lines = (tmp_path / "run/metrics/scalars/return.csv").read_text().splitlines()
    returns = [float(line.split(",")[1]) for line in lines]
    assert returns[-1] > 1.3 * returns[0]


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("task-mappo", {"task": "survey-v9"}, "survey-v9"),
        ("task-mappo", {"hold": 7}, "hold=7 must divide the horizon, 80"),
        ("task-mappo", {"network": "candidates"}, "network=candidates scores exchanges"),
        ("task-mappo", {"task": "beacon-v0", "moves": "headings"}, "moves=headings is for"),
        ("task-mappo", {"task": "relay-v0", "difference": True}, "difference=true is for calls"),
        ("task-mappo", {"task": "relay-v0:obs=dict"}, "obs=dict does not fit"),
        ("task-qmix", {"task": "survey-v0"}, "has no choices; moves=headings makes some"),
        ("task-qmix", {"network": "recurrent"}, "network=recurrent is not allowed"),
        ("task-ippo", {"network": "lstm"}, "network"),
    ],
)
def test_refusals(name: str, options: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        runs.start(name, options, tmp_path / "run", quiet)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_weights_of_another_task_or_team_are_refused(tmp_path: Path) -> None:
    name, _, options = KINDS["numbers"]
    weights = str(runs.start(name, options, tmp_path / "run", quiet))
    with pytest.raises(ValueError, match=r"trained on survey-v0, not on relay-v0"):
        load_policy(make_task("relay-v0"), weights)
    with pytest.raises(ValueError, match="reads observations of"):
        load_policy(make_task("survey-v0", n_uavs=6), weights)


def test_a_config_runs_again(tmp_path: Path) -> None:
    name, _, options = KINDS["numbers"]
    weights = runs.start(name, options, tmp_path / "run", quiet)
    for source in (tmp_path / "run/run.json", weights.with_suffix(".json")):
        trained, chosen = runs.recipe(str(source))
        assert trained == name
        again = runs.start(trained, chosen, tmp_path / f"again-{source.stem}", quiet)
        assert again.read_bytes() == weights.read_bytes()
    with pytest.raises(ValueError, match="no such file"):
        runs.recipe(str(tmp_path / "nothing.json"))
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="'training' is missing"):
        runs.recipe(str(tmp_path / "other.json"))


def test_curves_are_written(tmp_path: Path) -> None:
    name, _, options = KINDS["numbers"]
    runs.start(name, options, tmp_path / "run", quiet)
    curves = json.loads((tmp_path / "run/curves.json").read_text())
    assert [frames for frames, _ in curves["return"]] == [24, 48]
    assert (tmp_path / "run/curves.png").read_bytes().startswith(b"\x89PNG")
