# %% [markdown]
# # Live
#
# Robots that are moving now send events: who, which sensor, when, what. `OnlineLocalizer` turns
# them into estimates as they come. On the command line it is `coloc live`, which reads events from
# a pipe.
#
# Here two robots drive in a yard with three anchors, and the radio is not perfect.

# %%
import tempfile
from math import cos, dist, sin
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from agents.online import OnlineLocalizer

torch.set_num_threads(1)
folder = Path(tempfile.mkdtemp())
setup = folder / "setup.yaml"
setup.write_text("""
dim: 2
robots: [anna, bert]
time: {unit: s}
streams: [odometry, anchor_ranges, uav_ranges]
map: {anchors: {a0: [0, 0], a1: [20, 0], a2: [10, 18]}}
start:
  anna: {position: [8, 6], heading: 1.57}
  bert: {position: [12, 10], heading: 1.57}
believed: {anchor_ranges: {std: 0.2}, uav_ranges: {std: 0.2}}
""")
anchors = {"a0": (0, 0), "a1": (20, 0), "a2": (10, 18)}


def place(robot: str, t: float) -> tuple[float, float]:
    """Both drive circles of 3 m, at 0.6 m/s."""
    x, y = (5, 6) if robot == "anna" else (9, 10)
    return x + 3 * cos(0.2 * t), y + 3 * sin(0.2 * t)


# %% [markdown]
# ## What comes in
#
# Events are rows of the [recording format](../reference/recording-format.md)'s tables, here as
# dictionaries. Ranges arrive 0.3 s late, one in ten is lost, one in ten comes twice, and one in
# twenty is far too long.

# %%
rng = np.random.default_rng(0)
events = []  # (arrival, event)
for k in range(600):
    t = 0.1 * k
    for robot in ("anna", "bert"):
        driven = {"v": 0.6 + rng.normal(0, 0.05), "omega": 0.2 + rng.normal(0, 0.02)}
        events.append((t, {"robot": robot, "sensor": "odometry", "stamp": t, **driven}))
        if k % 5:
            continue
        other = "bert" if robot == "anna" else "anna"
        for to, there in {**anchors, other: place(other, t)}.items():
            off = rng.normal(0, 0.2) + (rng.random() < 0.05) * 5.0
            event = {"robot": robot, "sensor": "ranges", "stamp": t, "to": to}
            event["range"] = dist(place(robot, t), there) + off
            events += [(t + 0.3, event)] * rng.choice([0, 1, 2], p=[0.1, 0.8, 0.1])
events = [event for _, event in sorted(events, key=lambda pair: pair[0])]
len(events)

# %% [markdown]
# ## What comes out
#
# `add` takes an event; `steps` runs what is due and yields the whole team, step by step. A late
# range makes the steps since run again: `horizon` says how late it may be.

# %%
online = OnlineLocalizer("ekf:robust=huber", setup, horizon=1.0)
found: dict[float, np.ndarray] = {}
for event in events:
    try:
        online.add(**event)
    except ValueError as error:  # an event that is malformed: say so, and go on
        print(error)
    for located in online.steps():
        found[located.stamp * 1e-9] = located.position
error = [
    np.linalg.norm(position[i] - place(robot, t))
    for t, position in found.items()
    for i, robot in enumerate(online.robots)
    if t > 10
]
print(f"{len(found)} steps, RMSE after 10 s {np.sqrt(np.mean(np.square(error))):.2f} m")
print(dict(online.counts))
assert np.sqrt(np.mean(np.square(error))) < 0.3

# %%
figure, axes = plt.subplots(figsize=(5, 4))
for i, robot in enumerate(online.robots):
    axes.plot(*np.array([p[i] for p in found.values()]).T, label=f"{robot}, estimated")
    axes.plot(*np.array([place(robot, t) for t in found]).T, "k:", linewidth=1)
axes.plot(*np.array(list(anchors.values())).T, "s", label="anchors")
axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
axes.legend()
figure.tight_layout()

# %% [markdown]
# ## What if …
#
# - **An event makes no sense**: `add` refuses it in one line that names what is allowed, and
#   nothing has changed.

# %%
for wrong in (
    {"robot": "carl", "sensor": "ranges", "stamp": 61.0, "to": "a0", "range": 5.0},
    {"robot": "anna", "sensor": "ranges", "stamp": 61.0, "to": "a0", "range": "far"},
    {"robot": "anna", "sensor": "sonar", "stamp": 61.0, "range": 5.0},
):
    try:
        online.add(**wrong)
    except ValueError as error:
        print(error)

# %% [markdown]
# - **The computer restarts**: save the belief now and then, and go on from it.

# %%
online.save(folder / "belief.safetensors")
again = OnlineLocalizer("ekf:robust=huber", setup, horizon=1.0)
again.load(folder / "belief.safetensors")
before, after = online.estimate(59.9), again.estimate(59.9)
assert np.array_equal(before.position, after.position)
before.position.round(2)

# %% [markdown]
# - **A robot falls silent**: `online.silent()` names it; its estimate grows unsure as its motion
#   model says.
#
# The same from a terminal, with latency and memory measured:
# [locate a team that is moving now](../how-to/live.md).
