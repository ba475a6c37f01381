"""``coloc bench``: how fast worlds, both faces and localizers are, beside other environments.

One CPU thread. Everything is timed in turn, round after round, so that a neighbour on the machine
slows all alike; the figure is the best round, the median beside it shows how noisy it was.
"""

import json
import platform
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from coloc_env.staging import staged_folder
from training.bench.agents import TITLES, time_agents
from training.bench.cases import cases
from training.bench.figures import FIGURES, draw
from training.bench.growth import growth
from training.bench.growth_figures import device_figure, growth_figure
from training.bench.growth_tables import growth_table, study_cost
from training.bench.learning import learning_cases
from training.bench.on_device import on_device
from training.bench.peers import peers
from training.bench.rounds import rounds
from training.bench.spread import spread, spread_table
from training.pool import Workers

T = TypeVar("T")
NAMES = (*FIGURES, "bench.json")
_RATIOS = {  # ours to theirs, six agents each
    "PettingZoo / mpe2": ("PettingZoo N=6", "mpe2 simple_spread B=1"),
    "World / VMAS, B=1": ("World B=1", "VMAS simple_spread B=1"),
    "World / VMAS, B=32": ("World B=32", "VMAS simple_spread B=32"),
    "World / VMAS, B=1024": ("World B=1024", "VMAS simple_spread B=1024"),
}
_PACKAGES = ("coloc-env", "torch", "tensordict", "torchrl", "pettingzoo", "mpe2", "vmas")
_MEMORY = """
import torch
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
def peak(size):
    world = World(make_scenario("indoor-v0"), size)
    world.reset(0)
    for _ in range(20):
        world.step(torch.zeros(size, 6, 9))
        world.observation()
    status = open("/proc/self/status").read()
    return int(status.split("VmHWM:")[1].split()[0])
before = peak(1)
print(peak(1024) - before)
"""


def bench(out: Path, quick: bool = False, agents: bool = True) -> None:
    """Measure, print the tables, and write ``bench.json`` and figures into ``out``."""
    with staged_folder(out, NAMES) as folder:
        results = run_bench(quick, agents)
        show(results)
        draw(results, folder)
        _write(results, folder / "bench.json")
    Console().print(f"written to {out}", highlight=False)


def bench_growth(out: Path, quick: bool, device: torch.device) -> None:
    """Write ``growth.json``, its figure and its table, and a table of what a study costs."""
    names = ("growth.json", "growth.png", "growth_table.json", "study_cost.json")
    with staged_folder(out, names) as folder:
        results = growth(quick, device, _track)
        _write(results, folder / names[0])
        growth_figure(results).savefig(folder / names[1], dpi=110)
        _write(growth_table(results), folder / names[2])
        _write(study_cost(results), folder / names[3])
    Console().print(f"written to {out}", highlight=False)


def bench_device(out: Path, quick: bool, device: torch.device) -> None:
    """Write ``device.json`` and its figure."""
    with staged_folder(out, ("device.json", "device.png")) as folder, _one_thread():
        results = on_device(quick, device, _track)
        _write(results, folder / "device.json")
        device_figure(results).savefig(folder / "device.png", dpi=110)
    Console().print(f"written to {out}", highlight=False)


def bench_spread(out: Path, quick: bool, workers: Workers) -> None:
    """Write ``spread.json``, and its table."""
    names = ("spread.json", "spread_table.json")
    with staged_folder(out, names) as folder, _one_thread():
        results = spread(quick, workers)
        _write(results, folder / names[0])
        _write(spread_table([results]), folder / names[1])
    shown = ("start_s", "ms_per_cell", "alone_s", "spread_s", "speed_up")
    lines = [(name, f"{results[name]:.3g}") for name in shown]
    Console().print(_table(("", "measured"), lines), highlight=False)


def _write(results: dict[str, Any], file: Path) -> None:
    file.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def run_bench(quick: bool = False, agents: bool = True) -> dict[str, Any]:
    """All measurements as plain numbers.

    ``environments``: per case the best and the median round in agent-steps per second, and the best
    round's ms per step; ``ratios`` to peers where they are installed; ``memory_mb``: how much the
    process grows for 1024 worlds; ``agents``, ``swarms``, ``relative``, ``particles``, ``teams``: a
    team's step in ms; ``parts``: where it goes, in ms by part.
    """
    with _one_thread():
        chosen = [*cases(), *learning_cases(), *peers()]
        turns = _track(range(2 if quick else 16), "environments")
        environments = rounds(chosen, turns)
        localizers = time_agents(quick, _track) if agents else {}
    best = {name: figures["agent_steps_per_s"] for name, figures in environments.items()}
    return {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "python": platform.python_version(),
            "threads": 1,
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
            "versions": _versions(),
        },
        "quick": quick,
        "environments": environments,
        "ratios": {
            name: best[ours] / best[theirs]
            for name, (ours, theirs) in _RATIOS.items()
            if theirs in best
        },
        "memory_mb": _memory(),
        **localizers,
    }


def show(results: dict[str, Any]) -> None:
    """Print what was measured."""
    console = Console()
    if not console.is_terminal:
        console.width = 120
    rows = [
        (name, _engineering(f["agent_steps_per_s"]), _engineering(f["median"]), f"{f['ms']:.3g}")
        for name, f in results["environments"].items()
    ]
    header = ("", "agent-steps/s", "median", "ms a step")
    console.print(_table(header, rows), highlight=False)
    ratios = [(name, f"{ratio:.1f} ×") for name, ratio in results["ratios"].items()]
    if results["memory_mb"] is not None:
        ratios.append(("memory of 1024 worlds", f"{results['memory_mb']:.0f} MB"))
    console.print(_table(("", "ratio"), ratios), highlight=False)
    for key, title in TITLES.items():
        lines = [(name, _ms(ms)) for name, ms in results.get(key, {}).items()]
        if lines:
            console.print(_table((title, "ms a team's step"), lines), highlight=False)
    for name, parts in results.get("parts", {}).items():
        total = sum(parts.values())
        shares = [(part, _ms(ms), f"{ms / total:.0%}") for part, ms in parts.items()]
        console.print(_table((name, "ms", "share"), shares), highlight=False)


# ------------------------------------------------------------------ parts


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _track(items: Sequence[T], what: str) -> Iterable[T]:
    """A progress bar on stderr, where that is a terminal."""
    console = Console(stderr=True)
    return track(items, what, console=console, transient=True, disable=not console.is_terminal)


def _memory() -> float | None:
    """How many MB a fresh process grows at its peak for 1024 worlds; None where not known."""
    if not sys.platform.startswith("linux"):
        return None
    command = [sys.executable, "-c", _MEMORY]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return int(printed) * 1024 / 1e6


def _versions() -> dict[str, str | None]:
    def of(package: str) -> str | None:
        try:
            return version(package)
        except PackageNotFoundError:
            return None

    return {package: of(package) for package in _PACKAGES}


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for i, title in enumerate(header):
        table.add_column(title, justify="right" if i else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _engineering(value: float) -> str:
    """Three digits and a unit: 86.2 k, 1.03 M."""
    for scale, unit in ((1e6, " M"), (1e3, " k")):
        if value >= scale:
            return f"{value / scale:.3g}{unit}"
    return f"{value:.3g}"


def _ms(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
