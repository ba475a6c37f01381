"""``coloc bench --growth``: what a step costs against UAVs, worlds, particles and landmarks."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import torch

from training.bench.sweep import Sweep, measure

SECONDS = 0.1  # of steps that are timed at each size
_TEAMS = (10, 50, 200, 500, 1000)
_WORLDS = (1, 16, 128, 1024)
_PARTICLES = (100, 1000, 10000)
_LANDMARKS = (1, 20, 320)
_FIFTY = (("n_uavs", 50),)
_INDOOR = {"world": None, "ekf": "ekf", "pf800": "pf800", "ekf_trust": "ekf_trust", "dfgo": "dfgo"}
_SWARM = {
    "world": None,
    "dead_reckoning": "dead_reckoning",
    "dwmds": "dwmds",
    "map": "map",
    "stdcl": "stdcl",
}


def sweeps(quick: bool = False) -> list[Sweep]:
    """One agent of every family where it belongs: Kalman, particle, trust, factor graph (indoor),
    swarm and its networks (swarm), Stein (relative poses)."""
    found = []
    for name, agent in _SWARM.items():
        found.append(Sweep(name, "n_uavs", _TEAMS, agent, "swarm-v0"))
    for name in ("ekf", "pf800"):
        found.append(Sweep(name, "n_uavs", _TEAMS[:3], name))
    found.append(Sweep("cspf", "n_uavs", (3, 6, 12), "cspf", "stein2d-v0"))
    for name, agent in _INDOOR.items():
        found.append(Sweep(name, "worlds", _WORLDS, agent))
        found.append(Sweep(name, "landmarks", _LANDMARKS, agent))
    for name in ("map", "stdcl"):
        found.append(Sweep(name, "worlds", _WORLDS[:3], name, "swarm-v0", overrides=_FIFTY))
    found.append(Sweep("pf800", "particles", _PARTICLES, "pf800"))
    found.append(Sweep("cspf", "particles", (10, 50, 250), "cspf", "stein2d-v0"))
    if quick:
        found = [Sweep("world", "worlds", (1, 2)), Sweep("ekf", "n_uavs", (2, 4), "ekf")]
    return found


def growth(
    quick: bool,
    device: torch.device,
    tracked: Callable[[Sequence[Sweep], str], Iterable[Sweep]],
) -> dict[str, Any]:
    """Every sweep's measurements, and where they come from."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        found = [
            {
                "name": one.name,
                "key": one.key,
                "scenario": one.scenario,
                "worlds": one.worlds,
                "agent": one.agent,
                **measure(one, device, 0.0 if quick else SECONDS),
            }
            for one in tracked(sweeps(quick), "growth")
        ]
    finally:
        torch.set_num_threads(threads)
    return provenance(device) | {"process_bytes": _process_bytes(), "sweeps": found}


def provenance(device: torch.device) -> dict[str, Any]:
    """Where measurements come from; ``load``: how many processes wanted one of ``cpus`` then."""
    card = device.type == "cuda" and torch.cuda.is_available()
    return {
        "machine": platform.processor() or platform.machine(),
        "cpus": os.cpu_count(),
        "load": os.getloadavg()[1] if hasattr(os, "getloadavg") else None,
        "card": torch.cuda.get_device_name(device) if card else None,
        "date": datetime.now(UTC).date().isoformat(),
        "versions": {name: version(name) for name in ("coloc-env", "torch")},
    }


def _process_bytes() -> int | None:
    """What a process holds before it has a world; None where not known."""
    if not sys.platform.startswith("linux"):
        return None
    code = (
        "import training.evaluation.evaluate;"
        "print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
    )
    command = [sys.executable, "-c", code]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return int(printed) * 1024
