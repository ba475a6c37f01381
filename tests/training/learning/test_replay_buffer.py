"""Learning after the episode: every sample once a pass, in an order of the seed's and epoch's."""

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from training.learning.collectors import EpochCollector
from training.learning.replay_buffer import replay_buffer_trainer

PASSES, MINIBATCH, STEPS = 3, 4, 11


class Recording(LossModule):
    """A loss that remembers its batches."""

    in_keys = ["number"]  # noqa: RUF012
    out_keys = ["loss_model"]  # noqa: RUF012

    def __init__(self) -> None:
        super().__init__()
        self.model = nn.Linear(1, 1, bias=False)
        self.seen: list[list[int]] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        self.seen.append(tensordict["number"].tolist())
        x = tensordict["number"].float().unsqueeze(-1)
        return TensorDict({"loss_model": self.model(x).square().mean()})


class Logger:
    """As much of a logger as a trainer asks for."""

    def __init__(self) -> None:
        self.values: list[tuple[str, float]] = []

    def log_scalar(self, name: str, value: Any, step: int | None = None) -> None:
        self.values.append((name, float(value)))


class Episode:
    """One batch of ``STEPS`` steps, numbered from a hundred of the epoch's on."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def __iter__(self) -> Iterator[TensorDictBase]:
        number = 100 * self.epoch + torch.arange(STEPS).unsqueeze(0)
        yield TensorDict({"number": number}, [1, STEPS])

    def shutdown(self) -> None:
        pass


def trained(seed: int, epochs: int, skipped: int = 0) -> tuple[Recording, Logger, list[Tensor]]:
    """What the loss met, what was logged, and the weight that each epoch's figures are of."""
    torch.manual_seed(0)
    loss, weights = Recording(), []

    def odd(batch: TensorDictBase) -> TensorDict:
        rows = batch.flatten()
        return rows[rows["number"] % 2 == 1]

    def figures(rows: TensorDict) -> dict[str, float | Tensor]:
        weights.append(loss.model.weight.detach().clone())
        assert not torch.is_grad_enabled()
        return {"count": len(rows), "mean": rows["number"].double().mean()}

    collector = EpochCollector(Episode, epochs)
    collector.epoch = skipped
    trainer = replay_buffer_trainer(
        collector,
        loss,
        odd,
        figures,
        learning_rate=0.01,
        capacity=STEPS,
        minibatch=MINIBATCH,
        passes=PASSES,
        seed=seed,
    )
    logger = Logger()
    trainer.logger = logger
    trainer.train()
    return loss, logger, weights


def test_every_sample_is_met_once_a_pass() -> None:
    """And those that were not chosen, or are of other epochs, never."""
    loss, _, _ = trained(0, 2)
    assert [len(rows) for rows in loss.seen] == [4, 1] * PASSES * 2
    for k in range(2 * PASSES):
        met = sorted(loss.seen[2 * k] + loss.seen[2 * k + 1])
        assert met == [100 * (k // PASSES) + odd for odd in (1, 3, 5, 7, 9)]


def test_the_order_is_drawn_from_seed_and_epoch() -> None:
    """From nothing else: not from what torch has drawn, nor from epochs before."""
    first, again, other = (trained(seed, 2)[0].seen for seed in (0, 0, 1))
    assert first == again
    assert first != other
    each = 2 * PASSES
    assert [[row - 100 for row in rows] for rows in first[each:]] != first[:each]
    resumed = trained(0, 2, skipped=1)[0].seen
    assert resumed == first[each:]


def test_figures_are_of_all_samples_and_of_weights_before_the_epoch() -> None:
    loss, logger, weights = trained(0, 2)
    found = [value for name, value in logger.values if name == "mean"]
    assert found == [5.0, 105.0]
    assert [value for name, value in logger.values if name == "count"] == [5.0, 5.0]
    torch.manual_seed(0)
    assert torch.equal(weights[0], Recording().model.weight)
    after_one = trained(0, 1)[0].model.weight
    assert torch.equal(weights[1], after_one)
    assert not torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[1], loss.model.weight)
