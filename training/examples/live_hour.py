"""An hour of a simulated team of six, piped into ``coloc live`` twenty times as fast as it was.

Reports how long steps took, how much memory the process held while it ran, and how far off its
estimates were.

    pip install -e .
    python -m training.examples.live_hour

``--seconds``, ``--speed``, ``--agent`` and ``--dt`` make it another; ``--out hour.json`` keeps it.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

import numpy as np
import torch
import yaml

from coloc_env import make_scenario
from coloc_env.scenario import Scenario
from coloc_env.sensors import AnchorRanging
from coloc_env.world import World

N, RANGE_EVERY = 6, 1.0  # UAVs; s between ranges of a link
COMMAND = [sys.executable, "-c", "from coloc_env._command import main; main()", "live"]


def scenario_of(seconds: float, dt: float) -> Scenario:
    """A team with IMUs and UWB in a room with eight anchors."""
    steps = round(seconds / dt)
    return make_scenario("indoor-v0", n_uavs=N, landmarks=0, anchors=8, dt=dt, horizon=steps)


def setup_of(scenario: Scenario, world: World) -> dict[str, Any]:
    """What ``coloc live`` is to know: who, what is to come, the map, the start."""
    (anchors,) = (s.anchors for s in scenario.sensors if isinstance(s, AnchorRanging))
    places, turns = world.truth.position[0], world.truth.attitude[0].roll(-1, -1)
    return {
        "dim": 3,
        "robots": [f"uav_{i}" for i in range(N)],
        "time": {"unit": "s"},
        "streams": ["imu", "uav_ranges", "anchor_ranges"],
        "map": {"anchors": {f"a{m}": list(place) for m, place in enumerate(anchors)}},
        "start": {
            f"uav_{i}": {"position": places[i].tolist(), "quaternion": turns[i].tolist()}
            for i in range(N)
        },
        "believed": {"anchor_ranges": {"std": 0.2}, "uav_ranges": {"std": 0.2}},
    }


def events(world: World, k: int, dt: float) -> Iterator[dict[str, Any]]:
    """What the team senses at step k: IMUs in each, ranges once a second."""
    seen = {name: leaf[0].tolist() for name, leaf in world.observation().leaves.items()}
    ranged = k % max(1, round(RANGE_EVERY / dt)) == 0
    axes = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")
    for i in range(N):
        at = {"robot": f"uav_{i}", "stamp": round(k * dt, 6)}
        yield {**at, "sensor": "imu", **dict(zip(axes, seen["imu"][i], strict=True))}
        if not ranged:
            continue
        for j in range(i):
            if seen["range_mask"][i][j]:
                yield {**at, "sensor": "ranges", "to": f"uav_{j}", "range": seen["ranges"][i][j]}
        for m, distance in enumerate(seen["anchor_ranges"][i]):
            yield {**at, "sensor": "ranges", "to": f"a{m}", "range": distance}


def memory(pid: int) -> float:
    """Resident memory of a process, MB (Linux)."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    return float("nan")


def run(
    seconds: float = 3600.0, speed: float = 20.0, agent: str = "ekf", dt: float = 0.1
) -> dict[str, Any]:
    """Pipe it; figures of the process."""
    scenario = scenario_of(seconds, dt)
    world = World(scenario)
    world.reset(0)
    truth = np.zeros((scenario.horizon, N, 3))
    squared: list[float] = []

    def read(lines: Any) -> None:
        for line in lines:
            found = json.loads(line)
            k, i = round(found["stamp"] / dt), int(found["robot"][4:])
            squared.append(float(np.square(np.array(found["position"]) - truth[k, i]).sum()))

    with TemporaryDirectory() as home:
        setup = Path(home, "recording.yaml")
        setup.write_text(yaml.safe_dump(setup_of(scenario, world)))
        command = [*COMMAND, str(setup), "--agent", agent, "--dt", str(dt)]
        pipe = subprocess.PIPE
        child = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        assert child.stdin
        reader = Thread(target=read, args=(child.stdout,))
        reader.start()
        held, count, k, start = [], 0, 0, time.monotonic()
        with suppress(KeyboardInterrupt):  # what there is until then
            for k in range(scenario.horizon):
                truth[k] = world.truth.position[0].numpy()
                lines = [json.dumps(event) + "\n" for event in events(world, k, dt)]
                child.stdin.write("".join(lines))
                child.stdin.flush()
                count += len(lines)
                if k % round(60 / dt) == round(30 / dt):  # once a minute
                    held.append(memory(child.pid))
                world.advance(torch.zeros(1, N, 9))
                time.sleep(max(0.0, start + (k + 1) * dt / speed - time.monotonic()))
        child.stdin.close()
        reader.join()
        assert child.stderr
        said = child.stderr.read().splitlines()
        if child.wait():
            raise RuntimeError("\n".join(said))
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "agent": agent,
        "seconds": (k + 1) * dt,
        "dt": dt,
        "speed": speed,
        "wall_s": time.monotonic() - start,
        "cpu_s": used.ru_utime + used.ru_stime,
        "events": count,
        "memory_mb": held,
        "rmse_m": float(np.mean(squared)) ** 0.5,
        "summary": said,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3600.0, help="simulated")
    parser.add_argument("--speed", type=float, default=20.0, help="times real time, at most")
    parser.add_argument("--agent", default="ekf")
    parser.add_argument("--dt", type=float, default=0.1, help="s, of a step")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    found = run(chosen.seconds, chosen.speed, chosen.agent, chosen.dt)
    print(json.dumps(found, indent=1))
    if chosen.out:
        chosen.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
