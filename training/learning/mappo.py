"""IPPO and MAPPO with TorchRL's own parts: policies that correct a localizer, or localize alone.

Read it from top to bottom, and copy it: worlds (``environment``), networks (``policy_of``,
``Critic``), and one function, ``_ppo``, that puts collector, loss, buffer and trainer together.
Every UAV of every world is a row of its own (``coloc_env.envs.torchrl``); all share one policy. The
critic sees its own UAV's observation (IPPO) or the privileged state of the team beside it (MAPPO).
"""

from collections.abc import Mapping, Sequence
from functools import partial, wraps
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.modules import LSTMModule, ProbabilisticActor, TanhNormal
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.trainers import ReplayBufferTrainer

from agents import make
from agents.parts import move
from agents.policies.actor import Actor, Body
from agents.policies.learned import PolicyAgent, actor_for, inputs_of, mode_of
from agents.weights import drawn_from
from agents.wrappers.correction import learners_mode
from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv
from coloc_env.options import Factor, PositiveCount, Share
from coloc_env.scenario import Scenario
from coloc_env.scenarios import parse_scenario
from training.evaluation import metrics
from training.evaluation.record import record
from training.learning.collectors import (
    Concatenated,
    EpochCollector,
    Epochs,
    ScoreRuns,
    Seed,
    Steps,
    Width,
    Worlds,
    episode_collector,
    require_batches,
    world_seed,
)
from training.learning.run import Progress, Training, make_trainer

NORMALIZING = 40  # random steps from which inputs are normalized
_KEPT = (
    *("observation", "state", "action", "action_log_prob"),
    *("advantage", "value_target", "state_value", "is_init"),
)
_MEMORY = ("hidden", "cell")


def environment(
    scenario: Scenario,
    worlds: int,
    seed: int,
    base: str,
    feedback: float,
    device: str = "cpu",
) -> PerUavEnv:
    """``worlds`` worlds seen by each UAV for itself: corrections on a base's estimates, or, with
    ``base=none``, displacements of the UAV's own."""
    mode = learners_mode(scenario.believed, base, feedback)
    move(mode, device)
    return PerUavEnv(CoLocEnv(scenario, worlds, device, seed=seed, action=mode))


