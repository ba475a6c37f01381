"""``coloc bench --jobs`` and ``--ray``: what it costs to spread work, and what it brings."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from coloc_env.scenarios import make_scenario
from training.bench.growth import provenance
from training.bench.growth_tables import source_of
from training.evaluation.evaluate import evaluate
from training.pool import ALONE, Workers, work

CELLS, RUNS, CHUNK = 200, 16, 4


@dataclass(frozen=True)
class _Nothing:
    """A cell that does nothing."""

    number: int
    size: int = 1

    def settings(self) -> dict[str, Any]:
        return {}

    def run(self, progress: Callable[[int], None]) -> None:
        progress(1)


def spread(quick: bool, workers: Workers) -> dict[str, Any]:
    """``start_s`` until the first cell is done, ``ms_per_cell`` of cells that do nothing; seconds
    of an evaluation ``alone_s`` and ``spread_s``, workers started before, and their ratio."""
    cells = [_Nothing(i) for i in range(20 if quick else CELLS)]
    start = time.perf_counter()
    done = [time.perf_counter() for _ in work(cells, workers, lambda cell, size: None)]
    scenario = make_scenario("indoor-v0", horizon=20 if quick else 100)
    runs = 8 if quick else RUNS
    seconds = {}
    for name, who in (("alone", ALONE), ("spread", workers)):
        before = time.perf_counter()
        evaluate(scenario, ["ekf", "pf500"], runs, bound=False, chunk=CHUNK, workers=who)
        seconds[name] = time.perf_counter() - before
    return provenance(torch.device("cpu")) | {
        "workers": "Ray" if workers.ray else f"{workers.jobs} processes",
        "cells": len(cells),
        "start_s": done[0] - start,
        "ms_per_cell": 1e3 * (done[-1] - done[0]) / (len(cells) - 1),
        "alone_s": seconds["alone"],
        "spread_s": seconds["spread"],
        "speed_up": seconds["alone"] / seconds["spread"],
    }


def spread_table(several: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Measurements as ``docs/results/measured`` has tables."""
    rows = [
        [
            one["workers"],
            f"{one['start_s']:.2g} s",
            f"{one['ms_per_cell']:.2g} ms",
            f"{one['alone_s']:.3g} s",
            f"{one['spread_s']:.3g} s",
            f"{one['speed_up']:.2g}",
        ]
        for one in several
    ]
    return {
        "title": "Spreading work over two cores",
        "caption": f"{RUNS} worlds of `indoor-v0`, `ekf` and `pf500`, {CHUNK} worlds a block; "
        "overhead of cells that do nothing.",
        "command": "coloc bench --jobs 2, coloc bench --ray auto",
        "provenance": source_of(several[0]),
        "header": ["workers", "start", "overhead a cell", "one process", "spread", "speed-up"],
        "align": ["left", *["right"] * 5],
        "rows": rows,
    }
