"""Tables of growth, and of what a study costs on machines of several sizes, from unit costs."""

from __future__ import annotations

import math
from typing import Any

from coloc_env.scenarios import make_scenario

WORLDS, UAVS, SCENARIO = 10_000, 200, "swarm-v0"
MACHINES = {
    "laptop, 8 cores": 8,
    "workstation, 32 cores": 32,
    "cluster, 10 nodes of 64 cores": 640,
}


_AGAINST = {"n_uavs": "UAVs"}


def growth_table(growth: dict[str, Any]) -> dict[str, Any]:
    """The table of all sweeps, as ``docs/results/measured`` has tables: ends, and the slope of
    log time against log size between the two largest sizes."""
    rows = []
    for one in growth["sweeps"]:
        sizes, ms, held = one["size"], one["ms"], one["bytes"]
        if len(sizes) < 2:
            continue
        slope = math.log(ms[-1] / ms[-2]) / math.log(sizes[-1] / sizes[-2])
        rows.append(
            [
                f"`{one['name']}`" if one["agent"] else "worlds alone",
                f"`{one['scenario']}`",
                _AGAINST.get(one["key"], one["key"]),
                f"{sizes[0]:,} … {sizes[-1]:,}",
                f"{ms[0]:.2g} … {ms[-1]:.3g}",
                f"{slope:.1f}",
                f"{held[0] / 1e6:.2g} … {held[-1] / 1e6:.3g}",
            ]
        )
    return {
        "title": "Time and memory of a step",
        "caption": "Worlds and agent together. Slope: of log time against log size, between the "
        "two largest sizes.",
        "command": "coloc bench --growth",
        "provenance": source_of(growth),
        "header": ["agent", "scenario", "against", "sizes", "ms a step", "slope", "MB"],
        "align": ["left", "left", "left", "right", "right", "right", "right"],
        "rows": rows,
    }


def study_cost(growth: dict[str, Any]) -> dict[str, Any]:
    """The table of a study of ``WORLDS`` worlds of ``UAVS`` UAVs, by agent, as
    ``docs/results/measured`` has tables: a process a core, a world at a time, nothing lost in
    spreading."""
    steps = make_scenario(SCENARIO, n_uavs=UAVS).horizon
    rows = []
    for one in growth["sweeps"]:
        if one["key"] != "n_uavs" or one["scenario"] != SCENARIO or UAVS not in one["size"]:
            continue
        at = one["size"].index(UAVS)
        hours = WORLDS * steps * one["ms"][at] / 3.6e6
        held = growth["process_bytes"] + one["bytes"][at] + one["belief"][at]
        rows.append(
            [
                f"`{one['name']}`" if one["agent"] else "worlds alone",
                f"{one['ms'][at]:.3g}",
                f"{hours:.3g}",
                *(_duration(hours / cores) for cores in MACHINES.values()),
                f"{held / 1e9:.2g}",
            ]
        )
    return {
        "title": f"{WORLDS:,} worlds of {UAVS} UAVs, {steps} steps each (`{SCENARIO}`)",
        "caption": "Computed from the unit costs of one run: ms of one step of one world, worlds "
        "included, times worlds and steps, shared by the cores; memory of a process, libraries "
        "included.",
        "command": "coloc bench --growth",
        "provenance": source_of(growth),
        "header": ["agent", "ms a step", "core hours", *MACHINES, "GB a process"],
        "align": ["left", *["right"] * (3 + len(MACHINES))],
        "rows": rows,
    }


def source_of(measured: dict[str, Any]) -> str:
    """Where measurements come from, in words."""
    where = measured["card"] or f"one thread of {measured['machine']}"
    shared = ""
    if measured["load"] is not None and measured["load"] > measured["cpus"]:
        shared = (
            f"; CPU time, as the machine was shared ({measured['load']:.0f} processes wanted its "
            f"{measured['cpus']} CPUs)"
        )
    return f"{where}, torch {measured['versions']['torch']}, {measured['date']}{shared}"


def _duration(hours: float) -> str:
    if hours >= 48:
        return f"{hours / 24:.3g} days"
    return f"{hours:.3g} h" if hours >= 1 else f"{60 * hours:.2g} min"
