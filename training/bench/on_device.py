"""``coloc bench --device``: agent-steps per second beside the CPU's, by worlds at once."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch

from training.bench.growth import provenance
from training.bench.sweep import Sweep, measure

SECONDS = 1.0  # of steps that are timed at each size
WORLDS = (1, 8, 64, 512, 4096, 16384, 65536)
AGENTS = ("world", "ekf", "pf500")
UAVS = 6


def on_device(
    quick: bool,
    device: torch.device,
    tracked: Callable[[Sequence[Any], str], Iterable[Any]],
) -> dict[str, Any]:
    """By device and agent: ``size`` (worlds at once) and ``agent_steps_per_s`` of a rollout."""
    devices = dict.fromkeys((torch.device("cpu"), device))
    sizes = WORLDS[:2] if quick else WORLDS
    every = [(where, agent) for where in devices for agent in AGENTS]
    found: dict[str, dict[str, Any]] = {str(where): {} for where in devices}
    for where, agent in tracked(every, "devices"):
        sweep = Sweep(agent, "worlds", sizes, None if agent == "world" else agent)
        one = measure(sweep, where, 0.0 if quick else SECONDS)
        speeds = [1e3 * UAVS * b / ms for b, ms in zip(one["size"], one["ms"], strict=True)]
        found[str(where)][agent] = {"size": one["size"], "agent_steps_per_s": speeds}
    return provenance(device) | {"devices": found}
