"""How long imports and lists take: medians over fresh processes, next to what cannot be avoided.

Processor time, not wall time: other tests may run beside these.
"""

import resource
import statistics
import subprocess
import sys
from collections.abc import Sequence

import pytest

RUNS = 5
LIMIT = 1.15  # times the library that an import rests on


def used() -> float:
    """Processor time of processes that have ended (s)."""
    own = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime


def seconds(*commands: Sequence[str]) -> list[float]:
    """Median time of each command over fresh processes, taken in turns so that load falls alike."""
    times: list[list[float]] = [[] for _ in commands]
    for _ in range(RUNS):
        for command, found in zip(commands, times, strict=True):
            before = used()
            subprocess.run([sys.executable, *command], check=True, capture_output=True)
            found.append(used() - before)
    return [statistics.median(found) for found in times]


@pytest.mark.slow
@pytest.mark.parametrize(("ours", "theirs"), [("coloc_env", "torch"), ("agents", "tensordict")])
def test_an_import_costs_what_it_rests_on(ours: str, theirs: str) -> None:
    own, base = seconds(("-c", f"import {ours}"), ("-c", f"import {theirs}"))
    assert own <= LIMIT * base, f"import {ours}: {own:.2f} s, import {theirs}: {base:.2f} s"


def loaded(code: str) -> set[str]:
    """Top packages, and scipy's parts, that some code loads."""
    script = f"{code}\nimport sys; print(*sys.modules, file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", script], check=True, capture_output=True, text=True
    )
    return set(done.stderr.split())


@pytest.mark.slow
def test_the_slow_are_not_loaded_before_they_are_used() -> None:
    slow = {"scipy.signal", "scipy.stats", "matplotlib", "torchrl", "stable_baselines3"}
    assert not loaded("import coloc_env; coloc_env.parallel_env") & (slow | {"tensordict"})
    assert not loaded("import agents; agents.Localizer") & (slow - {"torchrl"})
    assert "torch" not in loaded("import coloc_env, agents")


LISTS = ("--help", "--version", "agents", "scenarios", "tasks")


def loaded_by(*lines: str) -> set[str]:
    """What some lines of the command load, together."""
    return loaded(
        "from typer.testing import CliRunner\n"
        "from training.cli.command import app\n"
        f"for line in {lines!r}:\n"
        "    result = CliRunner().invoke(app, line.split())\n"
        "    assert result.exit_code == 0, result.output\n"
    )


def test_lists_need_no_torch() -> None:
    assert "torch" not in loaded_by(*LISTS)


def test_a_scenario_is_explained_without_what_only_agents_need() -> None:
    """Its options stand beside what computes with them: torch itself cannot be avoided."""
    assert not loaded_by("scenarios indoor-v0") & {"tensordict", "scipy", "matplotlib"}


@pytest.mark.slow
@pytest.mark.parametrize("words", LISTS)
def test_lists_take_less_than_a_second(words: str) -> None:
    (took,) = seconds(("-m", "training.cli.command", words))
    assert took < 1.0, f"coloc {words}: {took:.2f} s"
