"""An evaluation as pandas and xarray know data (extra ``frames``)."""

from typing import TYPE_CHECKING, Any

import numpy as np

from training.evaluation.results import Evaluation

if TYPE_CHECKING:
    import pandas
    import xarray


def dataframe(results: Evaluation) -> "pandas.DataFrame":
    """A line for every agent, run, step and UAV that is scored: ``agent``, ``run``, ``seed``,
    ``step``, ``time`` (s), ``uav``, ``error`` (m), ``nees``, and the methods' own figures."""
    try:
        import pandas
    except ImportError:
        raise ValueError("this needs pandas: pip install 'coloc-env[frames]'") from None
    run, step, uav = np.nonzero(results.worlds.scored)
    own = dict.fromkeys(name for one in results.agents.values() for name in one.series)
    parts = []
    for agent, one in results.agents.items():
        columns: dict[str, Any] = {
            "agent": agent,
            "run": run,
            "seed": results.seed + run,
            "step": step,
            "time": step * results.dt,
            "uav": uav,
            "error": one.error[run, step, uav],
            "nees": one.nees[run, step, uav],
        }
        for name in own:
            columns[name] = one.series[name][run, step, uav] if name in one.series else np.nan
        parts.append(pandas.DataFrame(columns))
    return pandas.concat(parts, ignore_index=True)


def dataset(results: Evaluation) -> "xarray.Dataset":
    """Arrays with names: ``truth`` (run, step, uav, axis) and ``estimate`` (agent, …) in m,
    ``error`` in m and ``nees`` (agent, run, step, uav), ``scored``; coordinates ``time`` (s) and
    ``seed``."""
    try:
        import xarray
    except ImportError:
        raise ValueError("this needs xarray: pip install 'coloc-env[frames]'") from None
    worlds, records = results.worlds, list(results.agents.values())
    runs, steps, _, dim = worlds.truth.shape
    each = ("run", "step", "uav")
    return xarray.Dataset(
        {
            "truth": ((*each, "axis"), worlds.truth, {"units": "m"}),
            "estimate": (
                ("agent", *each, "axis"),
                np.stack([worlds.truth + one.offset for one in records]),
                {"units": "m"},
            ),
            "error": (("agent", *each), np.stack([one.error for one in records]), {"units": "m"}),
            "nees": (("agent", *each), np.stack([one.nees for one in records])),
            "scored": (each, worlds.scored),
        },
        coords={
            "agent": list(results.agents),
            "axis": list("xyz"[:dim]),
            "time": ("step", np.arange(steps) * results.dt, {"units": "s"}),
            "seed": ("run", results.seed + np.arange(runs)),
        },
        attrs={"scenario": results.scenario.name},
    )
