# %% [markdown]
# # Write a heuristic
#
# A policy of a task is a function: it is given what the team has `seen`, for many worlds at once,
# and returns an action for each UAV. Rules may use what the estimator says: positions, their
# covariances, what was heard.

# %%
import torch
from torch import Tensor

from agents.tasks import make_task
from agents.tasks.rules import Seen
from agents.tasks.runner import rollout

torch.set_num_threads(1)
task = make_task("convoy-v0")
worlds = torch.arange(16)


def mean_return(policy) -> float:
    return round(float(sum(step.reward.mean() for step in rollout(task, policy, worlds))), 1)


# %% [markdown]
# In `convoy-v0` four UAVs move along a corridor with anchors at its entry only. New ground counts
# while the error is below 1 m. First rule: all go.


# %%
def all_go(seen: Seen) -> Tensor:
    """Straight on, at top speed: actions are velocities in units of it, [worlds, UAVs, 2]."""
    return torch.tensor([1.0, 0.0]).expand(*seen.position.shape[:2], 2)


mean_return(all_go)

# %% [markdown]
# Odometry drifts, and whoever leaves the anchors behind gets lost. So: who is unsure of its
# position stands still, and is ranged by the others until it knows better.


# %%
def wait_when_unsure(seen: Seen, most: float = 0.5) -> Tensor:
    """On, where σ is below ``most`` m; else still."""
    sure = (seen.sigma < most).unsqueeze(-1)
    return torch.where(sure, all_go(seen), torch.zeros(()))


mean_return(wait_when_unsure)

# %% [markdown]
# Standing still among others that know no better helps nobody. So: one pair stands, and is what the
# other pair ranges to as it goes by; then they change places.


# %%
def take_turns(seen: Seen, turn: int = 14) -> Tensor:
    """Pairs in turns of so many seconds; the first turn is half as long, so that they pass."""
    count = (seen.memory.step + turn // 2) // turn  # [worlds, UAVs]
    pair = torch.arange(seen.task.n_agents) % 2
    goes = (count % 2 == pair).unsqueeze(-1)
    return torch.where(goes, all_go(seen), torch.zeros(()))


{"take turns": mean_return(take_turns), "leapfrog": mean_return(task.policies["leapfrog"])}

# %% [markdown]
# `leapfrog` is the best rule that comes with the task. To score one of your own by the protocol,
# put it in a module that Python finds, and name it `module:function`:
#
# ```bash
# coloc score convoy-v0 --policy my_rules:take_turns --out score.json
# ```
