"""IPPO and MAPPO on tasks, with TorchRL's own parts.

Read it from top to bottom, and copy it: the policy (``policy_of``), the critic (``Critic``), and
one function, ``_ppo``, that puts collector, loss, buffer and trainer together. Every epoch runs new
worlds from their start to the horizon and learns from those whole episodes, so that returns are
those that scores are made of. All UAVs share one policy. The critic sees its own UAV's observation
(IPPO), or the team's observations and true state beside it (MAPPO).
"""

from functools import partial, wraps
from typing import Annotated, Any

import torch
from jaxtyping import Float32
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.trainers import ReplayBufferTrainer

from agents.policies.decisions import actor_for
from agents.policies.moves import MOVES, table
from agents.policies.task_actor import NETWORKS, TaskActor
from agents.tasks import make_task
from agents.tasks.task import Task
from agents.weights import drawn_from
from coloc_env.options import Factor, OneOf, PositiveCount, Share
from training.learning.collectors import EpochCollector, Epochs, Seed, Width, Worlds, world_seed
from training.learning.run import Training, make_trainer
from training.learning.tasks.environment import environment
from training.learning.tasks.scoring import ScoreWorlds, score

Network = Annotated[str, OneOf(NETWORKS)]
Moves = Annotated[str, OneOf(("none", *MOVES))]

_UAV = "uav"
_DECIDED = (_UAV, "decision")  # a choice, or numbers: what the policy draws
_READ = ((_UAV, "observation"), (_UAV, "action_mask"), (_UAV, "relations"))
_KEPT = (
    *_READ,
    "state",
    _DECIDED,
    (_UAV, "decision_log_prob"),
    (_UAV, "advantage"),
    (_UAV, "value_target"),
    (_UAV, "state_value"),
)


class Reader(nn.Module):
    """An actor as a collector and a loss call it: step by step, where a recurrent one's memory goes
    on from call to call, or [B, T] whole episodes of a recurrent one."""

    def __init__(self, actor: TaskActor, masked: bool) -> None:
        super().__init__()
        self.actor, self.masked = actor, masked
        self.related = actor.architecture["features"] > 0
        self.carried: Tensor | None = None

    @property
    def keys(self) -> list[tuple[str, str]]:
        """What it reads."""
        read = (True, self.masked, self.related)
        return [key for key, there in zip(_READ, read, strict=True) if there]

    def forward(self, observation: Tensor, *more: Tensor) -> Any:
        rest = list(more)
        mask = rest.pop(0) if self.masked else None
        related = rest.pop(0) if self.related else None
        if self.actor.memory is not None and observation.ndim == 4:
            out = self.actor.sequence(observation, mask)
        else:
            out, self.carried = self.actor(observation, mask, related, self.carried)
        return out if self.actor.discrete else (out, self.actor.scale(out))


def policy_of(actor: TaskActor, task: Task) -> tuple[Reader, ProbabilisticActor]:
    """The actor as TorchRL's loss wants it: what is read → the decision and its log-probability."""
    reader = Reader(actor, task.choices is not None)
    names = ["logits"] if actor.discrete else ["loc", "scale"]
    outs = [(_UAV, name) for name in names]
    return reader, ProbabilisticActor(
        TensorDictModule(reader, reader.keys, outs),
        in_keys=dict(zip(names, outs, strict=True)),
        out_keys=[_DECIDED],
        distribution_class=torch.distributions.Categorical if actor.discrete else TanhNormal,
        return_log_prob=True,
        log_prob_key=(_UAV, "decision_log_prob"),
    )


def acting(policy: nn.Module, actor: TaskActor, task: Task, device: str) -> Any:
    """The policy with its decisions as the task's actions."""
    moves = actor.architecture["moves"]
    menu = None if moves == "none" else table(moves, task.dim).to(device)
    act = TensorDictModule(
        lambda decision: decision if menu is None else menu[decision],
        [_DECIDED],
        [(_UAV, "action")],
    )
    return TensorDictSequential(policy, act)


class Critic(nn.Module):
    """The value of a UAV's observation, and, where a ``state`` of some width is known, of the
    team's observations and of that; in units of ``unit``, which is what returns spread by at
    first."""

    unit: Tensor

    def __init__(self, width: int, hidden: int, state: int) -> None:
        super().__init__()
        self.own, self.second = nn.Linear(width, hidden), nn.Linear(hidden, hidden)
        self.head = nn.Linear(hidden, 1)
        self.register_buffer("unit", torch.ones(()))
        if state:
            self.team, self.truth = nn.Linear(width, hidden), nn.Linear(state, hidden)

    @torch.no_grad()
    def fit(self, reward: Float32[Tensor, "B T n 1"], gamma: float) -> None:
        """Take the unit, and the value to start from, from some episodes' rewards."""
        returns, after = [], torch.zeros_like(reward[:, 0])
        for step in reward.flip(1).unbind(1):
            after = step + gamma * after
            returns.append(after)
        every = torch.stack(returns)
        self.unit.copy_(every.std().clamp_min(1e-6))
        self.head.bias.fill_(float(every.mean() / self.unit))

    def forward(self, observation: Tensor, state: Tensor | None = None) -> Tensor:
        x = self.own(observation)
        if state is not None:
            x = x + torch.tanh(self.team(observation)).mean(-2, keepdim=True)
            x = x + self.truth(state).unsqueeze(-2)
        return self.head(torch.tanh(self.second(torch.tanh(x))))


