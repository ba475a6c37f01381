"""Datasets: what other tools read is what the worlds and agents made, whole or not at all."""

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
import pyarrow.parquet
import pytest
import torch
from tensordict import TensorDict

from agents import make
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from training.dataset import plan as plans
from training.dataset import write as writing
from training.dataset.plan import Plan
from training.dataset.write import write_dataset

N, K = 3, 6


def scenario(name: str = "indoor-v0", **overrides: Any) -> Scenario:
    chosen = {"n_uavs": N, **overrides}
    return replace(make_scenario(name, **chosen), overrides=chosen)


def read(out: Path) -> tuple[Any, list[Any]]:
    """All rows in the order of seed, step and UAV; all parts' TensorDicts."""
    table = pyarrow.dataset.dataset(out / "steps").to_table()
    parts = [TensorDict.load_memmap(each) for each in sorted((out / "tensordict").iterdir())]
    return table, parts


def rows(table: Any, column: str) -> np.ndarray:
    """A column as [run, step, UAV, …]."""
    values = table[column].combine_chunks()
    if pyarrow.types.is_fixed_size_list(values.type):
        return values.flatten().to_numpy().reshape(-1, K, N, values.type.list_size)
    return values.to_numpy(zero_copy_only=False).reshape(-1, K, N)


@pytest.mark.parametrize("agent", [None, "ekf"])
def test_both_forms_hold_what_the_worlds_and_the_agent_made(
    agent: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plans, "_MOST_RUNS", 2)
    built = scenario(landmark_dropout=0.3, tdoa_anchors=4, failure_rate=0.5, horizon=K)
    write_dataset(Plan(built, 5, 7, K, agent), tmp_path)
    table, parts = read(tmp_path)
    assert [len(part["seed"]) for part in parts] == [2, 2, 1]
    whole = torch.cat([part["steps"].to_tensordict() for part in parts])
    assert rows(table, "seed")[:, 0, 0].tolist() == [7, 8, 9, 10, 11]
    np.testing.assert_array_equal(rows(table, "step")[3, :, 1], np.arange(K))
    np.testing.assert_allclose(rows(table, "time")[3, :, 1], 0.1 * np.arange(K))
    world = World(built, 5)
    seen = world.reset(7)
    localizer = make("ekf", built)
    belief = localizer.reset(seen)
    for k in range(K):
        belief, estimate = localizer.step(belief, seen)
        action = estimate.action()
        made = {f"observation.{name}": seen[name] for name in ("imu", "landmarks", "tdoa_mask")}
        made |= {"truth.position": world.truth.position, "truth.attitude": world.truth.attitude}
        made |= {"alive": world.alive, "scored": world.now.scored}
        if agent:
            made |= {"action": action, "observation.messages": seen["messages"]}
            made["reward"] = -world.score(action)[0].unsqueeze(-1)
        for name, value in made.items():
            keys = tuple(name.split("."))
            torch.testing.assert_close(whole.get(keys)[:, k], value, rtol=0, atol=0)
            np.testing.assert_array_equal(rows(table, name)[:, k], value.numpy())
        world.advance(action)
        seen = world.observation()
    assert ("action" in table.column_names) == (agent is not None)
    assert ("observation.messages" in table.column_names) == (agent is not None)
    maps = pyarrow.dataset.dataset(tmp_path / "worlds").to_table()
    assert maps.num_rows == 5 * N
    marks = maps["landmark_map"].combine_chunks().flatten().to_numpy().reshape(5, N, -1)
    np.testing.assert_array_equal(marks, world.static["landmark_map"].numpy())
    assert torch.equal(parts[2]["worlds", "prior"][0], world.static["prior"][4])


