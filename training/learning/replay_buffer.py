"""Training after an episode: its samples in a replay buffer, in several passes."""

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.objectives import LossModule
from torchrl.trainers import ReplayBufferTrainer, Trainer

from training.learning.collectors import EpochCollector, world_seed
from training.learning.run import make_trainer


def replay_buffer_trainer(
    collector: EpochCollector,
    loss: LossModule,
    samples: Callable[[TensorDictBase], TensorDict],
    held_out: Callable[[TensorDict], dict[str, float | Tensor]],
    *,
    learning_rate: float,
    capacity: int,
    minibatch: int,
    passes: int,
    seed: int,
    device: str = "cpu",
) -> Trainer:
    """Adam on minibatches of each epoch's ``samples`` (at most ``capacity`` rows), in an order
    drawn from (seed, epoch). Worlds are always new ones, so ``held_out``'s figures of the rows
    before they are trained on, which are logged, are those of held-out rows."""
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(capacity, device=device),
        sampler=SamplerWithoutReplacement(),
        batch_size=minibatch,
    )
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate)
    trainer = make_trainer(collector, loss, optimizer, steps_per_batch=None, passes=passes)
    generator = torch.Generator()
    buffer.set_rng(generator)

    def fill(batch: TensorDictBase) -> None:
        rows = samples(batch)
        if not len(rows):
            raise ValueError("no step of the episode had truth and measurements to learn from")
        generator.manual_seed(world_seed(seed, collector.epoch, 1))
        buffer.empty()
        buffer.extend(rows)

    @torch.no_grad()
    def figures(batch: TensorDictBase) -> dict[str, float]:
        return {key: float(value) for key, value in held_out(buffer[:]).items()}

    trainer.register_op("batch_process", fill)
    trainer.register_op("pre_steps_log", figures)
    trainer.register_op("process_optim_batch", ReplayBufferTrainer(buffer, iterate=True).sample)
    return trainer
