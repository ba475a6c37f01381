"""The benchmark runs and writes what it says; how fast is not a matter for tests."""

import json
from pathlib import Path

import pytest
import torch

from training.bench import NAMES, bench


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


def test_an_unwritable_folder_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is not a folder"):
        bench(tmp_path / "file", quick=True)
