"""Training of ST-DCL's graph network in the loop that it closes (paper, section 4.2.5)."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.objectives import LossModule

from agents import make
from agents.stdcl.loop import NetworkLoop
from agents.stdcl.network import StGnn
from agents.weights import learned
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.options import Factor, Quantity, Share
from coloc_env.scenario import Scenario
from coloc_env.scenarios import parse_scenario
from training.evaluation import metrics
from training.evaluation.record import record
from training.learning.augmentation import SwarmAugmentation
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
    FAR,
    cosine,
    episodes,
    far_off,
    masked_mean,
    run_again,
)

# 60 to 150 UAVs; a radius of 15 km gives 60 of them the degree that 200 have at 5 km. Weaves and
# the layouts u and o are never met in training: they are for the final test.
VARIANTS = (
    "comm_radius=15000",
    "comm_radius=15000:ins_bias=0",
    "comm_radius=15000:nlos=0:ins_bias=0:motion=line:v_max=80",
    "comm_radius=15000:nlos=0:motion=circle:v_max=30",
    "comm_radius=15000:nlos=0.3:motion=helix:ins_bias=0",
    "comm_radius=15000:nlos=0.4:ins_bias=1:motion=circle:v_max=80",
    "comm_radius=15000:nlos=0.4:nlos_time=10",
    "comm_radius=15000:nlos=0.2:nlos_time=5:motion=helix:v_max=80:ins_bias=0.5",
    "comm_radius=15000:nlos=0:uwb_tail=0.4:ins_bias=0",
    "comm_radius=15000:nlos=0.3:nlos_kind=exponential:motion=line:v_max=20",
    "comm_radius=15000:link_failure=0.4",
    "comm_radius=6000",
    "comm_radius=4000:n_uavs=80:ins_bias=0",
    "n_uavs=100:comm_radius=3500:nlos=0.3:motion=line",
    "n_uavs=150:comm_radius=2500",
    "n_uavs=150:comm_radius=2500:ins_bias=0:nlos=0.3:nlos_time=10",
    "n_uavs=100:comm_radius=2200:anchor_share=0.25:motion=circle",
    "n_uavs=150:comm_radius=1400",
    "n_uavs=120:comm_radius=1800:nlos=0.3",
)
SCORED = ("", "ins_bias=0", "nlos=0.5", "comm_radius=2500", "motion=weave:v_max=100", "layout=u")
METHODS = ("stdcl:variant=calibrated", "stdcl:variant=paper")
PLAIN, BASE = "stgat", "dwmds_st"
_LIKELIHOOD = 0.05  # of the covariance's likelihood in the loss
_SMOOTH = 0.1  # of the trajectory's second difference, in the second stage
_SCALE_SEED = 1 << 36


class StDclLoss(LossModule):
    """Position error in units of the optimizer's own, in a variant; equation 37 and, in the second
    stage, the trajectory's second difference beside it.

    The loop is closed again over the batch [B, T], from the belief that its first step started
    from and on the observations that were made, this time with gradients: truncated backpropagation
    through time. The second difference is that of the estimate minus that of the path by INS, so
    that manoeuvres are not smoothed away.
    """

    in_keys = ["uav", "state", "train"]  # noqa: RUF012
    out_keys = ["loss_position", "loss_spread", "loss_smooth"]  # noqa: RUF012

    def __init__(
        self,
        network: StGnn,
        loops: Sequence[NetworkLoop],
        scenarios: Sequence[Scenario],
        scales: Sequence[float],
    ) -> None:
        super().__init__()
        self.network = network
        self.loops, self.scenarios, self.scales = tuple(loops), tuple(scenarios), tuple(scales)
        self.smooth = 0.0  # weight of the second difference

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        variant = int(tensordict["train", "variant"][0, 0])
        loop, scenario, scale = self.loops[variant], self.scenarios[variant], self.scales[variant]
        n, d, free = scenario.arena.n_uavs, scenario.arena.dim, slice(scenario.anchor_uavs, None)
        state = tensordict["state"].unflatten(-1, (n, -1)).double()
        observed = tensordict["uav", "observation"]
        positions, variances = [], []
        for estimate in run_again(loop, scenario, tensordict):
            positions.append(estimate.position[:, free])
            variances.append(estimate.covariance[:, free, 0, 0])
        found = torch.stack(positions, 1)
        error, scored = found - state[:, :, free, :d], state[:, :, free, -1] > 0
        displaced = observed["ins"][:, :, free].double().cumsum(1) * scenario.arena.dt
        bent = (found - displaced).diff(n=2, dim=1).square().sum(-1) / scale**2
        likelihood = negative_log_likelihood(error, torch.stack(variances, 1), scale)
        return TensorDict(
            {
                "loss_position": masked_mean(far_off(error.square().sum(-1), scale), scored),
                "loss_spread": _LIKELIHOOD * masked_mean(likelihood, scored),
                "loss_smooth": self.smooth * masked_mean(bent, scored[:, 2:] & scored[:, :-2]),
            }
        )


def negative_log_likelihood(
    error: Float[Tensor, "*s d"], variance: Float[Tensor, "*s"], scale: float
) -> Float[Tensor, "*s"]:
    """½ (e²/P + d log P) of an isotropic variance (m²), of errors up to some times ``scale``."""
    squared = error.square().sum(-1).clamp_max(2 * (FAR * scale) ** 2)
    return 0.5 * (squared / variance + error.shape[-1] * variance.log())


def stdcl_loop(
    device: str = "cpu",
    *,
    scenario: str = "swarm-v0:n_uavs=60:horizon=60",
    variants: str = "/".join(VARIANTS),
    agent: str = "stdcl:variant=calibrated",
    start: str = "none",
    kernel: Annotated[int, Quantity("steps", 1, 100)] = 3,
    levels: Annotated[int, Quantity("", 0, 6)] = 3,
    worlds: Worlds = 4,
    epochs: Epochs = 10,
    steps: Steps = 10,
    learning_rate: Factor = 5e-4,
    last_rate: Factor = 1e-5,
    smooth_from: Share = 0.7,
    augment: bool = True,
    seed: Seed = 0,
    score_runs: ScoreRuns = 2,
) -> Training:
    """ST-DCL's graph network, trained in the closed loop that it works in.

    In each of ``epochs`` epochs ``worlds`` new worlds of every one of ``variants`` (overrides of
    ``scenario``, separated by slashes) are run by ``agent`` (``stdcl:variant=…`` with any options
    but weights, or ``stgat``) with its newest weights; every ``steps`` steps the loss is
    backpropagated through them. ``start``: weights to start from, a checkpoint's name or path; else
    the network is a new one with this ``kernel`` in time and convolutions in so many ``levels``
    (0: none). From the share ``smooth_from`` of the epochs on the loss contains the trajectory's
    second difference. The learning rate falls from ``learning_rate`` to ``last_rate`` along a
    cosine. ``augment``: the paper's augmentations. ``score_runs``: held-out worlds in which the
    loop and its optimizer alone are compared at the end.
    """
    scenarios = [parse_scenario(scenario, variant) for variant in variants.split("/")]
    require_batches("stdcl_loop", scenarios, steps)
    plain = agent == PLAIN
    network = learned(StGnn, start, seed, kernel=kernel, levels=levels, kinematic=not plain).to(
        device
    )
    if not plain and not agent.startswith(METHODS):
        allowed = " or ".join((*METHODS, PLAIN))
        raise ValueError(f"stdcl_loop: agent={agent!r} is not allowed: {allowed}")
    agent = f"{agent}:weights=none"
    loops: list[Any] = [make(agent, one) for one in scenarios]
    for loop in loops:
        loop.learn(network)
        loop.to(device)
    base = BASE if plain else agent  # untrained, a loop is its optimizer alone
    loss = StDclLoss(network, loops, scenarios, [_scale(base, one) for one in scenarios])
    optimizer = torch.optim.Adam(loss.parameters(), learning_rate)

    def collect(epoch: int) -> RoundRobin:
        for group in optimizer.param_groups:
            group["lr"] = cosine(learning_rate, last_rate, epoch / max(1, epochs - 1))
        loss.smooth = _SMOOTH if epoch >= smooth_from * epochs else 0.0
        first = world_seed(seed, epoch, worlds * len(scenarios))

        def augmented(env: CoLocEnv, i: int) -> EnvBase:
            return TransformedEnv(env, SwarmAugmentation(loops[i].base.std, first + i, device))

        wrap = augmented if augment else None
        return RoundRobin(episodes(loops, scenarios, worlds, steps, device, first, wrap))

    collector = EpochCollector(collect, epochs)
    trainer = make_trainer(collector, loss, optimizer, clip_norm=1.0)
    return Training(
        module=network,
        collector=collector,
        trainer=trainer,
        score=partial(score, network, agent, base, score_runs),
    )


def _scale(base: str, scenario: Scenario) -> float:
    """RMSE (m) of the optimizer alone, after it has settled."""
    result = record(make(base, scenario), scenario, _SCALE_SEED + torch.arange(4))
    return metrics.rmse(result.error[:, 5:], result.worlds.scored[:, 5:])


def score(
    network: StGnn, agent: str, base: str, runs: int, progress: Progress
) -> Mapping[str, Any]:
    """RMSE (m) of the loop and of its optimizer alone in the worlds of seeds 0 … runs − 1 of
    ``swarm-v0`` in some variants, with manoeuvres and layouts that training never saw."""

    def agents(scenario: Scenario) -> dict[str, Any]:
        loop: Any = make(agent, scenario)
        loop.learn(network)
        return {"trained": loop, "optimizer": make(base, scenario)}

    return compared(SCORED, partial(parse_scenario, "swarm-v0"), agents, runs, progress)
