"""Training of ``pf_corrected``'s network through the particle filter that it corrects."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import LossModule

from agents import make
from agents.particle.evidence_corrector import EvidenceCorrector
from agents.particle.filter import Particles
from agents.weights import learned
from coloc_env.options import Factor, Share
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

# Broad clouds: ranges to anchors from anywhere, with NLOS and without, and to two, which leave a
# circle; and narrow ones, which must not get worse.
VARIANTS = (
    "landmarks=0:anchors=4:prior=uniform",
    "landmarks=0:anchors=4:prior=uniform:nlos=0.3",
    "landmarks=0:anchors=2:nlos=0.15",
    "",
)
SCORED = (VARIANTS[0], VARIANTS[1], "")
PLAIN = "apf"
_LIKELIHOOD = 0.1  # of the error's likelihood in the loss
_NONE = 1e-6  # of that loss, which has a logarithm
_SCALE_SEED = 1 << 36


class CorrectionLoss(LossModule):
    """Pseudo-Huber loss of the weighted mean in units of ``apf``'s RMSE in a variant, as a
    logarithm, so that a gain of a tenth counts alike in all of them; and the negative
    log-likelihood of the error under the weighted cloud's covariance.

    The filter runs again over the batch [B, T], from the belief that its first step started from
    and on the observations that were made, this time with gradients, which pass from step to step
    through the weights that soft resampling keeps.
    """

    in_keys = ["uav", "state", "train"]  # noqa: RUF012
    out_keys = ["loss_position", "loss_likelihood"]  # noqa: RUF012

    def __init__(
        self,
        network: EvidenceCorrector,
        filters: Sequence[Any],
        scenarios: Sequence[Scenario],
        scales: Sequence[float],
    ) -> None:
        super().__init__()
        self.network = network
        self.filters, self.scenarios = tuple(filters), tuple(scenarios)
        self.scales = tuple(scales)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        variant = int(tensordict["train", "variant"][0, 0])
        localizer, scenario = self.filters[variant], self.scenarios[variant]
        d = scenario.arena.dim
        state = tensordict["state"].unflatten(-1, (scenario.arena.n_uavs, -1)).double()
        estimates = list(run_again(localizer, scenario, tensordict))
        error = torch.stack([one.position for one in estimates], 1) - state[..., :d]
        covariance = torch.stack([one.covariance for one in estimates], 1)
        scored, squared = state[..., -1] > 0, error.square().sum(-1) / self.scales[variant] ** 2
        likelihood = negative_log_likelihood(error, covariance)
        return TensorDict(
            {
                "loss_position": (masked_mean(far_off(squared), scored) + _NONE).log(),
                "loss_likelihood": _LIKELIHOOD * masked_mean(likelihood, scored),
            }
        )


def pf_corrected(
    device: str = "cpu",
    *,
    scenario: str = "indoor-v0:motion=random:horizon=36",
    variants: str = "/".join(VARIANTS),
    start: str = "none",
    particles: Particles = 100,
    soft: Share = 0.5,
    worlds: Worlds = 4,
    epochs: Epochs = 4,
    steps: Steps = 6,
    learning_rate: Factor = 1e-2,
    last_rate: Factor = 1e-3,
    seed: Seed = 0,
    score_runs: ScoreRuns = 0,
) -> Training:
    """The network of ``pf_corrected``, by truncated backpropagation through the filter.

    In each of ``epochs`` epochs ``worlds`` new worlds of every one of ``variants`` (overrides of
    ``scenario``, separated by slashes) are run by the filter with so many ``particles``, ``soft``
    resampling and its newest weights; every ``steps`` steps the loss is backpropagated through
    them. The learning rate falls from ``learning_rate`` to ``last_rate`` along a cosine, epoch by
    epoch. ``start``: weights to start from, a checkpoint's name or path; else a new network, which
    is ``apf`` itself. ``score_runs``: held-out worlds in which the filter and ``apf`` are compared
    at the end.
    """
    scenarios = [parse_scenario(scenario, variant) for variant in variants.split("/")]
    require_batches("pf_corrected", scenarios, steps)
    network = learned(EvidenceCorrector, start, seed).to(device)
    options = {"weights": "none", "particles": particles, "bounds": None, "soft": soft}
    filters: list[Any] = [make("pf_corrected", one, seed=seed, **options) for one in scenarios]
    for localizer in filters:
        localizer.learn(network)
        localizer.to(device)
    scales = [_scale(one, particles) for one in scenarios]
    loss = CorrectionLoss(network, filters, scenarios, scales)
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate)

    def collect(epoch: int) -> RoundRobin:
        for group in optimizer.param_groups:
            group["lr"] = cosine(learning_rate, last_rate, epoch / max(1, epochs - 1))
        first = world_seed(seed, epoch, worlds * len(scenarios))
        return RoundRobin(episodes(filters, scenarios, worlds, steps, device, first))

    collector = EpochCollector(collect, epochs)
    return Training(
        module=network,
        collector=collector,
        trainer=make_trainer(collector, loss, optimizer, clip_norm=1.0),
        score=partial(score, network, scenario, score_runs),
    )


def _scale(scenario: Scenario, particles: int) -> float:
    """RMSE (m) of the filter alone."""
    short = replace(scenario, horizon=min(scenario.horizon, 60))
    plain = make(PLAIN, short, particles=particles, bounds=None)
    result = record(plain, short, _SCALE_SEED + torch.arange(4))
    return metrics.rmse(result.error, result.worlds.scored)


def score(
    network: EvidenceCorrector, scenario: str, runs: int, progress: Progress
) -> Mapping[str, Any]:
    """RMSE (m) of the filter and of ``apf`` in the worlds of seeds 0 … runs − 1 of some variants,
    each with its usual number of particles."""

    def agents(one: Scenario) -> dict[str, Any]:
        corrected: Any = make("pf_corrected:weights=none", one)
        corrected.learn(network)
        return {"pf_corrected": corrected, PLAIN: make(PLAIN, one)}

    return compared(SCORED, partial(parse_scenario, scenario), agents, runs, progress)
