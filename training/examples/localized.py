"""What localization costs somebody else's task, and what training on estimates gives back.

Policies of a VMAS task (``navigation`` or ``flocking``) are trained by IPPO, with TorchRL's own
parts, on the truth and on estimates, then run on the truth and on estimates of three qualities.

    pip install -e ".[bench]"
    python -m training.examples.localized

``--task flocking``, ``--seeds 5`` and ``--out localized.json`` make a study of it.
"""

import argparse
import importlib
import json
import time
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type
from torchrl.envs.libs.vmas import VmasEnv
from torchrl.modules import MultiAgentMLP, NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives.multiagent import MAPPOLoss

from agents.wrappers import adapters
from agents.wrappers.localized_vmas import localized_vmas

SEEN, ACTION, VALUE = ("agents", "observation"), ("agents", "action"), ("agents", "state_value")
HORIZON, ROLLOUT = 100, 25  # steps of an episode, and of it that are learnt from at a time
SETTINGS = {"navigation": {"n_agents": 3, "collisions": True}, "flocking": {"n_agents": 4}}
QUALITIES: dict[str, dict[str, Any] | None] = {
    "truth": None,
    "INS, 4 anchors": {"anchors": 4},
    "ranges between agents only": {"anchors": 0},
    "4 anchors, 30 % NLOS": {"anchors": 4, "nlos": 0.3},
}
TRAINED_ON = ("truth", "ranges between agents only")


def environment(
    task: str, quality: str, worlds: int, seed: int, steps: int | None = HORIZON
) -> EnvBase:
    """A VMAS task whose agents see the truth or estimates."""
    scenario = importlib.import_module(f"vmas.scenarios.{task}").Scenario()
    overrides = QUALITIES[quality]
    if overrides is not None:
        scenario = localized_vmas(scenario, getattr(adapters, task), **overrides)
    return VmasEnv(scenario, num_envs=worlds, max_steps=steps, seed=seed, **SETTINGS[task])


def actor_of(env: EnvBase) -> ProbabilisticActor:
    """One network for all agents, each with its own observation."""
    _, n, width = env.observation_spec[SEEN].shape
    outputs = env.full_action_spec[ACTION].shape[-1]
    body = MultiAgentMLP(
        width, 2 * outputs, n, centralized=False, share_params=True, depth=2, num_cells=64
    )
    keys = [("agents", "loc"), ("agents", "scale")]
    network = nn.Sequential(body, NormalParamExtractor("biased_softplus_0.5"))
    limits = env.full_action_spec_unbatched[ACTION].space
    return ProbabilisticActor(
        TensorDictModule(network, [SEEN], keys),
        in_keys=keys,
        out_keys=[ACTION],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": limits.low, "high": limits.high},
        return_log_prob=True,
    )


def trained(
    task: str, quality: str, steps: int, seed: int, worlds: int = 240
) -> ProbabilisticActor:
    """A policy after ``steps`` agent-steps of IPPO."""
    torch.manual_seed(seed)
    env = environment(task, quality, worlds, seed)
    _, n, width = env.observation_spec[SEEN].shape
    policy = actor_of(env)
    value = MultiAgentMLP(width, 1, n, centralized=False, share_params=True, depth=2, num_cells=64)
    loss = MAPPOLoss(policy, TensorDictModule(value, [SEEN], [VALUE]), entropy_coeff=1e-3)
    loss.set_keys(
        action=ACTION,
        sample_log_prob=("agents", "action_log_prob"),
        value=VALUE,
        reward=("agents", "reward"),
        advantage=("agents", "advantage"),
        value_target=("agents", "value_target"),
    )
    loss.make_value_estimator(gamma=0.95, lmbda=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), 7e-4)
    rows = worlds * ROLLOUT
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(rows), sampler=SamplerWithoutReplacement(), batch_size=rows // 8
    )
    batches = -(-steps // (rows * n))
    for batch in Collector(env, policy, frames_per_batch=rows, total_frames=rows * batches):
        with torch.no_grad():
            loss.value_estimator(batch)
        buffer.empty()
        buffer.extend(batch.reshape(-1))
        for _ in range(6):
            for part in buffer:
                losses = loss(part)
                sum(v for k, v in losses.items() if k.startswith("loss_")).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
                optimizer.zero_grad()
    return policy


@torch.no_grad()
def measured(
    task: str, policy: ProbabilisticActor, quality: str, worlds: int = 256
) -> dict[str, float]:
    """Per agent and episode the mean return and number of collisions, the share of episodes in
    which all reached their goals, and the mean localization error (m): of the best actions, in
    worlds that no training saw."""
    env = environment(task, quality, worlds, 10_000, steps=None)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        following = env.rollout(HORIZON, policy, break_when_any_done=False)["next"]
    ended = following["done"].squeeze(-1).cumsum(1)
    running = (ended - following["done"].squeeze(-1).long() == 0).unsqueeze(-1)  # first episodes

    def mean(values: torch.Tensor) -> float:
        return float((values.squeeze(-1).float() * running).sum(1).mean())

    info = following["agents", "info"]
    collisions = info["agent_collisions" if task == "navigation" else "agent_collision_rew"]
    found = {
        "return": mean(following["agents", "reward"]),
        "collisions": mean(collisions < 0),
        "success": float((ended[:, -1] > 0).float().mean()),
    }
    if "localization_error" in info:
        errors = info["localization_error"].squeeze(-1)
        found["error"] = float((errors * running).sum() / (running.sum() * errors.shape[-1]))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", choices=SETTINGS, default="navigation")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--steps", type=int, default=1_500_000, help="agent-steps a training")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    results: list[dict[str, Any]] = []
    for seed in range(chosen.seeds):
        for taught in TRAINED_ON:
            start = time.perf_counter()
            policy = trained(chosen.task, taught, chosen.steps, seed)
            print(f"seed {seed}, trained on {taught}: {time.perf_counter() - start:.0f} s")
            for quality in QUALITIES:
                found = measured(chosen.task, policy, quality)
                results.append({"seed": seed, "trained_on": taught, "run_on": quality, **found})
                print(f"  on {quality}: {found}")
            if chosen.out:
                chosen.out.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
