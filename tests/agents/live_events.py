"""Recordings as events, and what replay makes of the same data."""

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from agents import make
from coloc_env import make_scenario
from coloc_env.datasets.corrections import corrected
from coloc_env.datasets.grid import aligned, common_grid
from coloc_env.datasets.open_format import read_recording, write_recording
from coloc_env.datasets.recording import Recording, Table, Track
from coloc_env.scenarios.replay import own_beliefs, own_team
from training.evaluation.rollout import rollout


def first_seconds(recording: Recording, seconds: float, skip: float = 0.0) -> Recording:
    """A recording's seconds from ``skip`` on after its truth begins."""
    begins = max(int(track.time[0]) for track in recording.truth) + round(skip * 1e9)
    ends = begins + round(seconds * 1e9)

    def cut(each: Any) -> Any:
        there = (each.time >= begins) & (each.time <= ends)
        names = ["time", *(("values",) if isinstance(each, Table) else ("position", "attitude"))]
        names += [
            n for n in ("velocity", "gyro_bias", "accel_bias") if getattr(each, n, None) is not None
        ]
        return replace(each, **{name: getattr(each, name)[there] for name in names})

    truth: tuple[Track, ...] = tuple(map(cut, recording.truth))
    streams = {name: tuple(map(cut, team)) for name, team in recording.streams.items()}
    return replace(recording, truth=truth, streams=streams)


def events_of(folder: Path) -> list[dict[str, Any]]:
    """All rows of all tables but truth, in the order of their stamps."""
    rows = []
    for path in sorted(folder.glob("*/*.csv")):
        if path.stem == "truth":
            continue
        with path.open(encoding="utf-8") as file:
            for row in csv.DictReader(file):
                event: dict[str, Any] = {"robot": path.parent.name, "sensor": path.stem}
                for name, text in row.items():
                    if text:
                        event["to" if name in ("robot", "landmark") else name] = (
                            text if name in ("to", "robot", "landmark") else _value(text)
                        )
                rows.append(event)
    return sorted(rows, key=lambda row: row["stamp"])


def lines_of(events: list[dict[str, Any]]) -> Iterator[str]:
    """Events as JSON, one a line."""
    return (json.dumps(event) + "\n" for event in events)


def written(recording: Recording, folder: Path) -> Path:
    write_recording(recording, folder)
    return folder


def replayed(
    folder: Path, agent: str, dt: float, steps: int, **chosen: Any
) -> tuple[int, torch.Tensor, list[np.ndarray], list[np.ndarray]]:
    """Start (ns), prior, positions and covariances of ``replay-v0``'s steps."""
    scenario = make_scenario("replay-v0", path=str(folder), dt=dt, **chosen)
    recording = read_recording(folder)
    model = own_beliefs(recording, folder / "recording.yaml", chosen.get("believed"))
    recording = corrected(recording, model)
    team = own_team(recording, model)
    whole = common_grid(recording, dt, (team.driver,) if team.driver else ())
    start = aligned(whole, recording, tuple(team.sensors)).start
    prior, places, covariances = None, [], []
    for step in rollout(make(agent, scenario), scenario, torch.tensor([3]), steps):
        prior = step.observation["prior"][0] if prior is None else prior
        assert step.estimate is not None
        places.append(step.estimate.position[0].double().numpy())
        covariances.append(step.estimate.covariance[0].double().numpy())
    assert prior is not None
    return start, prior, places, covariances


def _value(text: str) -> Any:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        return text
