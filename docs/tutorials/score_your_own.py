# %% [markdown]
# # Score your own algorithm
#
# Whatever you train with, a score needs no more than a function. Two kinds are taken: one that acts
# in many worlds at once, and one for a single PettingZoo world.

# %%
import torch

from agents.tasks import make_task
from training.evaluation.score import score
from training.evaluation.task_policies import from_pettingzoo

torch.set_num_threads(1)
task = make_task("schedule-v0")
task.leaves["observation"].width, task.choices, task.n_agents

# %% [markdown]
# ## Many worlds at once
#
# `seen.observation` is [worlds, UAVs, numbers], flat and within [−1, 1]; `seen.mask` says which
# choices there are. Here a network, untrained: put yours in its place.

# %%
network = torch.nn.Sequential(
    torch.nn.Linear(task.leaves["observation"].width, 64),
    torch.nn.Tanh(),
    torch.nn.Linear(64, task.choices),
)


@torch.no_grad()
def mine(seen):
    """Draws a choice for each UAV: on a channel the likeliest of equals would collide for ever."""
    logits = network(seen.observation).masked_fill(~seen.mask, -torch.inf)
    drawn = torch.multinomial(logits.softmax(-1).flatten(0, 1), 1, generator=seen.random)
    return drawn.view(logits.shape[:2])


found = score("schedule-v0", mine, worlds=8)
{key: round(found[key], 2) for key in ("return", "random", "share_of_span")}

# %% [markdown]
# 256 worlds make a score to report; eight show the way. `share_of_span` is 0 for random actions
# and 1 for the best rule that is known. Beside it: what it costs `uav_0` if the others act at
# random, and what ranges between UAVs are worth.

# %%
found["interaction"], found["cooperation"]

# %% [markdown]
# ## One PettingZoo world
#
# A policy that takes PettingZoo's dictionaries is wrapped; one object is made for each world.


# %%
def make_policy():
    def act(observations, infos):
        return dict.fromkeys(observations, 0)  # silence

    return act


round(score("schedule-v0", from_pettingzoo(make_policy), worlds=4)["return"], 2)

# %% [markdown]
# On the command line, name the function, or weights of `coloc train`:
#
# ```bash
# coloc score schedule-v0 --policy my_module:mine --out score.json
# ```
