# %% [markdown]
# # First flight
#
# Six UAVs circle in a room. Each has an IMU, sees landmarks near it, and measures its distance to
# the others by UWB. At every step each estimates where it is; the reward is minus the error in
# metres.

# %%
import numpy as np
import torch

import agents
from agents.policies.adapters import ParallelPolicy
from coloc_env import make_scenario, parallel_env

torch.set_num_threads(1)
env = parallel_env("indoor-v0", horizon=100)
observations, infos = env.reset(seed=1)
{name: leaf.shape for name, leaf in observations["uav_0"].items()}

# %% [markdown]
# An observation is a Dict of flat arrays, each with its mask. The reference lists every leaf with
# its unit and frame. An action is `[position, velocity, log-std]`: the estimate of the state *at
# the step observed*.
#
# A localizer is built from what the team believes, never from the truth. `ParallelPolicy` makes it
# act in a PettingZoo environment.

# %%
policy = ParallelPolicy(agents.make("ekf", env.scenario))
policy.reset()
errors = []
while env.agents:
    actions = policy({agent: observations[agent] for agent in env.agents})
    observations, rewards, terminations, truncations, infos = env.step(actions)
    errors.append([-rewards[agent] for agent in env.possible_agents])
np.sqrt(np.mean(np.square(errors), axis=0)).round(3)

# %% [markdown]
# How good is that? The posterior Cramér–Rao bound says what no unbiased team can beat.
# `evaluate` runs several localizers in the same worlds, and the bound of those worlds beside them.

# %%
from training.evaluation.evaluate import evaluate

scenario = make_scenario("indoor-v0", horizon=100, nlos=0.3)
found = evaluate(scenario, ["dead_reckoning", "ekf", "ekf:robust=huber", "ekf_trust"], runs=4)
print("bound", round(found.bound.rmse, 3))
{name: round(figures["rmse"], 3) for name, figures in found.summary["agents"].items()}

# %% [markdown]
# A third of all ranges carry a bias here, which the plain filter takes for the truth. Huber's
# weights and the learned trust do not.
#
# The same from the command line, with figures and tables:
#
# ```bash
# coloc evaluate indoor-v0 --agents ekf,ekf:robust=huber,ekf_trust --set nlos=0.3 --out results/nlos
# ```
