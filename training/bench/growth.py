"""``coloc bench --growth``: a step's time and memory against UAVs, worlds, particles, landmarks."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Any

import torch

from training.bench.sweep import Sweep, measure

SECONDS = 0.4  # of steps that are timed at each size
_TEAMS = (10, 20, 50, 100, 200, 500, 1000)
_WORLDS = (1, 4, 16, 64, 256, 1024)
_PARTICLES = (100, 300, 1000, 3000, 10000)
_LANDMARKS = (1, 5, 20, 80, 320)
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
        found.append(Sweep(name, "n_uavs", _TEAMS[:5], name))
    found.append(Sweep("cspf", "n_uavs", (3, 5, 10, 20), "cspf", "stein2d-v0"))
    for name, agent in _INDOOR.items():
        found.append(Sweep(name, "worlds", _WORLDS, agent))
        found.append(Sweep(name, "landmarks", _LANDMARKS, agent))
    for name in ("map", "stdcl"):
        found.append(Sweep(name, "worlds", _WORLDS[:4], name, "swarm-v0", overrides=_TEN))
    found.append(Sweep("pf800", "particles", _PARTICLES, "pf800"))
    found.append(Sweep("pf_trust", "particles", _PARTICLES, "pf_trust"))
    found.append(Sweep("cspf", "particles", _PARTICLES[:3], "cspf", "stein2d-v0"))
    if quick:
        found = [Sweep("world", "worlds", (1, 2)), Sweep("ekf", "n_uavs", (2, 4), "ekf")]
    return found


_TEN = (("n_uavs", 50),)


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
                **measure(one, device, 0.0 if quick else SECONDS, lambda done: None),
            }
            for one in tracked(sweeps(quick), "growth")
        ]
    finally:
        torch.set_num_threads(threads)
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    return {
        "machine": platform.processor() or platform.machine(),
        "card": card,
        "date": datetime.now(UTC).date().isoformat(),
        "versions": {name: version(name) for name in ("coloc-env", "torch")},
        "sweeps": found,
    }
