"""Growth, devices and spreading: measured, drawn; costs are the product of measured units."""

import json
from pathlib import Path

import pytest
import torch

from training.bench import bench
from training.bench.growth_tables import MACHINES, study_cost
from training.bench.on_device import on_device
from training.bench.sweep import Sweep, measure
from training.pool import Workers


@pytest.mark.slow
def test_a_quick_measurement_of_growth(tmp_path: Path) -> None:
    bench.bench_growth(tmp_path / "out", True, torch.device("cpu"))
    found = json.loads((tmp_path / "out" / "growth.json").read_text())
    world, ekf = found["sweeps"]
    assert world["size"] == [1, 2]
    assert ekf["agents_ms"][0] > 0
    assert all(a > b for a, b in zip(ekf["ms"], ekf["agents_ms"], strict=True))
    assert ekf["belief"][1] == 2 * ekf["belief"][0]  # four UAVs hold twice what two hold
    assert found["process_bytes"] > 1e8
    table = json.loads((tmp_path / "out" / "growth_table.json").read_text())
    assert [row[2] for row in table["rows"]] == ["worlds", "UAVs"]
    assert (tmp_path / "out" / "growth.png").stat().st_size > 1000


def test_memory_grows_with_particles() -> None:
    sweep = Sweep("pf500", "particles", (4000, 16000), "pf500", overrides=(("n_uavs", 2),))
    found = measure(sweep, torch.device("cpu"), 0.0)
    assert 3 < found["belief"][1] / found["belief"][0] < 4.1
    assert found["bytes"][1] > 2 * found["bytes"][0]


def test_a_study_costs_worlds_times_steps_times_ms() -> None:
    one = {"name": "x", "agent": "x", "key": "n_uavs", "scenario": "swarm-v0"}
    one |= {"size": [10, 200], "ms": [1.0, 36.0], "bytes": [1, 10**8], "belief": [1, 10**8]}
    growth = {"sweeps": [one], "process_bytes": 3 * 10**8, "machine": "m", "card": None}
    growth |= {"load": 9.0, "cpus": 2, "date": "d", "versions": {"torch": "t"}}
    (row,) = study_cost(growth)["rows"]
    # 10⁴ worlds × 100 steps × 36 ms = 10 h
    assert row == ["`x`", "36", "10", "1.25 h", "19 min", "0.94 min", "0.5"]
    assert len(study_cost(growth)["header"]) == len(row) == 4 + len(MACHINES)
    assert "shared" in study_cost(growth)["provenance"]


def test_devices_are_measured_by_worlds() -> None:
    found = on_device(True, torch.device("cpu"), lambda items, what: items)
    assert list(found["devices"]) == ["cpu"]
    for one in found["devices"]["cpu"].values():
        assert one["size"] == [1, 8]
        assert min(one["agent_steps_per_s"]) > 0


@pytest.mark.slow
def test_spreading_is_measured(tmp_path: Path) -> None:
    bench.bench_spread(tmp_path / "out", True, Workers(jobs=2))
    found = json.loads((tmp_path / "out" / "spread.json").read_text())
    assert found["cells"] == 20
    assert min(found[key] for key in ("start_s", "ms_per_cell", "alone_s", "spread_s")) > 0
