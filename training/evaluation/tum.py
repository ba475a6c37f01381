"""Trajectories as TUM files, which evaluation tools such as evo read.

One line a pose: ``timestamp tx ty tz qx qy qz qw``, in seconds (of a recording at the stamps that
were recorded) and metres, body to world. In two dimensions z is 0 and the heading turns about it;
an attitude that is not known is the identity.
"""

import re
from pathlib import Path

import numpy as np

from coloc_env.datasets.open_format.stamps import seconds_text
from training.evaluation.metrics import Floats
from training.evaluation.results import Evaluation


def write_tum(results: Evaluation, folder: Path) -> None:
    """The first run: ``groundtruth/uav_i.txt`` and ``AGENT/uav_i.txt``, scored steps only (without
    truth: all steps, and no groundtruth); of a recording in the frame that it was recorded in."""
    truth = results.worlds.truth[0] + results.origin
    time = np.arange(results.scenario.horizon) * results.dt
    attitude = quaternions(results.worlds.attitude)
    identity = np.broadcast_to((0.0, 0.0, 0.0, 1.0), attitude.shape)
    tracks = {"groundtruth": (truth, attitude)}
    for name, label in zip(results.agents, folder_names(list(results.agents)), strict=True):
        found = results.agents[name]
        turned = identity if found.attitude is None else quaternions(found.attitude)
        tracks[label] = (truth + found.offset[0], turned)
    unknown = bool(results.innovations)
    if unknown:
        del tracks["groundtruth"]
    for label, (position, turned) in tracks.items():
        (folder / label).mkdir(parents=True)
        for i, uav in enumerate(results.scenario.agents):
            now = results.worlds.scored[0, :, i] | unknown
            start = results.scenario.arena.start
            text = tum_text(time[now], position[now, i], turned[now, i], start)
            (folder / label / f"{uav}.txt").write_text(text, encoding="ascii")


def tum_text(time: Floats, position: Floats, quaternion: Floats, start: int = 0) -> str:
    """Lines for times [K] s after a stamp (ns; 0: none), positions [K, d] m and quaternions [K, 4]
    xyzw: to the hundredth of a millimetre wherever on Earth."""
    stamps = [f"{t:.12g}" for t in time.tolist()]
    if start:
        stamps = [seconds_text(start + round(t * 1e9)) for t in time.tolist()]
    flat = np.zeros((len(time), 3 - position.shape[1]))
    rows = np.concatenate((position, flat, quaternion), 1).tolist()
    return "".join(
        " ".join((stamp, *(f"{value:.12g}" for value in row))) + "\n"
        for stamp, row in zip(stamps, rows, strict=True)
    )


def quaternions(attitude: Floats) -> Floats:
    """Attitudes [..., a] (quaternion wxyz, or heading in rad) as quaternions [..., 4] xyzw."""
    if attitude.shape[-1] == 4:
        return np.roll(attitude, -1, -1)
    half = 0.5 * attitude[..., 0]
    zero = np.zeros_like(half)
    return np.stack((zero, zero, np.sin(half), np.cos(half)), -1)


def folder_names(agents: list[str]) -> list[str]:
    """Agents' names fit for folders on any system, no two alike: ``ekf:robust=huber`` becomes
    ``ekf-robust=huber``."""
    names: list[str] = []
    for agent in agents:
        name = re.sub(r"[^\w.=+,-]", "_", agent.replace(":", "-"))
        while name in ("groundtruth", *names):
            name += "_"
        names.append(name)
    return names
