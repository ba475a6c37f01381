"""Training of ``stdcl``'s factors of ranges through the solution in which they stand."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import LossModule

from agents import make
from agents.stdcl.factors.network import FactorNetwork
from agents.stdcl.stdcl import StDcl
from agents.weights import learned
from coloc_env.options import Factor, Quantity
from coloc_env.scenario import Scenario
from coloc_env.scenarios import parse_scenario
from training.evaluation import metrics
from training.evaluation.record import record
from training.learning.collectors import (
    EpochCollector,
    Epochs,
    RoundRobin,
    ScoreRuns,
    Seed,
    Steps,
    Worlds,
    require_batches,
    world_seed,
)
from training.learning.comparison import compared
from training.learning.run import Progress, Training, make_trainer
from training.learning.through_time import (
    cosine,
    episodes,
    far_off,
    masked_mean,
    negative_log_likelihood,
    run_again,
)

# Thirty UAVs in the density of swarm-v0's 200: from three neighbours each to dense networks.
SCENARIO = "swarm-v0:n_uavs=30:size=5313,5313,2657:horizon=300"
VARIANTS = (
    "comm_radius=1500:nlos=0.3:nlos_time=10",
    "comm_radius=2500:nlos=0.5",
    "",
    "comm_radius=1500",
    "nlos=0.5:anchor_share=0.1",
    "comm_radius=1500:nlos=0:uwb_tail=0.5",
    "comm_radius=2500:nlos=0.4:nlos_time=5:motion=circle",
    "comm_radius=3500:link_failure=0.3:motion=line:v_max=80",
    "comm_radius=2000:nlos=0.3:nlos_time=10:ins_bias=0",
    "comm_radius=1230:ins_bias=1",
    "nlos=0.3:nlos_time=10:motion=helix",
    "comm_radius=2000:nlos=0.3:nlos_kind=exponential",
)
SCORED = ("comm_radius=1500:nlos=0.3:nlos_time=10", "comm_radius=2500:nlos=0.5", "")
_AGENT, _BASE = "stdcl:weights=none", "map"
_LIKELIHOOD = 0.1  # of the covariance's likelihood in the loss
_SCALE_SEED, _SCALE_STEPS = 1 << 36, 60


class FactorLoss(LossModule):
    """Pseudo-Huber loss of positions in units of ``map``'s RMSE in a variant, and the negative
    log-likelihood of the errors.

    The localizer runs again over the batch [B, T], from the belief that its first step started from
    and on the observations that were made, this time with gradients: truncated backpropagation
    through every pass of each solution and through the covariances between steps.
    """

    in_keys = ["uav", "state", "train"]  # noqa: RUF012
    out_keys = ["loss_position", "loss_likelihood"]  # noqa: RUF012

    def __init__(
        self,
        network: FactorNetwork,
        localizers: Sequence[StDcl],
        scenarios: Sequence[Scenario],
        scales: Sequence[float],
    ) -> None:
        super().__init__()
        self.network = network
        self.localizers, self.scenarios = tuple(localizers), tuple(scenarios)
        self.scales = tuple(scales)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        variant = int(tensordict["train", "variant"][0, 0])
        localizer, scenario = self.localizers[variant], self.scenarios[variant]
        n, d, free = scenario.arena.n_uavs, scenario.arena.dim, slice(scenario.anchor_uavs, None)
        state = tensordict["state"].unflatten(-1, (n, -1)).double()
        positions, covariances = [], []
        for estimate in run_again(localizer, scenario, tensordict):
            positions.append(estimate.position[:, free])
            covariances.append(estimate.covariance[:, free])
        error = torch.stack(positions, 1) - state[:, :, free, :d]
        scored = state[:, :, free, -1] > 0
        squared = error.square().sum(-1) / self.scales[variant] ** 2
        likelihood = negative_log_likelihood(error, torch.stack(covariances, 1))
        return TensorDict(
            {
                "loss_position": masked_mean(far_off(squared), scored),
                "loss_likelihood": _LIKELIHOOD * masked_mean(likelihood, scored),
            }
        )


def stdcl(
    device: str = "cpu",
    *,
    scenario: str = SCENARIO,
    variants: str = "/".join(VARIANTS),
    start: str = "none",
    width: Annotated[int, Quantity("", 1, 1 << 10)] = 20,
    worlds: Worlds = 4,
    epochs: Epochs = 1,
    steps: Steps = 12,
    learning_rate: Factor = 3e-3,
    last_rate: Factor = 1e-4,
    seed: Seed = 0,
    score_runs: ScoreRuns = 2,
) -> Training:
    """Factors of ranges, learned through ``map``'s solution.

    In each of ``epochs`` epochs ``worlds`` new worlds of every one of ``variants`` (overrides of
    ``scenario``, separated by slashes) are run with the newest weights; every ``steps`` steps the
    loss is backpropagated through them. ``start``: weights to start from, a checkpoint's name or
    path; else a new network of this ``width``, which is ``map`` itself. The learning rate falls
    from ``learning_rate`` to ``last_rate`` along a cosine, batch by batch. ``score_runs``:
    held-out worlds in which ``map`` with and without learned factors is compared at the end.
    """
    scenarios = [parse_scenario(scenario, variant) for variant in variants.split("/")]
    require_batches("stdcl", scenarios, steps)
    network = learned(FactorNetwork, start, seed, width=width).to(device)
    localizers: list[Any] = [make(_AGENT, one) for one in scenarios]
    for localizer in localizers:
        localizer.learn(network)
        localizer.to(device)
    loss = FactorLoss(network, localizers, scenarios, [_scale(one) for one in scenarios])
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate)

    def anneal(share: float) -> None:
        for group in optimizer.param_groups:
            group["lr"] = cosine(learning_rate, last_rate, share)

    def collect(epoch: int) -> Annealed:
        first = world_seed(seed, epoch, worlds * len(scenarios))
        collectors = episodes(localizers, scenarios, worlds, steps, device, first)
        batches = sum(one.horizon // steps for one in scenarios)
        return Annealed(collectors, lambda k: anneal((epoch + k / batches) / epochs))

    collector = EpochCollector(collect, epochs)
    return Training(
        module=network,
        collector=collector,
        trainer=make_trainer(collector, loss, optimizer, clip_norm=1.0),
        score=partial(score, network, scenario, score_runs),
    )


class Annealed(RoundRobin):
    """Batches of all collectors in turn; ``before(k)`` is called before the k-th of an epoch."""

    def __init__(self, collectors: Sequence[Any], before: Callable[[int], None]) -> None:
        super().__init__(collectors)
        self.before = before

    def __iter__(self) -> Iterator[TensorDictBase]:
        for k, batch in enumerate(super().__iter__()):
            self.before(k)
            yield batch


def _scale(scenario: Scenario) -> float:
    """RMSE (m) of ``map``, after it has settled."""
    scenario = replace(scenario, horizon=min(scenario.horizon, _SCALE_STEPS))
    result = record(make(_BASE, scenario), scenario, _SCALE_SEED + torch.arange(2))
    return metrics.rmse(result.error[:, 5:], result.worlds.scored[:, 5:])


def score(
    network: FactorNetwork, scenario: str, runs: int, progress: Progress
) -> Mapping[str, Any]:
    """RMSE (m) of ``map`` with the network's factors and without, in the worlds of seeds
    0 … runs − 1 of some variants."""

    def agents(one: Scenario) -> dict[str, Any]:
        localizer: Any = make(_AGENT, one)
        localizer.learn(network)
        return {"trained": localizer, "map": make(_BASE, one)}

    return compared(SCORED, partial(parse_scenario, scenario), agents, runs, progress)
