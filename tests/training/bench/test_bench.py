"""The benchmark runs and writes its numbers; how fast is not a matter for tests."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from agents import LOCALIZERS, make
from agents.particle import resampling
from agents.particle import update as particle_update
from coloc_env.scenarios import make_scenario
from training.bench.agents import TITLES, Task, tasks
from training.bench.bench import NAMES, bench
from training.bench.parts import PROFILED, REST, Stopwatch, _watching, missing_parts, step_parts


@pytest.mark.slow
def test_a_quick_benchmark_writes_numbers_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    threads = torch.get_num_threads()
    bench(tmp_path / "bench", quick=True)
    assert torch.get_num_threads() == threads
    assert {file.name for file in (tmp_path / "bench").iterdir()} == set(NAMES)
    results = json.loads((tmp_path / "bench" / "bench.json").read_text())
    for name in ("World B=1", "World B=1024", "PettingZoo N=6", "TorchRL rollout B=32"):
        figures = results["environments"][name]
        assert figures["agent_steps_per_s"] >= figures["median"] > 0
    assert results["memory_mb"] > 0
    assert all(ratio > 0 for ratio in results["ratios"].values())
    assert results["machine"]["threads"] == 1
    assert len(results["agents"]) == 1
    printed = capsys.readouterr().out
    assert "PettingZoo N=200" in printed
    assert "memory of 1024 worlds" in printed


@pytest.mark.parametrize("task", list(tasks()), ids=lambda task: f"{task.group}-{task.key}")
def test_every_localizer_is_timed_where_it_can_be(task: Task) -> None:
    localizer = make(task.agent, make_scenario(task.scenario, **dict(task.overrides)))
    assert task.group in TITLES
    assert localizer.believed.arena.n_uavs > 1


def test_no_localizer_is_left_out() -> None:
    assert {task.agent.split(":")[0] for task in tasks()} == set(LOCALIZERS)


def test_an_unwritable_folder_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is not a folder"):
        bench(tmp_path / "file", quick=True)


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("ekf", set()),
        ("apf", {"noise", "likelihood", "weights", "moments", "resampling"}),
        ("pfnn", {"noise", "likelihood", "weights", "resampling", "corrector network"}),
        ("apf:proposal=ekf", {"noise", "likelihood", "weights", "proposal", "Gaussian update"}),
        ("pf_trust", {"likelihood", "Gaussian update", "trust features", "trust networks"}),
    ],
)
def test_the_time_of_a_step_is_put_down_to_its_parts(name: str, parts: set[str]) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    found = step_parts(make(name, scenario), scenario)
    assert parts | {"messages", "prediction", "linearization", REST} <= set(found)
    assert list(found)[-1] == REST
    assert min(found.values()) > 0


def test_no_part_has_gone() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    gone = missing_parts(make(name, scenario) for name in PROFILED)
    assert not gone, f"renamed or removed, but still in training/bench/parts.py: {gone}"


def test_watching_leaves_everything_as_it_was() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2)
    localizer: Any = make("pfnn", scenario)
    before = particle_update.normal, resampling.moments, localizer.resampling.weigh
    with _watching(localizer, Stopwatch()):
        during = particle_update.normal, resampling.moments, localizer.resampling.weigh
    assert all(one is not other for one, other in zip(before, during, strict=True))
    assert (particle_update.normal, resampling.moments, localizer.resampling.weigh) == before
