"""MAPPO with TorchRL's own parts on the grouped environment: keys ``("uav", ...)``, batch [B, N].

A policy of each UAV's own observation corrects its EKF; a critic sees those of the whole team. The
team believes its ranges to be four times as precise as they are. (The full version, with one row
per UAV, recurrent and resumable, is ``training/learning/mappo.py``.)

    pip install -e .
    python -m training.examples.torchrl_mappo
"""

import time
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.envs import CatTensors, EnvBase, ExplorationType, TransformedEnv, set_exploration_type
from torchrl.modules import MultiAgentMLP, NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives.multiagent import MAPPOLoss

from agents.policies.actor import Normalizer
from agents.wrappers.correction import with_base
from coloc_env import CoLocEnv

SCENARIO: dict[str, Any] = {
    "uwb_std": 0.2,
    "believed_uwb_std": 0.05,
    "nlos": 0.3,
    "motion": "random",
}
SEEN, ACTION, VALUE = ("uav", "features"), ("uav", "action"), ("uav", "state_value")


def environment(worlds: int, horizon: int, seed: int) -> EnvBase:
    """Corrections on an EKF; the leaves that a policy should read side by side in one entry."""
    env = with_base(CoLocEnv("indoor-v0", worlds, seed=seed, horizon=horizon, **SCENARIO), "ekf")
    leaves = [("uav", "observation", name) for name in env.mode.features]
    return TransformedEnv(env, CatTensors(leaves, SEEN, del_keys=False))


@torch.no_grad()
def mean_error(policy: TensorDictModuleBase, horizon: int) -> float:
    """Mean error (m) of the best actions in 40 held-out worlds."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = environment(40, horizon, 0).rollout(horizon, policy)
    return -float(rollout["next", "uav", "reward"].mean())


def main(
    steps: int = 600_000, worlds: int = 128, horizon: int = 200, seed: int = 0
) -> dict[str, float]:
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    env = environment(worlds, horizon, 1_000_000 * (seed + 1))
    _, uavs, width = env.observation_spec[SEEN].shape
    outputs = env.full_action_spec[ACTION].shape[-1]
    normal = Normalizer(width)
    normal.fit(environment(16, horizon, 500_000).rollout(min(horizon, 40))[SEEN].flatten(0, -2))
    body: dict[str, Any] = {"n_agents": uavs, "share_params": True, "depth": 2, "num_cells": 64}
    network = MultiAgentMLP(width, 2 * outputs, centralized=False, **body)
    actor = nn.Sequential(normal, network, NormalParamExtractor("biased_softplus_0.3"))
    policy = ProbabilisticActor(
        TensorDictModule(actor, [SEEN], [("uav", "loc"), ("uav", "scale")]),
        in_keys=[("uav", "loc"), ("uav", "scale")],
        out_keys=[ACTION],  # without it the action would go to the root
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    centre = nn.Sequential(normal, MultiAgentMLP(width, 1, centralized=True, **body))
    loss = MAPPOLoss(policy, TensorDictModule(centre, [SEEN], [VALUE]), entropy_bonus=False)
    loss.set_keys(  # every one of them: the defaults are the root's
        action=ACTION,
        sample_log_prob=("uav", "action_log_prob"),
        value=VALUE,
        reward=("uav", "reward"),
        advantage=("uav", "advantage"),
        value_target=("uav", "value_target"),
    )  # done and terminated are the root's: they hold for the team
    loss.make_value_estimator(gamma=0.0, lmbda=0.95)  # corrections are not fed back: a bandit's
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
    rows = worlds * 25
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(rows), sampler=SamplerWithoutReplacement(), batch_size=rows // 8
    )
    batches = -(-steps // (rows * uavs))
    still = TensorDictModule(lambda seen: torch.zeros(*seen.shape[:-1], outputs), [SEEN], [ACTION])
    before = mean_error(still, horizon)
    start = time.perf_counter()
    collector = Collector(
        env,
        policy,
        frames_per_batch=rows,
        total_frames=rows * batches,
        auto_register_policy_transforms=True,
    )
    for batch in collector:  # [worlds, 25]
        with torch.no_grad():
            loss.value_estimator(batch)  # of steps in order: before any shuffling
        buffer.empty()
        buffer.extend(batch.exclude("next", ("uav", "observation")).reshape(-1))
        for _ in range(4):
            for part in buffer:
                losses = loss(part)
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
                optimizer.zero_grad()
    speed = batches * rows * uavs / (time.perf_counter() - start)
    collector.shutdown()
    after = mean_error(policy, horizon)
    print(f"mean error {before:.3f} m of the EKF, {after:.3f} m corrected")
    print(f"{speed:,.0f} agent-steps/s")
    return {"before": before, "after": after, "speed": speed}


if __name__ == "__main__":
    main()
