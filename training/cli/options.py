"""Options that several commands have in common, and what they mean."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from training.threads import use_threads

if TYPE_CHECKING:
    from coloc_env.scenario import Scenario
    from training.pool import Workers

ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="See **coloc scenarios**.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override one setting of the scenario; repeat it for more. "
        "**coloc scenarios SCENARIO** lists them.",
    ),
]
Data = Annotated[
    Path | None,
    typer.Option("--data", metavar="DIR", help="Folder of recordings (sets COLOC_DATA)."),
]
Seed = Annotated[int, typer.Option(help="Seed of the first world.")]
Threads = Annotated[int, typer.Option(help="CPU threads of torch.")]
Device = Annotated[
    str,
    typer.Option(metavar="NAME", help="Where worlds, filters and networks are: **cpu**, **cuda**."),
]
Jobs = Annotated[int, typer.Option(help="Processes at once, of one thread each.")]
Ray = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="Work on the Ray cluster at HOST:PORT; **auto**: the one that runs on this machine.",
    ),
]


def build_scenario(
    name: str, settings: list[str] | None, threads: int, data: Path | None
) -> "Scenario":
    """Prepare the process, and build a scenario from a command line."""
    use_threads(threads)
    if data is not None:
        os.environ["COLOC_DATA"] = str(data)
    from dataclasses import replace

    from coloc_env.scenarios import make_scenario, parse_overrides

    overrides = parse_overrides(name, settings or ())
    return replace(make_scenario(name, **overrides), overrides=overrides)


@contextmanager
def workers_of(jobs: int, ray: str | None) -> Iterator["Workers"]:
    """Who computes, connected; what is not there is said before anything runs."""
    from training.pool import Workers

    workers = Workers(jobs, ray)
    if ray is None:
        yield workers
        return
    from training.cluster import connected

    with connected(ray):
        yield workers


def require_device(device: str, jobs: int, ray: str | None) -> None:
    """Raise ValueError for a device that is not there, or that several processes would share."""
    from training.devices import checked_device

    checked_device(device)
    if device != "cpu" and (jobs > 1 or ray is not None):
        raise ValueError(f"--device {device}: one process uses it, not those of --jobs or --ray")


def require_seed(seed: int) -> None:
    """Raise ValueError for a seed that is none."""
    if not 0 <= seed < 2**62:
        raise ValueError(f"--seed {seed} is not allowed: a whole number from 0 to 2^62")
