"""The tables of a dataset: Parquet files that any tool reads, a run a row group."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from training.dataset.plan import Column, Plan


def require_pyarrow() -> Any:
    """The module ``pyarrow``; ValueError, with the command, where it is not installed."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ValueError("datasets need pyarrow: pip install 'coloc-env[dataset]'") from None
    return pyarrow


def write_steps(plan: Plan, runs: TensorDictBase, path: Path) -> None:
    """A row for each run, step and UAV, in this order: ``seed``, ``step``, ``uav``, ``time`` s, and
    the columns of steps."""
    k, n = plan.steps, plan.scenario.arena.n_uavs
    step, uav = np.repeat(np.arange(k), n), np.tile(np.arange(n), k)
    index: dict[str, np.ndarray] = {
        "step": step.astype(np.int32),
        "uav": uav.astype(np.int16),
        "time": step * plan.scenario.arena.dt,
    }
    _write([c for c in plan.columns if not c.world], runs, "steps", index, path)


def write_worlds(plan: Plan, runs: TensorDictBase, path: Path) -> None:
    """A row for each run and UAV: ``seed``, ``uav``, and the columns of worlds: maps, the prior."""
    uav = np.arange(plan.scenario.arena.n_uavs).astype(np.int16)
    _write([c for c in plan.columns if c.world], runs, "worlds", {"uav": uav}, path)


def _write(
    columns: list[Column],
    runs: TensorDictBase,
    group: str,
    index: dict[str, np.ndarray],
    path: Path,
) -> None:
    """Run by run, so that no more than one is in memory."""
    arrow = require_pyarrow()
    writer = None
    try:
        for i, seed in enumerate(runs["seed"].tolist()):
            rows = len(next(iter(index.values())))
            arrays = {"seed": arrow.array(np.full(rows, seed))}
            arrays |= {name: arrow.array(values) for name, values in index.items()}
            for column in columns:
                arrays[column.title] = _array(arrow, runs[group].get(column.name)[i], rows)
            table = arrow.table(arrays)
            if writer is None:
                writer = arrow.parquet.ParquetWriter(path, table.schema, compression="zstd")
            writer.write_table(table, row_group_size=rows)
    finally:
        if writer is not None:
            writer.close()


def _array(arrow: Any, values: Tensor, rows: int) -> Any:
    """A column of truth values, or of lists of so many numbers."""
    if values.dtype == torch.bool:
        return arrow.array(values.reshape(rows).numpy())
    flat = arrow.array(values.reshape(-1).numpy())
    return arrow.FixedSizeListArray.from_arrays(flat, values.shape[-1])
