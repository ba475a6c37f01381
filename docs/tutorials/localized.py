# %% [markdown]
# # Localization inside simple_spread
#
# In most multi-agent tasks an agent's observation holds its true position. A robot has no such
# number: it has sensors, and what a localizer makes of them. `Localized` puts that in between, for
# a task that was written without it.

# %%
import numpy as np
import torch
from mpe2 import simple_spread_v3
from scipy.optimize import linear_sum_assignment

from agents.wrappers.adapters import simple_spread
from agents.wrappers.localized import Localized

torch.set_num_threads(1)
task = simple_spread_v3.parallel_env(max_cycles=25)
env = Localized(task, simple_spread, localizer="ekf", anchors=4)
observations, infos = env.reset(seed=1)
infos

# %% [markdown]
# The agents now carry an INS and UWB radios; four anchors stand in the corners. One unit of the
# task is taken for 10 m. Wherever the task's observation holds a place or a velocity there is now
# an estimate: the agent's own position and velocity, the landmarks relative to it, and the other
# agents relative to it, as they were heard. Rewards are the task's.
#
# A controller that knows nothing of all this: each agent goes to the landmark that an assignment
# over all of them gives it.


# %%
def controller(observation, me, n=3):
    own = observation[2:4]
    landmarks = own + observation[4 : 4 + 2 * n].reshape(n, 2)
    others = own + observation[4 + 2 * n : 2 + 4 * n].reshape(n - 1, 2)
    agents = np.insert(others, me, own, axis=0)
    distance = np.linalg.norm(agents[:, None] - landmarks, axis=-1)
    goal = landmarks[linear_sum_assignment(distance)[1][me]] - own
    wanted = goal - 0.6 * observation[:2]  # brake in time
    axis = int(np.abs(wanted[1]) > np.abs(wanted[0]))
    if np.abs(wanted[axis]) < 0.05:
        return 0
    return 1 + 2 * axis + int(wanted[axis] > 0)


def mean_return(env, episodes=12):
    total = []
    for seed in range(episodes):
        observations, _ = env.reset(seed=seed)
        total.append(0.0)
        while env.agents:
            actions = {
                agent: controller(observations[agent], i) for i, agent in enumerate(env.agents)
            }
            observations, rewards, _, _, _ = env.step(actions)
            total[-1] += np.mean(list(rewards.values()))
    return np.mean(total), np.std(total) / episodes**0.5


for name, settings in {
    "INS, 4 anchors": {"anchors": 4},
    "4 anchors, 30 % of ranges without line of sight": {"anchors": 4, "nlos": 0.3},
    "the same, robust": {"anchors": 4, "nlos": 0.3, "localizer": "ekf:robust=huber"},
    "ranges between agents only": {"anchors": 0},
    "INS only": {"anchors": 0, "uwb": False, "prior_std": 2.0},
}.items():
    mean, error = mean_return(Localized(task, simple_spread, **settings))
    print(f"{name:50s} {mean:6.2f} ± {error:.2f}")
mean, error = mean_return(task)
print(f"{'the truth':50s} {mean:6.2f} ± {error:.2f}")

# %% [markdown]
# ## A task of your own
#
# Two functions say all that is needed: where the agents are, and which numbers of an agent's
# observation are places or velocities. Everything else is kept as it is. Entries that are left out
# keep the truth, so a place that is forgotten leaks it.

# %%
from agents.wrappers.adapter import Adapter
from agents.wrappers.entries import Own, ToAgent, ToThing


def positions(env):
    return np.stack([agent.state.p_pos for agent in env.unwrapped.world.agents])


def entries(env, i):
    others = [j for j in range(3) if j != i]
    landmarks = [ToThing(slice(4 + 2 * k, 6 + 2 * k)) for k in range(3)]
    agents = [ToAgent(slice(10 + 2 * k, 12 + 2 * k), j) for k, j in enumerate(others)]
    return [Own(slice(0, 2), "velocity"), Own(slice(2, 4)), *landmarks, *agents]


mine = Adapter(positions, entries, low=(-1.5, -1.5), high=(1.5, 1.5), dt=0.1, metres=10.0)
Localized(task, mine).reset(seed=1)[1]

# %% [markdown]
# VMAS scenarios go through `agents.wrappers.localized_vmas`, other TorchRL environments through
# `agents.wrappers.localized_torchrl.LocalizedTransform`. With `std=True` agents also see how sure
# the localizer is. `training/examples/localized.py` and `localized_spread.py` train policies on the
# truth and on estimates: [what came of it](../results/localized.md).
