# %% [markdown]
# # Train a policy
#
# A policy that corrects a Kalman filter where a third of all ranges are biased. The run below is
# far too short to learn much: it shows the parts. The full recipe takes two to five minutes on one
# core: `coloc train mappo --out runs/nlos --set variants=nlos=0.3`.

# %%
import json
import tempfile
from pathlib import Path

import torch

from training.learning import run
from training.learning.registry import TRAININGS

torch.set_num_threads(1)
{name: option.default for name, option in TRAININGS.options_of("mappo").items()}

# %% [markdown]
# A training is a run folder. It can be killed at any moment; `coloc train --resume FOLDER` ends in
# the same weights as an unbroken run.

# %%
folder = Path(tempfile.mkdtemp()) / "nlos"
chosen = {
    "scenario": "indoor-v0:motion=random:horizon=50:nlos=0.3",
    "worlds": 16,
    "epochs": 2,
    "score_runs": 2,
}
known = TRAININGS.options_of("mappo")
chosen = {name: value for name, value in chosen.items() if name in known}
weights = run.start("mappo", chosen, folder, lambda *_: None)
sorted(path.name for path in folder.iterdir())

# %% [markdown]
# The weights are safetensors; the card beside them says how they came to be.

# %%
card = json.loads(weights.with_suffix(".json").read_text())
{key: card[key] for key in ("training", "kind", "epochs", "frames")}

# %% [markdown]
# A trained policy is an agent like any other, and is evaluated beside the filters.

# %%
from coloc_env import make_scenario
from training.evaluation.evaluate import evaluate

scenario = make_scenario("indoor-v0", motion="random", horizon=50, nlos=0.3)
agents = ["ekf", f"mappo:weights={weights}", "mappo"]
found = evaluate(scenario, agents, runs=4, bound=False)
{name: round(figures["mean"], 3) for name, figures in found.summary["agents"].items()}

# %% [markdown]
# The last row is the policy that comes with coloc. Learn with `motion=random`: on a fixed circle a
# position is a function of time, and a policy can learn it by heart.
