"""Speed of the tasks, beside VMAS's ``navigation`` (which has no estimator), in one run.

``python -m training.bench.tasks --out docs/results/measured/speed_tasks.json``
"""

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from datetime import date
from itertools import islice
from pathlib import Path

import torch

from agents.tasks import TASKS, make_task, parallel_env
from agents.tasks.runner import rollout

WORLDS, STEPS, ROUNDS = 256, 15, 3
Block = Callable[[], int]  # runs, and returns how many agent-steps it ran


def batched(name: str) -> Block:
    """Random actions in ``WORLDS`` worlds at once, the estimator in the loop."""
    task = make_task(name)

    def run() -> int:
        steps = rollout(task, task.policies["random"], torch.arange(WORLDS))
        return sum(step.action.shape[0] * step.action.shape[1] for step in islice(steps, STEPS))

    return run


def one_world(name: str) -> Block:
    """Random actions on the PettingZoo face."""
    env = parallel_env(name)

    def run() -> int:
        env.reset(seed=0)
        count = 0
        for _ in range(STEPS):
            count += len(env.agents)
            env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        return count

    return run


def vmas_navigation(agents: int = 4) -> Block:
    """VMAS's own task, as many worlds at once, actions all the same."""
    import vmas

    env = vmas.make_env("navigation", num_envs=WORLDS, device="cpu", n_agents=agents, seed=0)
    actions = [torch.full((WORLDS, 2), 0.3) for _ in range(agents)]

    def run() -> int:
        env.reset()
        for _ in range(STEPS):
            env.step(actions)
        return WORLDS * agents * STEPS

    return run


def measured(blocks: dict[str, Block]) -> dict[str, float]:
    """Agent-steps a second of CPU time: medians of ``ROUNDS`` rounds, the blocks in turn, after one
    that is not counted."""
    rates: dict[str, list[float]] = {name: [] for name in blocks}
    for counted in (False, *(True,) * ROUNDS):
        for name, run in blocks.items():
            start = time.process_time()
            count = run()
            if counted:
                rates[name].append(count / (time.process_time() - start))
    return {name: statistics.median(each) for name, each in rates.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="the table, as pages take it")
    out = parser.parse_args().out
    torch.set_num_threads(1)
    names = [name for name in TASKS if "hard" not in name]
    blocks = {name: batched(name) for name in names}
    blocks |= {f"{name}, PettingZoo": one_world(name) for name in names}
    found = measured(blocks | {"VMAS": vmas_navigation()})
    rows = [
        [
            f"`{name}`",
            str(make_task(name).n_agents),
            f"{found[name] / 1e3:.1f} k",
            f"{found[name] / found['VMAS']:.2f}",
            f"{found[f'{name}, PettingZoo'] / 1e3:.2f} k",
        ]
        for name in names
    ]
    table = {
        "title": "Agent-steps per second of tasks",
        "caption": f"One thread, CPU time, estimator included, random actions: {WORLDS} worlds at "
        f"once, the ratio to VMAS's navigation in as many ({found['VMAS'] / 1e3:.0f} k, without an "
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
