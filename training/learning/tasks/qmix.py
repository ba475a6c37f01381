"""QMIX on tasks with choices, by TorchRL's own parts (Rashid et al. 2018).

Every UAV has the value of each of its choices by one shared network; a mixer that is monotone in
them makes the team's value, which alone is learned, from the team's reward.
"""

from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import Categorical, LazyTensorStorage, ReplayBuffer
from torchrl.modules import EGreedyModule, QMixer, QValueModule
from torchrl.objectives import HardUpdate
from torchrl.objectives.multiagent import QMixerLoss
from torchrl.trainers import ReplayBufferTrainer, TargetNetUpdaterHook

from agents.policies.decisions import actor_for
from agents.tasks import make_task
from agents.weights import drawn_from
from coloc_env.options import Factor, OpenShare, PositiveCount, Share
from training.learning.collectors import EpochCollector, Epochs, Seed, Width, Worlds, world_seed
from training.learning.run import Training, make_trainer
from training.learning.tasks.environment import environment
from training.learning.tasks.ppo import Moves, Network, Reader, acting, figures
from training.learning.tasks.scoring import ScoreWorlds, score

_UAV = "uav"
_VALUES, _CHOSEN = (_UAV, "action_value"), (_UAV, "chosen_action_value")
_DECIDED = (_UAV, "decision")


class Kept:
    """A replay buffer as a run's state keeps it: its rows in their places, and the next place."""

    def __init__(self, buffer: ReplayBuffer) -> None:
        self.buffer = buffer

    def state_dict(self) -> dict[str, Any]:
        rows = dict(self.buffer[:].flatten_keys(".").items()) if len(self.buffer) else {}
        return {"rows": rows, "writer": self.buffer.writer.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        rows = state_dict["rows"]
        if rows:
            count = len(next(iter(rows.values())))
            self.buffer.extend(TensorDict(rows, [count]).unflatten_keys("."))
        self.buffer.writer.load_state_dict(state_dict["writer"])


def task_qmix(
    device: str = "cpu",
    *,
    task: str = "schedule-v0",
    network: Network = "feedforward",
    moves: Moves = "none",
    hold: PositiveCount = 1,
    difference: bool = False,
    hidden: Width = 64,
    worlds: Worlds = 16,
    epochs: Epochs = 60,
    capacity: PositiveCount = 20_000,
    updates: PositiveCount = 100,
    minibatch: PositiveCount = 128,
    target_every: PositiveCount = 100,
    learning_rate: Factor = 5e-4,
    gamma: OpenShare = 0.97,
    first_random: Share = 0.5,
    last_random: Share = 0.02,
    seed: Seed = 0,
    score_worlds: ScoreWorlds = 256,
) -> Training:
    """A value of every choice, mixed to the team's (QMIX, Rashid et al. 2018), where a task has
    choices or ``moves`` makes some.

    Every epoch runs ``worlds`` new worlds to their horizon, with a share of random choices that
    falls from ``first_random`` to ``last_random`` over the first half of the epochs, and then makes
    ``updates`` steps on minibatches of the last ``capacity`` team steps. ``target_every``: updates
    between copies into the target network. Other options as ``coloc train task-mappo`` has them.
    """
    made = make_task(task)
    actor = actor_for(task, made, seed, network=network, moves=moves, hold=hold, hidden=hidden)
    actor = actor.to(device)
    if not actor.discrete:
        raise ValueError(f"task-qmix: {made.name} has no choices; moves=headings makes some")
    if network == "recurrent":
        raise ValueError("task-qmix: network=recurrent is not allowed: it learns from single steps")

    def worlds_of(epoch: int, count: int = worlds) -> Any:
        first = world_seed(seed, epoch, worlds)
        return environment(
            made, count, first, device, hold=hold, difference=difference, network=network
        )

    state = worlds_of(0, 1).observation_spec["state"].shape[-1:]
    with drawn_from(seed + 1):
        mixer = QMixer(state, 32, made.n_agents, device)
    reader = Reader(actor, made.choices is not None)
    values = TensorDictSequential(
        TensorDictModule(reader, reader.keys, [_VALUES]),
        QValueModule(
            action_value_key=_VALUES,
            out_keys=[_DECIDED, _VALUES, _CHOSEN],
            action_space="categorical",
        ),
    )
    loss = QMixerLoss(
        values, TensorDictModule(mixer, [_CHOSEN, "state"], ["chosen_action_value"]),
        action_space="categorical",
    )  # fmt: skip
    loss.set_keys(action=_DECIDED, action_value=_VALUES, local_value=_CHOSEN, reward="team_reward")
    loss.make_value_estimator(gamma=gamma)
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate)
    explore = EGreedyModule(
        Categorical(actor.architecture["outputs"], (worlds, made.n_agents)),
        eps_init=1.0,
        eps_end=0.0,
        action_key=_DECIDED,
        device=device,
        action_mask_key=(_UAV, "action_mask") if reader.masked else None,
    )
    player = acting(TensorDictSequential(values, explore), actor, made, device)
    decisions = made.scenario.horizon // hold
    generator = torch.Generator()
    buffer = ReplayBuffer(storage=LazyTensorStorage(capacity, device=device), batch_size=minibatch)
    buffer.set_rng(generator)

    def collect(epoch: int) -> Collector:
        torch.manual_seed(world_seed(seed, epoch, worlds))
        generator.manual_seed(world_seed(seed, epoch, worlds))
        left = max(0.0, 1 - 2 * epoch / epochs)
        explore.eps.fill_(last_random + (first_random - last_random) * left)
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * (1 - epoch / epochs)
        frames = worlds * decisions
        return Collector(
            worlds_of(epoch),
            player,
            frames_per_batch=frames,
            total_frames=frames,
            auto_register_policy_transforms=False,
        )

    def fill(batch: TensorDictBase) -> None:
        rows = batch.flatten()
        keys = [*reader.keys, "state"]
        kept = rows.select(*keys, _DECIDED)
        after = rows["next"].select(*keys, "done", "terminated")
        after["team_reward"] = rows["next", _UAV, "reward"].mean(1)
        # The horizon is what ends an episode, and its return: nothing comes after it.
        after["terminated"] = after["done"]
        buffer.extend(kept.set("next", after))

    trainer = make_trainer(
        EpochCollector(collect, epochs), loss, optimizer, updates, clip_norm=10.0
    )
    trainer.register_module("replay_buffer", Kept(buffer))
    trainer.register_op("batch_process", fill)
    trainer.register_op("process_optim_batch", ReplayBufferTrainer(buffer).sample)
    target = HardUpdate(loss, value_network_update_interval=target_every)
    trainer.register_op("post_optim", TargetNetUpdaterHook(target))
    trainer.register_op("pre_steps_log", figures)
    collector: Any = trainer.collector
    return Training(
        module=actor,
        collector=collector,
        trainer=trainer,
        score=partial(score, actor, score_worlds),
    )
