"""Cases timed in turn, round after round: what slows the machine slows all alike."""

import math
import statistics
import time
from collections.abc import Iterable, Sequence

from training.bench.cases import Case, Timed


def rounds(chosen: Sequence[Case], turns: Iterable[int]) -> dict[str, dict[str, float]]:
    """By case the best and the median round in agent-steps per second, and the best one's ms a
    step; the first of the ``turns`` warms up and does not count."""
    ready = [(case, case.setup()) for case in chosen]
    seconds: dict[str, list[float]] = {case.key: [] for case in chosen}
    for _ in turns:
        for case, timed in ready:
            seconds[case.key].append(_seconds(case, timed))
    found = {}
    for case in chosen:
        counted = seconds[case.key][1:]
        best = min(counted)
        found[case.key] = {
            "agent_steps_per_s": case.agents / best,
            "median": case.agents / statistics.median(counted),
            "ms": 1e3 * best,
        }
    return found


def _seconds(case: Case, timed: Timed) -> float:
    """Mean time of a step over whole windows."""
    steps = timed.window * math.ceil(case.steps / timed.window)
    start = time.perf_counter()
    timed.run(steps)
    return (time.perf_counter() - start) / steps
