"""stable-baselines3's PPO as a training: what it learns, exact continuation, clear refusals."""

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from agents import make
from agents.policies.learned import PolicyAgent
from coloc_env.scenarios import make_scenario
from training.evaluation.record import record
from training.learning import run as runs
from training.learning import sb3_ppo
from training.learning.collectors import world_seed
from training.learning.registry import TRAININGS
from training.learning.sb3_ppo import Sb3Trainer

SCENARIO = "indoor-v0:motion=random:horizon=10:n_uavs=3"
SMALL: dict[str, Any] = {
    "scenario": SCENARIO,
    "worlds": 4,
    "epochs": 3,
    "steps": 5,
    "passes": 2,
    "minibatches": 2,
    "hidden": 8,
    "score_runs": 0,
}
KINDS: dict[str, dict[str, Any]] = {
    "ekf": {},
    "fed back": {"feedback": 0.5, "gamma": 0.9, "minibatches": 7},
    "alone": {"base": "none"},
}


def quiet(what: str, done: int, total: int) -> None:
    pass


def outcome(folder: Path) -> dict[str, bytes]:
    """Weights and metrics of a finished run."""
    files = [folder / "sb3-ppo.safetensors", *sorted((folder / "metrics/scalars").glob("*.csv"))]
    return {file.name: file.read_bytes() for file in files}


def build(**options: Any) -> tuple[runs.Training, Sb3Trainer]:
    training = TRAININGS["sb3-ppo"](**SMALL | options)
    trainer = training.trainer
    assert isinstance(trainer, Sb3Trainer)
    return training, trainer


class Silence:
    """A logger that keeps all values."""

    def __init__(self) -> None:
        self.values: list[tuple[str, float, int]] = []

    def log_scalar(self, name: str, value: float, step: int) -> None:
        self.values.append((name, value, step))


@pytest.fixture(scope="module", params=KINDS)
def options(request: pytest.FixtureRequest) -> dict[str, Any]:
    return SMALL | KINDS[request.param]


