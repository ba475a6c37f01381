# %% [markdown]
# # From PettingZoo to BenchMARL
#
# One task, three steps: as PettingZoo has it, as TorchRL has it, and what BenchMARL reads of that.
# Worlds are the same by seed on each of them.

# %%
import torch

from agents import tasks
from coloc_env import CoLocEnv

torch.set_num_threads(1)
env = tasks.parallel_env("survey-v0")
observations, infos = env.reset(seed=7)
env.possible_agents, env.observation_space("uav_0").shape, env.action_space("uav_0")

# %% [markdown]
# ## PettingZoo: one world, a dictionary an agent
#
# Twenty steps at full speed along the first axis.

# %%
total = 0.0
for _ in range(20):
    actions = {name: env.action_space(name).high * [1.0, 0.0] for name in env.agents}
    observations, rewards, terminations, truncations, infos = env.step(actions)
    total += sum(rewards.values()) / len(rewards)
round(total, 3)

# %% [markdown]
# ## TorchRL: many worlds, one tensor a team
#
# Agents are one group, `uav`, with their observations, actions and rewards stacked: this is what
# TorchRL's multi-agent losses and BenchMARL take. World 0 is the world of the seed above, and its
# return is the same.

# %%
task = tasks.make_task("survey-v0")
many = CoLocEnv(task.scenario, 4, seed=7, action=task)


def forward(tensordict):
    """Full speed along the first axis."""
    action = many.full_action_spec["uav", "action"].zero()
    action[..., 0] = 1.0
    return tensordict.set(("uav", "action"), action)


run = many.rollout(20, forward, break_when_any_done=False)
rewards = run["next", "uav", "reward"]  # [worlds, steps, UAVs, 1]
many.group_map, tuple(rewards.shape), round(float(rewards[0].sum(0).mean()), 3)

# %%
assert abs(float(rewards[0].sum(0).mean()) - total) < 1e-4

# %% [markdown]
# ## BenchMARL: specs and a name
#
# BenchMARL asks a task for its specs: what policies see, what they do, what critics may know.

# %%
seen = many.full_observation_spec
{
    "policies see": tuple(seen["uav", "observation"].shape[1:]),
    "they do": tuple(many.full_action_spec["uav", "action"].shape[1:]),
    "critics know": tuple(seen["state"].shape[1:]),
}

# %% [markdown]
# `training/examples/benchmarl_tasks.py` answers these questions for every task and registers them
# as `coloc/NAME`. BenchMARL wants another TorchRL than coloc does, so it runs in an environment of
# its own; the script's first lines say how to make one. Then its own command trains:
#
# ```bash
# python -m training.examples.benchmarl_tasks algorithm=mappo task=coloc/survey-v0 seed=1
# ```
#
# Discrete tasks bring their action mask, so QMIX works as well (`algorithm=qmix
# task=coloc/schedule-v0`). To compare with the leaderboard, score the actor as in
# "Score your own algorithm".
