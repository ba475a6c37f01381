"""What needs an extra that is not installed says so in one line, before anything runs."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from training.cli.command import app
from training.evaluation import frames

ROOM = ("indoor-v0", "--set", "n_uavs=2", "--set", "horizon=5")
COMMANDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "report": ("plotly", ("evaluate", *ROOM, "--agents", "ekf", "--report")),
    "view": ("rerun", ("view", *ROOM, "--agent", "ekf", "--steps", "5")),
    "dataset": ("pyarrow", ("dataset", *ROOM, "--runs", "1")),
    "ray": ("ray", ("train", "nnhpff", "--ray", "auto")),
}


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of libraries, as Python hides them
@pytest.mark.parametrize("extra", COMMANDS)
def test_a_command_names_the_extra(
    extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, words = COMMANDS[extra]
    for name in (module, *(one for one in sys.modules if one.startswith(f"{module}."))):
        monkeypatch.setitem(sys.modules, name, None)
    out = tmp_path / ("out.rrd" if extra == "view" else "out")
    done = CliRunner().invoke(app, [*words, "--out", str(out)])
    assert done.exit_code == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.endswith(f"pip install 'coloc-env[{extra}]'\n")
    assert done.stderr.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(("module", "make"), [("pandas", "dataframe"), ("xarray", "dataset")])
def test_tables_name_the_extra(module: str, make: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    nothing: Any = SimpleNamespace()
    with pytest.raises(ValueError, match=rf"{module}: pip install 'coloc-env\[frames\]'"):
        getattr(frames, make)(nothing)
