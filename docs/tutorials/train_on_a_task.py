# %% [markdown]
# # Train a policy in five minutes
#
# Four UAVs cover an area whose only anchors are in one corner (`survey-v0`). Ground counts where a
# UAV knows its position to a metre, so that they must spread out, and yet keep ranging each other.
# A policy that starts from nothing, and imitates no rule, learns to in two minutes on one core.

# %%
import json
import tempfile
from pathlib import Path

import torch

from training.learning import run
from training.learning.registry import TRAININGS

torch.set_num_threads(1)
{name: option.default for name, option in TRAININGS.options_of("task-mappo").items()}

# %% [markdown]
# `reward=sigma` rewards by how likely the filter thinks that a UAV knows its position, smoother
# than whether it does; scores are of the true error either way. A training is a folder. This one
# is a tenth of the real one; on a command line, the real one is
#
# ```bash
# coloc train task-mappo --out runs/survey --set task=survey-v0:reward=sigma
# ```

# %%
folder = Path(tempfile.mkdtemp()) / "survey"
chosen = {"task": "survey-v0:reward=sigma", "worlds": 32, "epochs": 8, "minibatches": 4}
weights = run.start("task-mappo", chosen | {"score_worlds": 32}, folder, lambda *_: None)
sorted(path.name for path in folder.iterdir())

# %% [markdown]
# The curves are there as CSV (`metrics/`), as JSON and as a picture: the return of each epoch's
# episodes, in worlds that no other epoch saw.

# %%
curves = json.loads((folder / "curves.json").read_text())
[round(value, 1) for _, value in curves["return"]]

# %% [markdown]
# The weights act like any other policy of the task: at random, by the best rule, and what was
# learned so far.

# %%
from agents.policies.task_policy import load_policy
from agents.tasks import make_task
from agents.tasks.runner import rollout

task = make_task("survey-v0")
worlds = torch.arange(16)


def mean_return(policy):
    return round(float(sum(step.reward.mean() for step in rollout(task, policy, worlds))), 1)


policies = {name: task.policies[name] for name in ("random", task.best)}
policies["learned"] = load_policy(task, str(weights))
{name: mean_return(policy) for name, policy in policies.items()}

# %% [markdown]
# `coloc score survey-v0 --policy runs/survey/task-mappo.safetensors` says how good a policy is by
# the protocol: 256 fixed worlds, an interval, what others' randomness costs.
#
# A run says how it was made. To run it again, with another seed:
#
# ```bash
# coloc train --config runs/survey/run.json --set seed=1 --out runs/survey-1
# ```
#
# Next: [all trainings on tasks, and what each trick is worth](../results/learned_tasks.md).
