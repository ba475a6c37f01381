"""A PF-NN team's step beside the same step written with Chopin's ``particles``, in one run.

``python -m training.bench.filters --out docs/results/measured/speed_filters.json``

``particles`` asks for an older NumPy than this project, but runs with ours:
``pip install --no-deps particles numba llvmlite``.
"""

import argparse
import copy
import importlib.util
import json
import math
import platform
import shutil
import time
from collections.abc import Callable, Sequence
from datetime import date
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from agents import make
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import GRAVITY, Imu, Landmarks, Ranging
from coloc_env.world import World

PARTICLES, WARM_UP, STEPS, ROUNDS = 800, 20, 20, 30
COUNT = f"particles={PARTICLES}:bounds={PARTICLES},{PARTICLES}"
PEER, OURS = "`particles`", ("apf", "pfnn")
_LINEAR, _ANGULAR = 0.03, 0.01  # perturbation of the peer's particles: m and m/s, rad
Run = Callable[[], np.ndarray]  # steps after the warm-up; the last mean positions [N, 3]


def room() -> Scenario:
    """Where both localize: a broader prior needs tempering, which the peer has not."""
    return make_scenario("indoor-v0", prior_std=0.2)


def observed(scenario: Scenario, steps: int) -> list[Observation]:
    """What one world's team sees in its first steps; every UAV sends where it is, ± 0.05 m."""
    world = World(scenario, 1)
    seen = [world.reset(0)]
    for _ in range(steps - 1):
        at = world.truth
        std = torch.full_like(at.position, math.log(0.05))
        world.step(torch.cat((at.position, at.velocity, std), -1).to(torch.float32))
        seen.append(world.observation())
    return seen


def beliefs(scenario: Scenario, seen: Sequence[Observation]) -> list[Any]:
    """``apf``'s before each step after the warm-up."""
    localizer = make(f"apf:{COUNT}", scenario)
    found = [localizer.reset(seen[0])]
    for observation in seen[:-1]:
        found.append(localizer.step(found[-1], observation)[0])
    return found[WARM_UP:]


def ours(agent: str, scenario: Scenario, seen: Sequence[Observation], before: Sequence[Any]) -> Run:
    """An agent's steps, each from a belief of ``before``: all redraw the same UAVs."""
    localizer = make(agent, scenario)

    def run() -> np.ndarray:
        for belief, observation in zip(before, seen[WARM_UP:], strict=True):
            _, estimate = localizer.step(belief, observation)
        return estimate.position[0].numpy()

    return run


def peer(scenario: Scenario, seen: Sequence[Observation]) -> Run:
    """The same with one bootstrap filter of ``particles`` a UAV: strapdown integration of noisy IMU
    samples, a fixed perturbation, Gaussian likelihoods of landmark vectors and ranges, systematic
    resampling where the effective sample size is below half, mean and covariance of the numbers of
    a state. (It neither adapts, tempers, redraws nor corrects weights.)"""
    from particles import SMC, FeynmanKac
    from particles.resampling import wmean_and_cov

    dt, slots = scenario.arena.dt, scenario.believed.slots
    imu, vectors, ranging = (_sensor(scenario, kind) for kind in (Imu, Landmarks, Ranging))
    leaves = [{k: leaf[0].double().numpy() for k, leaf in o.leaves.items()} for o in seen]
    rng = np.random.default_rng(0)
    down = np.array([0.0, 0.0, GRAVITY])

    class Motion(FeynmanKac):
        def __init__(self, uav: int) -> None:
            super().__init__(T=len(seen))
            self.uav = uav

        def of(self, t: int, leaf: str) -> Any:
            return leaves[t][leaf][self.uav]

        def M0(self, n: int) -> Any:
            mean, std = np.split(self.of(0, "prior"), [10])
            linear = mean[:6] + np.repeat(std[[0, 3]], 3) * rng.normal(size=(n, 6))
            q = np.broadcast_to(mean[6:], (n, 4))
            return np.concatenate((linear, _turned(q, std[4] * rng.normal(size=(n, 3)))), -1)

        def M(self, t: int, x: Any) -> Any:
            f, w = np.split(self.of(t, "imu"), 2)
            f = f + imu.accel_std * rng.normal(size=(len(x), 3))
            w = w + imu.gyro_std * rng.normal(size=(len(x), 3))
            p, v, q = x[:, :3], x[:, 3:6], x[:, 6:]
            a = (_matrix(q) @ f[..., None])[..., 0] - down
            moved = np.concatenate((p + v * dt + 0.5 * a * dt**2, v + a * dt), -1)
            moved += _LINEAR * rng.normal(size=moved.shape)
            turn = w * dt + _ANGULAR * rng.normal(size=w.shape)
            return np.concatenate((moved, _turned(q, turn)), -1)

        def logG(self, t: int, xp: Any, x: Any) -> Any:
            points, z = (self.of(t, k).reshape(-1, 3) for k in ("landmark_map", "landmarks"))
            p = x[:, None, :3]
            squared = ((z - (points - p) @ _matrix(x[:, 6:])) ** 2).sum(-1)
            log_density = squared @ self.of(t, "landmark_mask") * (-0.5 / vectors.std**2)
            message = self.of(t, "messages").reshape(slots, 9)
            there = self.of(t, "message_mask") * self.of(t, "range_mask")
            variance = ranging.noise.std**2 + np.exp(2 * message[:, 6:]).mean(-1)
            ends = message[:, :3] + dt * message[:, 3:6]
            squared = (np.linalg.norm(p - ends, axis=-1) - self.of(t, "ranges")) ** 2
            return log_density - 0.5 * squared @ (there / variance)

    def fresh(uav: int) -> Any:
        return SMC(fk=Motion(uav), N=PARTICLES, resampling="systematic", collect="off")

    start = [fresh(uav) for uav in range(scenario.arena.n_uavs)]
    for _ in range(WARM_UP):
        for filter in start:
            next(filter)

    def run() -> np.ndarray:
        means = []
        for filter in [copy.copy(one) for one in start]:
            for _ in range(STEPS):
                next(filter)
                mean, _ = wmean_and_cov(filter.W, filter.X)
            means.append(mean[:3])
        return np.array(means)

    return run


