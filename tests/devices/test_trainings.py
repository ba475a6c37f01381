"""Trainings on a card that is only pretended: worlds, networks, buffers and losses are on it, and
what is learned is what is learned on the CPU."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from pretended import OnCard, card
from safetensors.torch import load_file

from agents.tasks import make_task
from agents.tasks.registry import TASKS
from coloc_env.json_files import read_json
from training.evaluation.evaluate import silent
from training.learning import run, trust
from training.learning.registry import TRAININGS
from training.learning.tasks.environment import environment

ROOM = "indoor-v0:n_uavs=2:horizon=20:motion=random"
LEAST = {"worlds": 1, "epochs": 1, "score_runs": 0}
SWARM = LEAST | {
    "scenario": "swarm-v0:n_uavs=10:anchor_share=0.4:horizon=10:comm_radius=9000",
    "variants": "nlos=0.3",
    "steps": 5,
}
POLICY = LEAST | {"scenario": ROOM, "steps": 5, "passes": 1, "minibatches": 2, "hidden": 8}
TASK = {"worlds": 2, "epochs": 1, "hidden": 8, "score_worlds": 0}
TASK_PPO = TASK | {"passes": 1, "minibatches": 2}
KINDS: dict[str, dict[str, Any]] = {
    "pfnn": LEAST | {"scenario": ROOM, "passes": 1, "minibatch": 100},
    "pf_corrected": LEAST
    | {
        "scenario": "indoor-v0:n_uavs=2:horizon=4",
        "variants": "landmarks=2:anchors=4",
        "steps": 4,
        "particles": 20,
    },
    "dlspf": LEAST | {"scenario": ROOM.replace("20", "24"), "passes": 1},
    "nnhpff": LEAST
    | {
        "scenario": "wsn-v0:horizon=20",
        "variants": "case=1",
        "mains": "pf:particles=60",
        "passes": 1,
    },
    "trust": LEAST | {"scenario": "indoor-v0:n_uavs=2:horizon=5", "steps": 5},
    "stdcl": SWARM,
    "stdcl_loop": SWARM,
    "mappo": POLICY,
    "ippo": POLICY | {"recurrent": False, "base": "none"},
    "task-mappo": TASK_PPO | {"task": "relay-v0:horizon=6", "network": "recurrent"},
    "task-ippo": TASK_PPO
    | {"task": "track-v0:horizon=6", "network": "attention", "moves": "headings"},
    "task-qmix": TASK | {"task": "schedule-v0:horizon=6", "updates": 3, "minibatch": 8},
}
ON_CPU = ("sb3-ppo", "task-sb3-ppo")
SAME = 1e-5


def test_every_training_is_here() -> None:
    assert {*KINDS, *ON_CPU} == set(TRAININGS)


@pytest.mark.slow
@pytest.mark.parametrize("options", ["", ":obs=dict:telemetry=messages", ":reward=sigma"])
@pytest.mark.parametrize("name", TASKS)
def test_a_tasks_worlds_are_the_cpus(name: str, options: str) -> None:
    """Observations, rewards and what a critic sees, of actions that are all 0 (the first choice);
    with what each call was worth where agents call."""
    difference = hasattr(make_task(name), "targets_of") and not options

    def seen(device: str) -> list[torch.Tensor]:
        env = environment(
            make_task(name + options),
            2,
            3,
            device,
            hold=1,
            difference=difference,
            network="attention",
        )
        now, found = env.reset(), []
        for _ in range(3):
            now["uav", "action"] = torch.zeros_like(env.full_action_spec["uav", "action"].zero())
            after = env.step(now)["next"]
            found += [value for _, value in sorted(after.items(True, True), key=str_of)]
            now = after.exclude(("uav", "reward"))
        return found

    here = seen("cpu")
    with card():
        for one, other in zip(seen("cuda"), here, strict=True):
            assert isinstance(one, OnCard)
            torch.testing.assert_close(one.inner, other, rtol=SAME, atol=SAME)


def str_of(item: tuple[Any, torch.Tensor]) -> str:
    return str(item[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_what_is_learned_is_the_cpus(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trust, "VARIANTS", ("nlos=0.3",))
    here = load_file(run.start(name, KINDS[name], tmp_path / "cpu", silent))
    losses: list[torch.Tensor] = []
    whole = torch.Tensor.backward

    def backward(loss: torch.Tensor, *args: Any, **named: Any) -> None:
        losses.append(loss)
        whole(loss, *args, **named)

    monkeypatch.setattr(torch.Tensor, "backward", backward)
    with card():
        there = load_file(run.start(name, KINDS[name], tmp_path / "card", silent, device="cuda"))
    assert losses
    assert all(isinstance(loss, OnCard) for loss in losses)
    for key, value in here.items():
        torch.testing.assert_close(there[key], value, rtol=SAME, atol=SAME)
    config = read_json(tmp_path / "card" / "run.json", "a run", {})
    assert config["device"] == "cuda"
    assert config["command"].endswith(f"--device cuda --out {tmp_path / 'card'}")


def test_a_training_that_knows_the_cpu_alone(tmp_path: Path) -> None:
    for name in ON_CPU:
        with card(), pytest.raises(ValueError, match=f"{name} trains on the CPU: --device cuda is"):
            run.start(name, {}, tmp_path / "out", silent, device="cuda")
    assert not (tmp_path / "out").exists()


def test_a_run_goes_on_where_it_was_started(tmp_path: Path) -> None:
    """On a machine without a card it says so, in a line that names the file."""
    started = {"training": "pfnn", "options": {}, "command": "", "threads": 1, "device": "cuda:7"}
    file = tmp_path / "run.json"
    file.write_text(json.dumps(started), encoding="utf-8")
    with pytest.raises(ValueError, match=f"^{file}: --device cuda:7 is not there: cpu") as said:
        run.resume(tmp_path, silent)
    assert "\n" not in str(said.value)