def policy_of(actor: Actor) -> ProbabilisticActor:
    """The actor as TorchRL's loss and collector want it: observation → action, squashed."""
    parts = [TensorDictModule(actor.body, ["observation"], ["embedded"])]
    if actor.lstm is not None:
        after = [("next", name) for name in _MEMORY]
        parts.append(
            LSTMModule(
                lstm=actor.lstm, in_keys=["embedded", *_MEMORY], out_keys=["embedded", *after]
            )
        )
    parts.append(TensorDictModule(actor.head, ["embedded"], ["loc", "scale"]))
    return ProbabilisticActor(
        TensorDictSequential(*parts),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


class Critic(nn.Module):
    """The value of a UAV's observation, and, if it has it, of its team's privileged state."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.body = Body(width, hidden, 2, "tanh")
        self.head = nn.Linear(hidden, 1)

    def forward(self, *seen: Tensor) -> Tensor:
        return self.head(self.body(torch.cat(seen, -1)))


def _ppo(
    name: str,
    loss_class: type[MAPPOLoss],
    reads: Sequence[str],
    device: str = "cpu",
    *,
    scenario: str = "indoor-v0:motion=random:horizon=200",
    variants: str = "",
    base: str = "ekf",
    feedback: Share = 0.0,
    recurrent: bool = True,
    hidden: Width = 64,
    worlds: Worlds = 128,
    epochs: Epochs = 20,
    steps: Steps = 25,
    passes: PositiveCount = 4,
    minibatches: PositiveCount = 8,
    learning_rate: Factor = 1e-3,
    gamma: Share = 0.0,
    gae_lambda: Share = 0.95,
    clip: Factor = 0.2,
    entropy: Share = 0.0,
    seed: Seed = 0,
    score_runs: ScoreRuns = 40,
) -> Training:
    scenarios = [parse_scenario(scenario, variant) for variant in variants.split("/")]
    require_batches(name, scenarios, steps)
    if worlds % len(scenarios):
        raise ValueError(
            f"{name}: worlds={worlds} must be a multiple of the {len(scenarios)} variants"
        )
    share = worlds // len(scenarios)

    def environments(first: int, each: int = share) -> list[PerUavEnv]:
        return [
            environment(one, each, first + i * each, base, feedback, device)
            for i, one in enumerate(scenarios)
        ]

    ones = environments(0, 1)
    kinds = {(e.scenario.horizon, e.n_uavs, *inputs_of(e.mode).items()) for e in ones}
    if len(kinds) > 1:
        raise ValueError(
            f"{name}: variants={variants!r} must have one horizon, one number of UAVs, and the "
            "same leaves for a policy to read"
        )
    samples = _random_steps(environments(world_seed(seed, epochs, worlds), min(share, 16)), seed)
    with drawn_from(seed):
        actor = actor_for(ones[0].mode, hidden=hidden, recurrent=recurrent).to(device)
        read = torch.cat([samples[key] for key in reads], -1)
        critic = Critic(read.shape[-1], hidden).to(device)
        actor.body.normal.fit(samples["observation"])
        critic.body.normal.fit(read)
    policy = policy_of(actor)
    value = TensorDictModule(critic, list(reads), ["state_value"])
    loss = loss_class(
        policy,
        value,
        clip_epsilon=clip,
        entropy_bonus=entropy > 0,
        entropy_coeff=entropy,
        normalize_advantage_exclude_dims=(),
    )
    loss.make_value_estimator(gamma=gamma, lmbda=gae_lambda)
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate)

    def collect(epoch: int) -> Concatenated:
        # TorchRL draws actions from torch's shared generator: what an epoch draws must depend on
        # nothing but the epoch, so that a run that resumes at it ends in the same weights.
        torch.manual_seed(world_seed(seed, epoch, worlds))
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * (1 - epoch / epochs)
        envs = environments(world_seed(seed, epoch, worlds))
        return Concatenated([episode_collector(env, policy, steps) for env in envs])

    collector = EpochCollector(collect, epochs)
    rows = worlds * scenarios[0].arena.n_uavs
    buffer = ReplayBuffer(  # of rows, each with its steps in order, as an LSTM needs them
        storage=LazyTensorStorage(rows, device=device),
        sampler=SamplerWithoutReplacement(),
        batch_size=-(-rows // minibatches),
    )
    kept = _KEPT + (_MEMORY if recurrent else ())

    def fill(batch: TensorDictBase) -> None:
        with torch.no_grad():
            loss.value_estimator(batch)  # advantages, of steps in order: before any shuffling
        buffer.empty()
        buffer.extend(batch.select(*kept))

    trainer = make_trainer(collector, loss, optimizer, None, passes=passes, clip_norm=1.0)
    trainer.register_op("batch_process", fill)
    trainer.register_op("process_optim_batch", ReplayBufferTrainer(buffer, iterate=True).sample)
    trainer.register_op("pre_steps_log", _figures)
    return Training(
        module=actor,
        collector=collector,
        trainer=trainer,
        score=partial(score, name, actor, scenarios, score_runs),
    )


@wraps(_ppo, assigned=())
def mappo(device: str = "cpu", **options: Any) -> Training:
    """A policy for every UAV, with a critic that sees the team's truth (MAPPO, Yu et al. 2022).

    It corrects the estimates of a ``base`` localizer, or, with ``base=none``, localizes alone.
    Every epoch runs ``worlds`` new worlds of the ``scenario`` to its horizon, in batches of
    ``steps`` steps; ``variants``, overrides joined by ``/``, share the worlds
    (``variants=nlos=0.3/false_matches=0.1``). ``recurrent``: an LSTM. ``gamma=0`` fits corrections
    that are not fed back (``feedback``): each is a bandit's. The learning rate falls linearly. At
    the end the policy meets its base and a Huber EKF in ``score_runs`` held-out worlds.
    """
    return _ppo("mappo", MAPPOLoss, ("observation", "state"), device, **options)


@wraps(_ppo, assigned=())
def ippo(device: str = "cpu", **options: Any) -> Training:
    """A policy for every UAV, with a critic of its own observation (IPPO, de Witt et al. 2020).

    Options as ``coloc train mappo`` has them.
    """
    return _ppo("ippo", IPPOLoss, ("observation",), device, **options)


def _random_steps(envs: Sequence[PerUavEnv], seed: int) -> TensorDictBase:
    """What is seen in some random steps."""
    with drawn_from(seed), torch.no_grad():
        seen = [env.rollout(NORMALIZING).select("observation", "state").flatten() for env in envs]
    return torch.cat(seen)


def _figures(batch: TensorDictBase) -> dict[str, float]:
    """RMSE (m) and mean error (m) of a batch with rewards of −error."""
    reward = batch["next", "reward"]
    return {"rmse": float(reward.square().mean().sqrt()), "error": float(-reward.mean())}


def score(
    name: str,
    actor: Actor,
    scenarios: Sequence[Scenario],
    runs: int,
    progress: Progress,
) -> Mapping[str, Any]:
    """RMSE (m) of the policy, its base and a Huber EKF in worlds 0 … runs − 1 of each scenario."""
    if runs == 0:
        return {}
    found: dict[str, Any] = {}
    settings = actor.architecture["mode"]
    rivals = (settings.get("base", "dead_reckoning"), "ekf:robust=huber")
    for scenario in scenarios:
        mode = mode_of(scenario.believed, settings)
        compared: dict[str, Any] = {name: PolicyAgent.of(scenario.believed, actor, mode)}
        compared |= {rival: make(rival, scenario) for rival in rivals}
        key = ":".join(f"{k}={v}" for k, v in scenario.overrides.items())
        found[key] = {}
        for agent, one in compared.items():
            result = record(one, scenario, torch.arange(runs))
            found[key][agent] = metrics.rmse(result.error, result.worlds.scored)
        progress("scoring", len(found), len(scenarios))
    return {"runs": runs, "seeds": [0, runs - 1], "rmse": found}