@pytest.fixture(scope="module")
def unbroken(options: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    runs.start("sb3-ppo", options, folder, quiet)
    assert not (folder / "state.safetensors").exists()
    return outcome(folder)


def test_interrupted_in_training(
    options: dict[str, Any],
    unbroken: dict[str, bytes],
    tmp_path: Path,
    interrupted: Callable[..., Any],
) -> None:
    """In the middle of the second epoch: it ends in the same bits as if it never had been."""
    with interrupted(sb3_ppo.PPO, "train", 4):
        runs.start("sb3-ppo", options, tmp_path / "run", quiet)
    assert (tmp_path / "run/state.safetensors").exists()
    torch.manual_seed(77)
    np.random.seed(77)  # noqa: NPY002 (SB3 draws from it)
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run") == unbroken


def test_every_layer_moves(
    options: dict[str, Any], unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    """Of the actor that is written, from what PPO began with."""
    training, trainer = build(**options)
    trainer.model._setup_learn(1)  # what VecNormalize sees first
    sb3_ppo.exported(trainer.model, trainer.env, training.module)  # type: ignore[arg-type]
    first = training.module.state_dict()
    file = tmp_path / "weights.safetensors"
    file.write_bytes(unbroken["sb3-ppo.safetensors"])
    ended = load_file(file)
    assert ended.keys() == first.keys()
    for key, value in ended.items():
        assert torch.isfinite(value).all()
        assert (value != first[key]).any(), key
    bias = ended["head.layer.bias"]
    assert (bias[3:] != float(np.log(0.3))).all(), "the log-std is learned, too"


@pytest.mark.slow
def test_same_seed_same_weights(
    options: dict[str, Any], unbroken: dict[str, bytes], tmp_path: Path
) -> None:
    runs.start("sb3-ppo", options, tmp_path / "same", quiet)
    assert outcome(tmp_path / "same") == unbroken
    runs.start("sb3-ppo", options | {"seed": 1}, tmp_path / "other", quiet)
    other = outcome(tmp_path / "other")
    assert other["sb3-ppo.safetensors"] != unbroken["sb3-ppo.safetensors"]


def test_every_part_of_ppos_networks_moves() -> None:
    """The critic's, too, in one epoch."""
    _, trainer = build(epochs=1)
    trainer.logger = Silence()
    before: dict[str, Tensor] = {
        key: p.detach().clone() for key, p in trainer.model.policy.named_parameters()
    }
    trainer.train()
    for key, parameter in trainer.model.policy.named_parameters():
        assert (parameter != before[key]).any(), key


def test_every_epoch_flies_worlds_of_its_own_to_their_horizon() -> None:
    _, trainer = build()
    trainer.logger = Silence()
    worlds: Any = trainer.env.venv
    restart, seen = worlds.world.restart, []

    def noted(seeds: Any, rows: Any = None) -> Any:
        seen.append(seeds)
        return restart(seeds, rows)

    worlds.world.restart = noted
    frames = []
    trainer.on_epoch_end = lambda epochs: frames.append((epochs, trainer.collected_frames))
    trainer.train()
    assert seen[::2] == [world_seed(0, epoch, 4) for epoch in range(3)]
    assert frames == [(1, 120), (2, 240), (3, 360)]
    rates = [
        (step, value) for name, value, step in trainer.logger.values if name == "learning_rate"
    ]
    assert [step for step, _ in rates] == [60 * (k + 1) for k in range(6)]
    falling = [1e-3, 1e-3, 2e-3 / 3, 2e-3 / 3, 1e-3 / 3, 1e-3 / 3]
    assert [value for _, value in rates] == pytest.approx(falling)
    logged = [(step, value) for name, value, step in trainer.logger.values if name == "rmse"]
    assert [step for step, _ in logged] == [60 * (k + 1) for k in range(6)]
    assert all(0 < value < 5 for _, value in logged)


@pytest.mark.slow
def test_it_learns_to_localize(tmp_path: Path) -> None:
    """From nothing but the landmarks: a few thousand steps cut the error to a third."""
    longer = SMALL | {"scenario": SCENARIO.replace("10", "40"), "base": "none"}
    longer |= {"worlds": 16, "epochs": 6, "steps": 20, "passes": 3, "minibatches": 4, "hidden": 32}
    runs.start("sb3-ppo", longer | {"learning_rate": 0.01}, tmp_path / "run", quiet)
    with (tmp_path / "run/metrics/scalars/rmse.csv").open() as file:
        lines = [(int(frames), float(value)) for frames, value in csv.reader(file)]
    assert lines[-1][1] < 0.33 * lines[0][1]


def test_card_and_scores(tmp_path: Path) -> None:
    """The weights are an agent that does as well as scored, beside its base and a Huber EKF."""
    weights = runs.start("sb3-ppo", SMALL | {"score_runs": 2}, tmp_path / "run", quiet)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["command"].startswith(f"coloc train sb3-ppo --set scenario={SCENARIO} --set worlds")
    assert card["frames"] == 3 * 4 * 3 * 10
    assert card["architecture"]["squash"] == "clip"
    assert not card["architecture"]["recurrent"]
    ((key, found),) = card["scores"]["rmse"].items()
    assert key == "motion=random:horizon=10:n_uavs=3"
    assert set(found) == {"sb3-ppo", "ekf", "ekf:robust=huber"}
    scenario = make_scenario("indoor-v0", motion="random", horizon=10, n_uavs=3)
    agent = make(f"sb3-ppo:weights={weights}", scenario)
    assert isinstance(agent, PolicyAgent)
    recorded = record(agent, scenario, torch.arange(2))
    expected = float(np.sqrt(np.square(recorded.error).mean()))
    assert found["sb3-ppo"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"worlds": 0}, "sb3-ppo: worlds=0 is not allowed: a whole number"),
        ({"steps": 0}, "sb3-ppo: steps=0 is not allowed: a whole number"),
        ({"steps": 4}, "sb3-ppo: steps=4 must divide the horizon, 10"),
        ({"minibatches": 31}, "sb3-ppo: minibatches=31 is not allowed: at most 30"),
        ({"learning_rate": 0.0}, "sb3-ppo: learning_rate=0.0 is not allowed: a number > 0"),
        ({"clip": 0.0}, "sb3-ppo: clip=0.0 is not allowed: a number > 0"),
        ({"gamma": 1.1}, "sb3-ppo: gamma=1.1 is not allowed: a number from 0 to 1"),
        ({"base": "efk"}, "unknown agent 'efk' (did you mean 'ekf'?)"),
        ({"feedback": -1.0}, "feedback=-1.0 is not allowed: a number from 0 to 1"),
        ({"variants": "nlos=0.3"}, "sb3-ppo: unknown option 'variants'"),
        ({"recurrent": True}, "sb3-ppo: unknown option 'recurrent'"),
        ({"scenario": f"{SCENARIO}:failure_rate=0.1"}, "UAVs that fail do not fit rows of one UAV"),
    ],
)
def test_one_clear_line(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as error:
        runs.start("sb3-ppo", SMALL | options, tmp_path / "run", quiet)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()
