"""``coloc live``: a team that is moving now, located from its events."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from training.cli.options import Threads

if TYPE_CHECKING:
    from agents.online import Located, OnlineLocalizer

_NEEDED = ("robot", "sensor", "stamp")
_SAVE_EVERY = 100  # steps


def live(
    setup: Annotated[
        Path,
        typer.Argument(
            metavar="SETUP", help="A **recording.yaml** with **streams**, or its folder."
        ),
    ],
    agent: Annotated[str, typer.Option(metavar="NAME", help="See **coloc agents**.")] = "ekf",
    believed: Annotated[
        str | None, typer.Option(metavar="FILE", help="As **coloc recording calibrate** writes it.")
    ] = None,
    process: Annotated[str, typer.Option(help="Motion model, as in **replay-v0**.")] = "auto",
    dt: Annotated[float, typer.Option(help="Duration of a step, s.")] = 0.1,
    start: Annotated[
        str | None, typer.Option(metavar="STAMP", help="When the first step is at the earliest.")
    ] = None,
    wait: Annotated[float, typer.Option(help="Wait so long for what comes late, s.")] = 0.0,
    horizon: Annotated[
        float, typer.Option(help="Run steps again for what comes later, up to so much, s.")
    ] = 1.0,
    prior_std: Annotated[float, typer.Option(help="Of the setup's start, m.")] = 0.5,
    state: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Go on from this belief, if it is there, and keep it."),
    ] = None,
    mavlink: Annotated[
        str | None,
        typer.Option(metavar="udp:HOST:PORT", help="Send VISION_POSITION_ESTIMATE there, too."),
    ] = None,
    threads: Threads = 1,
) -> None:
    """Locate a team from events on standard input, one JSON object a line; estimates go to
    standard output, one a robot and step.

    **Examples**

    coloc live setup.yaml --agent ekf_trust < events.jsonl > estimates.jsonl

    coloc live setup.yaml --mavlink udp:127.0.0.1:14550 --state belief.safetensors < events.jsonl
    """
    from training.threads import use_threads

    use_threads(threads)
    from agents.online import OnlineLocalizer
    from training.mavlink import MavlinkSender

    online = OnlineLocalizer(
        agent,
        setup,
        believed=believed,
        process=process,
        dt=dt,
        start=start,
        horizon=horizon,
        wait=wait,
        prior_std=prior_std,
    )
    if state is not None and state.exists():
        online.load(state)
    sender = None if mavlink is None else MavlinkSender(mavlink, len(online.robots))
    silent: set[str] = set()
    try:
        for located in _located(online, sys.stdin.buffer):
            _write(located, online)
            if sender is not None:
                sender.send(located)
            silent = _report_silent(online, silent)
            if state is not None and online.counts["steps"] % _SAVE_EVERY == 0:
                online.save(state)
    finally:
        if sender is not None:
            sender.close()
        if state is not None and online.counts["steps"]:
            online.save(state)
        sys.stdout.flush()
        _summarize(online)


def _located(online: "OnlineLocalizer", lines: Any) -> Iterator["Located"]:
    """Estimates, step by step, of events; those that are malformed are named and skipped."""
    for number, line in enumerate(lines, 1):
        text = line.decode("utf-8", errors="replace").strip()
        if not text:
            continue
        try:
            event = _event(text, number)
            robot, sensor, stamp = (event.pop(name) for name in _NEEDED)
            online.take(online.samples.read(robot, sensor, stamp, event, number), robot)
        except ValueError as error:
            online.counts["malformed"] += 1
            typer.echo(f"skipped: {' '.join(str(error).split())}", err=True)
            continue
        yield from online.steps()
    yield from online.steps(whole=True)


def _event(text: str, number: int) -> dict[str, Any]:
    """A line as an event; ValueError for anything else."""
    try:
        event = json.loads(text)
    except (ValueError, RecursionError):
        event = None
    if not isinstance(event, dict) or not all(name in event for name in _NEEDED):
        needed = ", ".join(_NEEDED)
        raise ValueError(
            f"event {number}: {text[:60]!r} is no JSON object with {needed} and what was measured"
        )
    for name in ("robot", "sensor"):
        if not isinstance(event[name], str):
            raise ValueError(f"event {number}: {name} {event[name]!r} is not a name")
    return event


def _write(located: "Located", online: "OnlineLocalizer") -> None:
    stamp = online.samples.stamp(located.stamp)
    for i, robot in enumerate(online.robots):
        found = {
            "stamp": stamp,
            "robot": robot,
            "position": located.position[i].tolist(),
            "velocity": located.velocity[i].tolist(),
            "covariance": located.covariance[i].tolist(),
        }
        if located.attitude is not None:
            found["attitude"] = located.attitude[i].tolist()
        sys.stdout.write(json.dumps(found) + "\n")
    sys.stdout.flush()


def _report_silent(online: "OnlineLocalizer", before: set[str]) -> set[str]:
    """Say who fell silent, and who is heard again."""
    now = set(online.silent())
    for robot in sorted(now - before):
        typer.echo(f"{robot}: silent", err=True)
    for robot in sorted(before - now):
        typer.echo(f"{robot}: heard again", err=True)
    return now


def _summarize(online: "OnlineLocalizer") -> None:
    """Counts, and how long steps took."""
    import numpy as np

    counts = ", ".join(f"{name} {count}" for name, count in sorted(online.counts.items()))
    typer.echo(counts or "no events", err=True)
    if online.samples.surplus:
        typer.echo(f"second of one link in a step {online.samples.surplus}", err=True)
    if online.seconds:
        median, high, most = np.percentile(online.seconds, (50, 95, 100)) * 1e3
        figures = f"median {median:.2f}, 95th percentile {high:.2f}, longest {most:.2f}"
        typer.echo(f"ms a step: {figures}", err=True)
