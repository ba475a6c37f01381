"""The PF-NN paper's own experiment: a corrector that learns from nothing while the filter runs."""

from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor, nn

from agents import make
from agents.policies.adapters import LocalizerPolicy
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenario import Scenario
from training.learning.collectors import Batches, EpochCollector, episode_collector
from training.learning.pfnn import EVERY, LEARNING_RATE, CorrectorLoss, InTurn, Samples, samples_of
from training.learning.run import Progress, make_trainer


@dataclass(frozen=True)
class OnlineLearning:
    """R worlds over K steps, N UAVs, each world with a network of its own that learned at L of the
    steps: ``error`` (m), ``count`` of particles, and equation 16's ``loss`` over all UAVs before
    each training."""

    error: Float[Tensor, "R K N"]
    count: Float[Tensor, "R K N"]
    loss: Float[Tensor, "R L"]


class PerWorld(nn.Module):
    """A network for every world, of one architecture: features [B, …, F] → y [B, …]."""

    def __init__(self, networks: list[nn.Module]) -> None:
        super().__init__()
        self.architecture = (deepcopy(networks[0]),)  # in a tuple: its weights are nobody's
        stacked, _ = torch.func.stack_module_state(networks)
        self.names = list(stacked)
        self.weights = nn.ParameterList(stacked.values())

    def forward(self, features: Float[Tensor, "B *s F"]) -> Float[Tensor, "B *s"]:
        def one(weights: tuple[Tensor, ...], f: Tensor) -> Tensor:
            named = dict(zip(self.names, weights, strict=True))
            return torch.func.functional_call(self.architecture[0], named, (f,))

        return torch.func.vmap(one)(tuple(self.weights), features)


def learn_online(
    scenario: Scenario,
    runs: int,
    seed: int,
    progress: Progress,
    agent: str = "pfnn",
    **options: Any,
) -> OnlineLearning:
    """Run ``agent`` (``pfnn``, with any options) as the paper does in the worlds of seeds ``seed``
    …, which are those of ``coloc evaluate``: random weights at the start (seeded like the world),
    and every 10 steps one of gradient descent on 50 particles of each UAV in turn.

    ``options`` are ``pfnn``'s own (``correction=(0.2, 1.0)``). All worlds run at once.
    """

    def filter_of(world: int) -> Any:
        return make(agent, scenario, weights="none", **({"seed": world} | options))

    localizer = filter_of(0)
    localizer.corrector = PerWorld([filter_of(seed + b).corrector for b in range(runs)])
    loss = CorrectorLoss(localizer.corrector)

    def collect(epoch: int) -> Batches:
        policy = LocalizerPolicy(localizer, scenario, record=Samples(scenario))
        env = CoLocEnv(scenario, runs, seed=seed)
        return episode_collector(env, policy, EVERY, compact_obs=True)

    errors, counts, losses = [], [], []

    @torch.no_grad()
    def record(batch: TensorDictBase) -> None:
        errors.append(batch["train", "error"])
        counts.append(batch["train", "count"])
        losses.append(loss.error(samples_of(batch).flatten(1, 2)))
        progress(f"{agent}, learning online", EVERY * len(errors), scenario.horizon)

    trainer = make_trainer(
        EpochCollector(collect, 1),
        loss,
        torch.optim.SGD(loss.parameters(), LEARNING_RATE),
        scenario.arena.n_uavs,
    )
    trainer.register_op("batch_process", record)
    trainer.register_op("process_optim_batch", InTurn(scenario.arena.n_uavs))
    trainer.train()
    return OnlineLearning(torch.cat(errors, 1), torch.cat(counts, 1), torch.stack(losses, 1))