def cpu_ms(runs: dict[str, Run], rounds: int) -> dict[str, list[float]]:
    """CPU time of a step by round, all in turn; the first round does not count."""
    found: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(1 + rounds):
        for name, run in runs.items():
            start = time.process_time()
            run()
            found[name].append(1e3 * (time.process_time() - start) / STEPS)
    return {name: each[1:] for name, each in found.items()}


def table(found: dict[str, list[float]], command: str) -> dict[str, Any]:
    """Best rounds and medians; ratios of best rounds: to the peer, and what the corrector adds."""
    best = {name: min(each) for name, each in found.items()}
    rows = [
        [name, f"{best[name]:.2f}", f"{median(each):.2f}", f"{best[PEER] / best[name]:.1f} ×"]
        for name, each in found.items()
    ]
    added = {b: best[b] / best[a] - 1 for a, b in pairwise(found) if b.startswith("`pfnn")}
    words = " and ".join(f"{share:.0%} ({name})" for name, share in added.items())
    return {
        "title": "A team's step beside the library `particles`",
        "caption": f"Six UAVs of {PARTICLES} particles with 10 states, 20 landmarks, 5 ranges; one "
        f"thread, cases in turn, {len(found[PEER])} rounds of {STEPS} steps, ratios of the best. "
        f"The library's is a plain bootstrap filter; the corrector adds {words}.",
        "command": command,
        "provenance": f"{platform.machine()}, {date.today().isoformat()}",
        "header": ["step of", "CPU ms, best round", "median", "as fast as `particles`"],
        "align": ["left", "right", "right", "right"],
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="the table, as pages take it")
    out = parser.parse_args().out
    if importlib.util.find_spec("particles") is None:
        parser.error("particles is not installed: pip install --no-deps particles numba llvmlite")
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    scenario = room()
    seen = observed(scenario, WARM_UP + STEPS)
    before, runs = beliefs(scenario, seen), {PEER: peer(scenario, seen)}
    compiler = shutil.which("c++") or shutil.which("g++")
    for more in ("", ":compile=true") if compiler else ("",):
        for name in OURS:
            runs[f"`{name}{more}`"] = ours(f"{name}:{COUNT}{more}", scenario, seen, before)
    found = table(cpu_ms(runs, ROUNDS), f"python -m training.bench.filters --out {out}")
    out.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


# ------------------------------------------------------------------ parts


def _sensor(scenario: Scenario, kind: type) -> Any:
    return scenario.believed.sensor(kind)


def _matrix(q: Any) -> Any:
    """Rotation matrices of unit quaternions [n, 4]."""
    w, x, y, z = q.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def _turned(q: Any, delta: Any) -> Any:
    """q ⊗ exp(δ), normalized."""
    angle = np.linalg.norm(delta, axis=-1) + 1e-30
    w, (x, y, z) = np.cos(angle / 2), np.sin(angle / 2) / angle * delta.T
    a, b, c, d = q.T
    turned = np.array(
        (
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        )
    )
    return (turned / np.linalg.norm(turned, axis=0)).T


if __name__ == "__main__":
    main()
