"""Speed of the tasks, beside VMAS's ``navigation`` (which has no estimator), in one run.

``python -m training.bench.tasks --out docs/results/measured/speed_tasks.json``
"""

import argparse
import json
import platform
from collections.abc import Callable, Iterator
from datetime import date
from itertools import islice
from pathlib import Path

import torch

from agents.tasks import TASKS, make_task, parallel_env
from agents.tasks.runner import rollout
from training.bench.cases import Case, Timed
from training.bench.peers import vmas_worlds
from training.bench.rounds import rounds

WORLDS, STEPS, ROUNDS, PEERS = 256, 15, 3, 4  # PEERS: agents of VMAS's navigation
BATCH, FACE = f"B={WORLDS}", "PettingZoo"
NAMES = [name for name in TASKS if "hard" not in name]


def task_cases() -> Iterator[Case]:
    """Every task in the plane, many worlds at once and one on the PettingZoo interface; VMAS's."""
    for name in NAMES:
        n = make_task(name).n_agents
        yield Case(name, BATCH, n * WORLDS, STEPS, batched(name))
        yield Case(name, FACE, n, STEPS, one_world(name))
    peer = vmas_worlds(WORLDS, "navigation", PEERS)
    yield Case("VMAS navigation", BATCH, PEERS * WORLDS, STEPS, peer)


def batched(name: str) -> Callable[[], Timed]:
    """Random actions in ``WORLDS`` new worlds at once, the estimator in the loop."""

    def setup() -> Timed:
        task = make_task(name)

        def run(steps: int) -> None:
            for _ in islice(rollout(task, task.policies["random"], torch.arange(WORLDS)), steps):
                pass

        return Timed(run)

    return setup


def one_world(name: str) -> Callable[[], Timed]:
    """Random actions in a new world on the PettingZoo interface."""

    def setup() -> Timed:
        env = parallel_env(name)

        def run(steps: int) -> None:
            env.reset(seed=0)
            for _ in range(steps):
                env.step({agent: env.action_space(agent).sample() for agent in env.agents})

        return Timed(run)

    return setup


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="the table, as pages take it")
    out = parser.parse_args().out
    torch.set_num_threads(1)
    timed = rounds([*task_cases()], range(1 + ROUNDS))
    found = {key: figures["median"] for key, figures in timed.items()}
    peer = found[f"VMAS navigation {BATCH}"]
    rows = [
        [
            f"`{name}`",
            str(make_task(name).n_agents),
            f"{found[f'{name} {BATCH}'] / 1e3:.1f} k",
            f"{found[f'{name} {BATCH}'] / peer:.2f}",
            f"{found[f'{name} {FACE}'] / 1e3:.2f} k",
        ]
        for name in NAMES
    ]
    table = {
        "title": "Agent-steps per second of tasks",
        "caption": f"One thread, estimator included, random actions: {WORLDS} worlds at "
        f"once, the ratio to VMAS's navigation in as many ({peer / 1e3:.0f} k, without an "
        "estimator), and one world on the PettingZoo interface; medians, cases in turn.",
        "command": f"python -m training.bench.tasks --out {out}",
        "provenance": f"{platform.machine()}, {date.today().isoformat()}",
        "header": ["task", "agents", f"B = {WORLDS}", "× VMAS", "PettingZoo"],
        "align": ["left", "right", "right", "right", "right"],
        "rows": rows,
    }
    out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
