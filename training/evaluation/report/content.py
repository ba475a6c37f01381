"""What a report shows, as plain data: tables, curves, the player's frames, the worst moments."""

import base64
import shlex
from collections.abc import Iterator
from typing import Any

import numpy as np

from coloc_env.options import set_words, typed
from coloc_env.render.style import UAV_COLOURS
from training.evaluation import metrics
from training.evaluation.ellipsoids import half_axes, in_space
from training.evaluation.metrics import Floats
from training.evaluation.runs import Method, Runs
from training.evaluation.tables import COLUMNS

_FRAMES = 400  # of the player, at most
_POINTS = 1500  # of a curve, at most
_WORST = 5  # moments an agent
_APART = 5.0  # s between two of them
_SHOWN_UAVS = 12  # curves of single UAVs, at most


def content(every: list[Runs]) -> dict[str, Any]:
    """All that the page is made of, as JSON holds it. ValueError for two evaluations of one
    name."""
    names = [runs.name for runs in every]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"two evaluations are named {name!r}: rename one of the folders")
    return {
        "titles": COLUMNS,
        "rows": [row for runs in every for row in _rows(runs)],
        "runs": [_run(runs) for runs in every],
    }


def _rows(runs: Runs) -> Iterator[dict[str, Any]]:
    bound = (runs.summary.get("bound") or {}).get("rmse")
    if bound is not None:
        yield {"run": runs.name, "agent": "bound", "values": {"rmse": bound}}
    for agent, found in runs.summary["agents"].items():
        values = {key: found.get(key) for key in COLUMNS}
        yield {"run": runs.name, "agent": agent, "values": values}


def _run(runs: Runs) -> dict[str, Any]:
    steps, n, dim = runs.truth.shape
    scored = runs.scored
    thin = max(1, -(-steps // _POINTS))
    time = np.arange(steps) * runs.dt
    low, high = metrics.nees_bands(dim, scored)
    return {
        "name": runs.name,
        "command": command(runs),
        "settings": _settings(runs),
        "dim": dim,
        "uavs": n,
        "time": _numbers(time[::thin]),
        "band": [_numbers(low[::thin]), _numbers(high[::thin])],
        "bound": None if runs.bound is None else _numbers(runs.bound[::thin]),
        "agents": {
            name: _curves(runs, one, thin) | {"colour": UAV_COLOURS[i % len(UAV_COLOURS)]}
            for i, (name, one) in enumerate(runs.methods.items())
        },
        "worst": [
            moment for name, one in runs.methods.items() for moment in worst(runs, name, one)
        ],
        "player": _player(runs),
    }


def _settings(runs: Runs) -> dict[str, str]:
    summary = runs.summary
    overrides = {key: typed(value) for key, value in (summary.get("overrides") or {}).items()}
    last = summary["seed"] + summary["runs"] - 1
    return {
        "scenario": summary["scenario"],
        **overrides,
        "runs": f"{summary['runs']}, seeds {summary['seed']} to {last}",
        "steps": f"{summary['steps']} of {runs.dt:g} s",
        "UAVs": str(runs.truth.shape[1]),
    }


def command(runs: Runs) -> str:
    """What repeats the evaluation, as a shell reads it."""
    summary = runs.summary
    words = ["coloc", "evaluate", summary["scenario"], "--agents", ",".join(summary["agents"])]
    words += ["--runs", str(summary["runs"]), "--seed", str(summary["seed"])]
    words += set_words(summary.get("overrides") or {})
    return shlex.join([*words, "--out", runs.name])


def _curves(runs: Runs, one: Method, thin: int) -> dict[str, Any]:
    """Error and NEES over time, of all and of each UAV, and the distribution of errors."""
    errors = one.error[runs.scored]
    share = np.concatenate((np.linspace(0, 0.99, 100), [0.995, 0.999, 1.0]))
    quantiles = np.quantile(errors, share) if errors.size else np.full(len(share), np.nan)
    n = min(one.error.shape[2], _SHOWN_UAVS)
    of_uav = [
        metrics.rmse_per_step(one.error[..., i : i + 1], runs.scored[..., i : i + 1])[::thin]
        for i in range(n)
    ]
    return {
        "error": _numbers(metrics.rmse_per_step(one.error, runs.scored)[::thin]),
        "uav_error": [_numbers(values) for values in of_uav],
        "nees": _numbers(metrics.mean_per_step(one.nees, runs.scored)[::thin]),
        "share": _numbers(100 * share),
        "quantile": _numbers(quantiles),
    }


def worst(runs: Runs, name: str, one: Method) -> list[dict[str, Any]]:
    """An agent's largest errors, at least 5 s apart where they are one UAV's in one run."""
    error = np.where(runs.scored, one.error, -np.inf).astype(np.float64)
    apart, found = max(1, round(_APART / runs.dt)), []
    for _ in range(_WORST):
        run, step, uav = np.unravel_index(np.argmax(error), error.shape)
        largest = error[run, step, uav]
        if not np.isfinite(largest):
            break
        found.append(
            {
                "agent": name,
                "run": int(run),
                "seed": int(runs.summary["seed"] + run),
                "uav": int(uav),
                "step": int(step),
                "time": round(float(step * runs.dt), 6),
                "error": float(largest),
                "nees": _plain(one.nees[run, step, uav]),
            }
        )
        error[run, max(0, step - apart) : step + apart, uav] = -np.inf
    return found


# ------------------------------------------------------------------ the player


def _player(runs: Runs) -> dict[str, Any]:
    """The first run, frame by frame: float32 arrays [frames, N, …] in base 64."""
    steps = len(runs.truth)
    frames = np.unique(np.linspace(0, steps - 1, min(steps, _FRAMES)).round().astype(int))
    estimates, roots = {}, {}
    for name, one in runs.methods.items():
        estimates[name] = _packed(in_space(runs.truth[frames] + one.offset[frames]))
        roots[name] = _packed(half_axes(one.covariance[frames]))
    return {
        "frames": len(frames),
        "steps": frames.tolist(),
        "time": _numbers(frames * runs.dt),
        "truth": _packed(in_space(runs.truth[frames])),
        "scored": base64.b64encode(runs.scored[0, frames].astype(np.uint8).tobytes()).decode(),
        "estimates": estimates,
        "axes": roots,
        "links": base64.b64encode(np.packbits(runs.links[frames].reshape(-1)).tobytes()).decode(),
        "low": [*runs.low, 0.0][:3],
        "high": [*runs.high, 0.0][:3],
        "places": {name: _numbers_of(in_space(values)) for name, values in runs.places.items()},
    }


def _packed(values: Floats) -> str:
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode()


def _plain(value: Any) -> float | None:
    """Four digits; None for what JSON cannot hold."""
    return float(f"{value:.4g}") if np.isfinite(value) else None


def _numbers(values: Floats) -> list[float | None]:
    return [_plain(value) for value in values]


def _numbers_of(places: Floats) -> list[list[float | None]]:
    return [_numbers(place) for place in places]