@pytest.mark.parametrize("control", ["velocity", "acceleration"])
def test_steered_uavs_follow_random_commands(
    control: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of the column ``command``, whatever else is run: velocities are integrated from them,
    within the limit."""
    monkeypatch.setattr(plans, "_MOST_RUNS", 2)
    built = scenario(control=control, a_max=1.0, horizon=12, room=(900.0, 900.0, 90.0))
    write_dataset(Plan(built, 3, 7, 12), tmp_path / "three")
    write_dataset(Plan(built, 1, 8, 12), tmp_path / "one")
    parts = read(tmp_path / "three")[1]
    steps = torch.cat([part["steps"].to_tensordict() for part in parts])
    alone = read(tmp_path / "one")[1][0]["steps"].to_tensordict()
    for name in (("command",), ("truth", "velocity"), ("observation", "imu")):
        assert torch.equal(steps.get(name)[1], alone.get(name)[0])
    command, v = steps["command"].double(), steps["truth", "velocity"]
    assert torch.equal(command[:, 0], command[:, 9])
    assert (command[:, 9] != command[:, 10]).all()

    def within(x: torch.Tensor, most: float) -> torch.Tensor:
        return x * (most / x.norm(dim=-1, keepdim=True)).clamp_max(1.0)

    if control == "velocity":
        wanted = within(within(command, 3.0)[:, :-1] - v[:, :-1], 0.1)  # 1 m/s² for 0.1 s
    else:
        wanted = within(v[:, :-1] + within(command[:, :-1] * 0.1, 0.1), 3.0) - v[:, :-1]
    torch.testing.assert_close(v.diff(dim=1), wanted, rtol=0, atol=1e-9)
    facts = json.loads((tmp_path / "one" / "dataset.json").read_text())
    (column,) = (c for c in facts["columns"] if c["name"] == "command")
    assert column["unit"] == {"velocity": "m/s", "acceleration": "m/s²"}[control]


def test_the_card_and_the_facts_say_what_is_there(tmp_path: Path) -> None:
    write_dataset(Plan(scenario(tdoa_anchors=4), 2, 3, K, "ekf"), tmp_path)
    facts = json.loads((tmp_path / "dataset.json").read_text())
    schema = pyarrow.parquet.read_schema(tmp_path / "steps" / "part-00000.parquet")
    said = {c["name"]: c for c in facts["columns"] if c["of"] == "run, step and UAV"}
    assert set(said) == set(schema.names) - {"seed", "step", "uav", "time"}
    for name, column in said.items():
        kind = schema.field(name).type
        if column["dtype"] != "bool":
            assert kind.list_size == column["numbers"]
            assert (
                str(kind.value_type) == {"float32": "float", "float64": "double"}[column["dtype"]]
            )
    assert facts["complete"] is True
    text = (tmp_path / "README.md").read_text()
    command = f"coloc dataset indoor-v0 --runs 2 --seed 3 --steps {K} --agent ekf --set n_uavs={N}"
    for words in (f"{command} --set tdoa_anchors=4", "`observation.tdoa` | 4 | float32 | m |"):
        assert words in text
    assert "Not complete" not in text
    assert pyarrow.parquet.ParquetFile(
        tmp_path / "steps" / "part-00000.parquet"
    ).num_row_groups == 2  # fmt: skip


def test_what_was_interrupted_is_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second part fails once its memmap is there: the first stays as it is."""
    monkeypatch.setattr(plans, "_MOST_RUNS", 2)
    plan = Plan(scenario(), 4, 0, K)
    write_dataset(plan, tmp_path / "whole")
    written, calls = writing.write_steps, []

    def fails(*args: Any) -> None:
        calls.append(args)
        if len(calls) == 2:
            raise OSError("the disk is full")
        written(*args)

    monkeypatch.setattr(writing, "write_steps", fails)
    with pytest.raises(OSError, match="the disk is full"):
        write_dataset(plan, tmp_path / "part")
    left = tmp_path / "part"
    assert [each.name for each in (left / "steps").iterdir()] == ["part-00000.parquet"]
    assert json.loads((left / "dataset.json").read_text())["complete"] is False
    assert "Not complete" in (left / "README.md").read_text()
    before = (left / "steps" / "part-00000.parquet").stat().st_mtime_ns
    write_dataset(plan, left)
    assert (left / "steps" / "part-00000.parquet").stat().st_mtime_ns == before
    files = sorted(p.relative_to(left) for p in left.rglob("*") if p.is_file())
    assert files == sorted(
        p.relative_to(tmp_path / "whole") for p in (tmp_path / "whole").rglob("*") if p.is_file()
    )
    for file in files:
        assert (left / file).read_bytes() == (tmp_path / "whole" / file).read_bytes(), file


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"runs": 3}, "holds a dataset of runs=2, not 3: give another folder"),
        ({"seed": 1}, "holds a dataset of seed=0, not 1"),
        ({"agent": "ekf"}, "holds a dataset of agent=None, not 'ekf'"),
        ({"scenario": scenario(landmarks=3)}, "holds a dataset of overrides="),
    ],
)
def test_another_dataset_is_not_overwritten(
    changed: dict[str, Any], words: str, tmp_path: Path
) -> None:
    plan = Plan(scenario(), 2, 0, 2)
    write_dataset(plan, tmp_path)
    with pytest.raises(ValueError, match=words):
        write_dataset(replace(plan, **changed), tmp_path)


def test_what_somebody_else_wrote_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(ValueError, match=r"holds 'thesis.tex' but no dataset.json"):
        write_dataset(Plan(scenario(), 1, 0, 1), tmp_path)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"runs": 0}, "--runs 0 is not allowed"),
        ({"steps": 0}, "--steps 0 is not allowed: 1 to 1000 for indoor-v0"),
        ({"steps": 1001}, "--steps 1001 is not allowed"),
    ],
)
def test_what_cannot_be_run_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Plan(**{"scenario": scenario(), "runs": 1, "steps": 1, **wrong})


def test_parts_are_about_as_large_as_they_should_be() -> None:
    plan = Plan(scenario(n_uavs=6), 1000, 0, 1000)
    numbers = sum(c.leaf.width * c.dtype.itemsize for c in plan.columns if not c.world)
    size = plan.runs_in_part * 6 * 1000 * numbers
    assert 0.5 * plans.PART_BYTES < size <= plans.PART_BYTES
    assert sum(len(seeds) for _, seeds in plan.parts()) == 1000
    assert plan.count == len(list(plan.parts()))


def test_a_plane_and_a_recordings_start_are_written(tmp_path: Path) -> None:
    """Two dimensions: a heading, and positions of two numbers."""
    built = make_scenario("wsn-v0")
    write_dataset(Plan(built, 2, 0, 3), tmp_path)
    part = TensorDict.load_memmap(tmp_path / "tensordict" / "part-00000")
    assert part["steps", "truth", "position"].shape == (2, 3, 1, 2)
    assert part["steps", "truth", "attitude"].shape == (2, 3, 1, 1)


@pytest.mark.slow
def test_a_process_that_is_killed_leaves_no_half_of_a_part(tmp_path: Path) -> None:
    out = tmp_path / "killed"
    words = ["dataset", "indoor-v0", "--runs", "40", "--steps", "300", "--out", str(out)]
    command = [sys.executable, "-m", "training.cli.command", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(out.glob("tensordict/.part-*/**/*.memmap")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = sorted(out.glob("steps/*.parquet"))
    for path in done:
        assert pyarrow.parquet.read_table(path).num_rows
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    table = pyarrow.dataset.dataset(out / "steps").to_table(columns=["seed"])
    assert table.num_rows == 40 * 300 * 6
    assert sorted(set(table["seed"].to_pylist())) == list(range(40))
    assert not list(out.rglob(".*partial*"))