def _ppo(
    name: str,
    loss_class: type[MAPPOLoss],
    device: str = "cpu",
    *,
    task: str = "survey-v0:reward=sigma",
    network: Network = "feedforward",
    moves: Moves = "none",
    hold: PositiveCount = 1,
    difference: bool = False,
    hidden: Width = 64,
    worlds: Worlds = 128,
    epochs: Epochs = 36,
    passes: PositiveCount = 8,
    minibatches: PositiveCount = 8,
    learning_rate: Factor = 1.5e-3,
    gamma: Share = 0.97,
    gae_lambda: Share = 0.95,
    clip: Factor = 0.2,
    entropy: Share = 0.003,
    last_entropy: Share = 0.0,
    draw: bool = False,
    seed: Seed = 0,
    score_worlds: ScoreWorlds = 256,
) -> Training:
    made = make_task(task)
    actor = actor_for(
        task,
        made,
        seed,
        network=network,
        moves=moves,
        hold=hold,
        hidden=hidden,
        sampled=draw or made.sampled,
    ).to(device)

    def worlds_of(epoch: int, count: int = worlds) -> Any:
        first = world_seed(seed, epoch, worlds)
        return environment(
            made, count, first, device, hold=hold, difference=difference, network=network
        )

    central = loss_class is MAPPOLoss
    state = worlds_of(0, 1).observation_spec["state"].shape[-1] if central else 0
    with drawn_from(seed + 1):
        critic = Critic(made.leaves["observation"].width, hidden, state).to(device)
    reader, policy = policy_of(actor, made)
    reads: list[Any] = [(_UAV, "observation"), *(["state"] if central else [])]
    value = TensorDictModule(critic, reads, [(_UAV, "state_value")])
    loss = loss_class(
        policy,
        value,
        clip_epsilon=clip,
        entropy_bonus=entropy > 0,
        entropy_coeff=entropy,
        normalize_advantage_exclude_dims=(),
    )
    loss.set_keys(
        action=_DECIDED,
        sample_log_prob=(_UAV, "decision_log_prob"),
        value=(_UAV, "state_value"),
        value_target=(_UAV, "value_target"),
        advantage=(_UAV, "advantage"),
        reward=(_UAV, "reward"),
    )
    loss.make_value_estimator(gamma=gamma, lmbda=gae_lambda)
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate, eps=1e-5)
    decisions = made.scenario.horizon // hold
    player = acting(policy, actor, made, device)

    def collect(epoch: int) -> Collector:
        # TorchRL draws actions from torch's shared generator: what an epoch draws must depend on
        # nothing but the epoch, so that a run that resumes at it ends in the same weights.
        torch.manual_seed(world_seed(seed, epoch, worlds))
        left = 1 - epoch / epochs
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * left
        if entropy > 0:
            loss.entropy_coeff.fill_(last_entropy + (entropy - last_entropy) * left)
        collecting = Collector(
            worlds_of(epoch),
            player,
            frames_per_batch=worlds * decisions,
            total_frames=worlds * decisions,
            auto_register_policy_transforms=False,
        )
        reader.carried = None  # the Collector has tried the policy once
        return collecting

    collector = EpochCollector(collect, epochs)
    whole = network == "recurrent"  # episodes are kept whole, in order
    rows = worlds if whole else worlds * decisions
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(rows, device=device),
        sampler=SamplerWithoutReplacement(),
        batch_size=-(-rows // minibatches),
    )

    def fill(batch: TensorDictBase) -> None:
        rewards = batch["next", _UAV, "reward"]
        if collector.epoch == 0:
            critic.fit(rewards, gamma)
        rewards.div_(critic.unit)
        # The horizon is what ends an episode, and its return: nothing comes after it.
        batch["next", "terminated"] = batch["next", "done"]
        with torch.no_grad():
            loss.value_estimator(batch)  # advantages, of steps in order: before any shuffling
        kept = batch.select(*_KEPT, strict=False)
        buffer.empty()
        buffer.extend(kept if whole else kept.flatten())

    trainer = make_trainer(collector, loss, optimizer, None, passes=passes, clip_norm=1.0)
    trainer.register_op("batch_process", fill)
    trainer.register_op("process_optim_batch", ReplayBufferTrainer(buffer, iterate=True).sample)
    trainer.register_op("pre_steps_log", figures)
    return Training(
        module=actor,
        collector=collector,
        trainer=trainer,
        score=partial(score, actor, score_worlds),
    )


@wraps(_ppo, assigned=())
def task_mappo(device: str = "cpu", **options: Any) -> Training:
    """A policy for all UAVs of a task, with a critic that sees the team's observations and truth
    (MAPPO, Yu et al. 2022).

    Every epoch runs ``worlds`` new worlds of the ``task`` (with its options, as ``coloc score`` has
    them) from their start to the horizon and learns from them in ``passes`` passes. ``network``:
    recurrent, graph attention over neighbours, or one that scores each candidate exchange.
    ``moves``: choices in place of velocities; ``hold``: for how many steps each decision is held.
    ``difference``: each call is rewarded by what it was worth to the team; the task's own option
    ``reward=sigma`` rewards the filter's σ in place of the true error. ``draw``: the policy goes on
    drawing its actions when training is over, as it does anyway where a channel is shared. Learning
    rate and entropy bonus fall linearly. At the end the policy meets ``score_worlds`` of the
    protocol's worlds.
    """
    return _ppo("task-mappo", MAPPOLoss, device, **options)


@wraps(_ppo, assigned=())
def task_ippo(device: str = "cpu", **options: Any) -> Training:
    """A policy for all UAVs of a task, with a critic of its own observation (IPPO, de Witt et al.
    2020).

    Options as ``coloc train task-mappo`` has them.
    """
    return _ppo("task-ippo", IPPOLoss, device, **options)


def figures(batch: TensorDictBase) -> dict[str, float]:
    """The task's return, whatever reward trains."""
    return {"return": float(batch["next", "score"].sum(1).mean())}
