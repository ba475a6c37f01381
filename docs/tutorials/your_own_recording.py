# %% [markdown]
# # Your own recording
#
# Two robots with wheels, four ultra-wideband anchors, and a log. This page makes such a log, as a
# spreadsheet would write it, and takes it all the way: looked over, calibrated, localized, with
# ground truth and without.

# %%
import math
import random
from pathlib import Path
from tempfile import mkdtemp

import torch

torch.set_num_threads(1)
home = Path(mkdtemp()) / "yard"
anchors = {"north": (0.0, 6.0), "east": (6.0, 0.0), "south": (0.0, -6.0), "west": (-6.0, 0.0)}
draw = random.Random(0)


def place(robot, t):
    """Where a robot is: ann and bob on circles, half a turn apart."""
    angle = 0.4 * t + (math.pi if robot == "bob" else 0.0)
    return 3 * math.cos(angle), 3 * math.sin(angle), angle + math.pi / 2


# %% [markdown]
# ## The folder
#
# `recording.yaml` says what the files mean; each robot has a folder of tables. Every stream is
# optional, columns are found by name. Times are seconds here; milliseconds or nanoseconds since
# 1970 do as well ([all of the format](../reference/recording-format.md)).

# %%
for robot, other in (("ann", "bob"), ("bob", "ann")):
    (home / robot).mkdir(parents=True)
    truth, wheels, ranges = ["stamp,x,y,heading"], ["stamp,v,omega"], ["stamp,to,range"]
    for k in range(600):
        t = 0.1 * k
        x, y, heading = place(robot, t)
        truth.append(f"{t:.1f},{x},{y},{heading}")
        wheels.append(f"{t:.1f},{1.2 * 1.06},{0.4 + draw.gauss(0, 0.01)}")
        name = list(anchors)[k % 4]
        late = place(robot, t - 0.15)[:2]
        error = 0.12 + draw.gauss(0, 0.05) + (draw.random() < 0.05) * draw.random()
        ranges.append(f"{t:.1f},{name},{math.dist(late, anchors[name]) + error}")
        if k % 5 == 0 and robot == "ann":
            between = math.dist((x, y), place(other, t)[:2]) + draw.gauss(0, 0.05)
            ranges.append(f"{t:.1f},{other},{between}")
    for stem, lines in (("truth", truth), ("odometry", wheels), ("ranges", ranges)):
        (home / robot / f"{stem}.csv").write_text("\n".join(lines) + "\n")

(home / "recording.yaml").write_text(f"""
dim: 2
robots: [ann, bob]
time: {{unit: s}}
map:
  anchors: {{{", ".join(f"{name}: {list(where)}" for name, where in anchors.items())}}}
source: made for this page
""")

# %% [markdown]
# ## Look it over
#
# `coloc recording check yard --picture yard.png` on the command line; the same from Python. Worst
# first: these ranges are late and too long.

# %%
from coloc_env.datasets.check import check
from coloc_env.datasets.open_format import read_recording

recording = read_recording(home)
report = check(recording)
for warning in report.warnings:
    print(warning)

# %% [markdown]
# ## Calibrate on one part, score on another
#
# `coloc recording calibrate yard --span 0:30` writes `yard/believed.yaml`: deviation, bias and
# delay of each link, the odometry's scales, and more.

# %%
from coloc_env.datasets.noise_model import write_noise_model
from training.calibration.calibrate import calibrate, part_of

learnt = calibrate(part_of(recording, (0.0, 30.0)))
believed = home / "believed.yaml"
believed.write_text(write_noise_model(learnt.model))
ranges = learnt.model.anchor_ranges
print(f"ranges: σ {ranges.std:.2f} m, {ranges.bias:.2f} m too long, {ranges.delay:.2f} s late")
print(f"wheels: {learnt.model.odometry.scale:.2f} of what they say")

# %% [markdown]
# `coloc evaluate replay-v0 --set path=yard --set believed=yard/believed.yaml --set span=30:59
# --agents ekf --out results/yard` on the command line:

# %%
from coloc_env import make_scenario
from training.evaluation.evaluate import evaluate

for title, chosen in (("defaults", {}), ("calibrated", {"believed": str(believed)})):
    scenario = make_scenario("replay-v0", path=str(home), span=(30.0, 59.0), **chosen)
    result = evaluate(scenario, ["ekf"], runs=1, bound=False)
    figures = result.summary["agents"]["ekf"]
    print(f"{title:12s} RMSE {figures['rmse']:.3f} m, NEES {figures['nees']:.1f}")

# %% [markdown]
# ## Without ground truth
#
# Outdoors there is often none. Everything runs all the same; nothing is scored. What can be said:
# whether innovations are as large and as white as the filter believes, what a gate would reject,
# how far methods are apart, and the error at places that you marked (`points.csv`). Give each
# robot's start if you know it.

# %%
for robot in ("ann", "bob"):
    (home / robot / "truth.csv").unlink()
with (home / "recording.yaml").open("a") as file:
    file.write("start:\n")
    for robot in ("ann", "bob"):
        x, y, heading = place(robot, 0.0)
        file.write(f"  {robot}: {{position: [{x}, {y}], heading: {heading}}}\n")
rows = [f"{t},ann,{place('ann', t)[0]},{place('ann', t)[1]}" for t in (10, 30, 50)]
(home / "points.csv").write_text("\n".join(["stamp,robot,x,y", *rows]) + "\n")

from training.evaluation.tables import INNOVATION_COLUMNS, innovation_rows, table

scenario = make_scenario("replay-v0", path=str(home), believed=str(believed))
result = evaluate(scenario, ["ekf", "ekf:cooperate=false"], runs=1, bound=False)
print("\n".join(table(INNOVATION_COLUMNS, innovation_rows(result))))
print(f"at marked points: {result.summary['agents']['ekf']['rmse']:.3f} m")

# %% [markdown]
# The NIS is low where noise that lasts was counted in: the filter is careful, not wrong. From a ROS
# bag: [recordings](../how-to/recordings.md). A robot that is moving now: the same folder without
# data is what an online localizer is set up with.
