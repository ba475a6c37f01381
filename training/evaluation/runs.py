"""The runs of an evaluation in one file, ``runs.safetensors``: what reports and viewers are made
of, beside ``results.json``."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from coloc_env.json_files import read_json
from coloc_env.staging import recover
from training.evaluation.metrics import Flags, Floats, rmse_per_step
from training.evaluation.record import Arrays
from training.evaluation.results import Evaluation

FILE = "runs.safetensors"


@dataclass(frozen=True, eq=False)
class Method:
    """An agent's runs: ``error`` (m) and ``nees`` [R, K, N]; of the first run ``offset`` p̂ − p
    [K, N, d] (m) and ``covariance`` [K, N, d, d] (m²)."""

    error: Floats
    nees: Floats
    offset: Floats
    covariance: Floats


@dataclass(frozen=True, eq=False)
class Runs:
    """What one evaluation left: ``summary`` is its results.json.

    ``truth`` [K, N, d] (m), ``links`` [K, N, N] (j reaches i) and ``places`` of landmarks and
    anchors are those of the first run; ``scored`` [R, K, N]; ``low``, ``high``: the arena (m);
    ``bound`` [K], root mean square (m).
    """

    name: str
    summary: dict[str, Any]
    dt: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    truth: Floats
    scored: Flags
    links: Flags
    places: dict[str, Floats]
    bound: Floats | None
    methods: dict[str, Method]


def of(results: Evaluation, name: str) -> Runs:
    """The runs of an evaluation that was just made."""
    worlds, arena = results.worlds, results.scenario.arena
    n, dim = arena.n_uavs, arena.dim
    steps = worlds.truth.shape[1]
    links = np.zeros((steps, n, n), bool) if worlds.links is None else worlds.links
    methods = {}
    for agent, one in results.agents.items():
        covariance = one.covariance
        if covariance is None:
            covariance = np.full((steps, n, dim, dim), np.nan, np.float32)
        methods[agent] = Method(one.error, one.nees, one.offset[0], covariance)
    return Runs(
        name,
        results.summary,
        arena.dt,
        arena.low,
        arena.high,
        worlds.truth[0],
        worlds.scored,
        links,
        worlds.places,
        _bound(results),
        methods,
    )


def _bound(results: Evaluation) -> Floats | None:
    """The bound at each step [K], root mean square over runs and UAVs (m)."""
    known = results.bound
    if known is None:
        return None
    return rmse_per_step(known.mse.numpy() ** 0.5, known.scored.numpy())


def write(runs: Runs, folder: Path) -> None:
    """Write all but the summary."""
    arrays: Arrays = {"truth": runs.truth.astype(np.float32), "scored": runs.scored}
    arrays["links"] = runs.links
    arrays |= {f"places.{name}": values for name, values in runs.places.items()}
    if runs.bound is not None:
        arrays["bound"] = runs.bound.astype(np.float32)
    for i, one in enumerate(runs.methods.values()):
        for name in ("error", "nees", "offset", "covariance"):
            arrays[f"{i}.{name}"] = getattr(one, name).astype(np.float32)
    facts = {
        "agents": list(runs.methods),
        "dt": runs.dt,
        "dim": len(runs.low),
        "low": list(runs.low),
        "high": list(runs.high),
    }
    solid = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
    (folder / FILE).write_bytes(save(solid, {"coloc": json.dumps(facts)}))


def read(folder: Path) -> Runs:
    """What an evaluation left in a folder. ValueError, in one line, for one that holds no whole
    evaluation."""
    recover(folder)
    if not (folder / "results.json").is_file():
        raise ValueError(f"{folder} holds no results.json: a folder of `coloc evaluate` is needed")
    needed = {"scenario": str, "seed": int, "runs": int, "steps": int, "agents": dict}
    summary = read_json(folder / "results.json", "an evaluation's results", needed)
    path = folder / FILE
    if not path.is_file():
        raise ValueError(f"{folder} holds no {FILE}: evaluate again with this version of coloc")
    try:
        with safe_open(path, "np") as file:
            facts = json.loads((file.metadata() or {}).get("coloc", "null"))
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, ValueError, OSError) as error:
        raise ValueError(f"{path} is no whole file of runs: {error}") from None
    try:
        return _read(folder.name, summary, facts, arrays)
    except (KeyError, TypeError, IndexError, AttributeError, ValueError):
        raise ValueError(f"{path} is no file of runs: arrays or facts are missing") from None


def _read(name: str, summary: dict[str, Any], facts: dict[str, Any], arrays: Arrays) -> Runs:
    steps, n, dim = arrays["truth"].shape
    runs = len(arrays["scored"])
    shapes: dict[str, tuple[int, ...]] = {
        "error": (runs, steps, n),
        "nees": (runs, steps, n),
        "offset": (steps, n, dim),
    }
    shapes["covariance"] = (steps, n, dim, dim)
    methods = {}
    for i, agent in enumerate(facts["agents"]):
        parts = {key: arrays[f"{i}.{key}"] for key in shapes}
        if any(parts[key].shape != shape for key, shape in shapes.items()):
            raise ValueError
        methods[str(agent)] = Method(**parts)
    if len(facts["low"]) != dim or len(facts["high"]) != dim:
        raise ValueError
    return Runs(
        name,
        summary,
        float(facts["dt"]),
        tuple(map(float, facts["low"])),
        tuple(map(float, facts["high"])),
        arrays["truth"],
        arrays["scored"].astype(bool),
        arrays["links"].astype(bool),
        {k.removeprefix("places."): v for k, v in arrays.items() if k.startswith("places.")},
        arrays.get("bound"),
        methods,
    )
