"""Learning after the flight: a replay buffer of what an epoch's worlds gave, in several passes."""

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.objectives import LossModule
from torchrl.trainers import ReplayBufferTrainer, Trainer

from training.learning.collectors import Flights, world_seed
from training.learning.run import make_trainer


def offline_trainer(
    flights: Flights,
    loss: LossModule,
    samples: Callable[[TensorDictBase], TensorDict],
    held_out: Callable[[TensorDict], dict[str, float | Tensor]],
    *,
    learning_rate: float,
    most: int,
    minibatch: int,
    passes: int,
    seed: int,
) -> Trainer:
    """Adam on minibatches of each epoch's ``samples`` (``most`` rows), in an order drawn from
    (seed, epoch). Worlds are always new ones, so what ``held_out`` says of the rows before they are
    trained on, which is logged, is said of held-out ones."""
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(most), sampler=SamplerWithoutReplacement(), batch_size=minibatch
    )
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate)
    trainer = make_trainer(flights, loss, optimizer, steps_per_batch=None, passes=passes)
    generator = torch.Generator()
    buffer.set_rng(generator)

    def fill(batch: TensorDictBase) -> None:
        generator.manual_seed(world_seed(seed, flights.epoch, 1))
        buffer.empty()
        buffer.extend(samples(batch))

    @torch.no_grad()
    def told(batch: TensorDictBase) -> dict[str, float]:
        return {key: float(value) for key, value in held_out(buffer[:]).items()}

    trainer.register_op("batch_process", fill)
    trainer.register_op("pre_steps_log", told)
    trainer.register_op("process_optim_batch", ReplayBufferTrainer(buffer, iterate=True).sample)
    return trainer
