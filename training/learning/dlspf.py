"""Training of the deep latent-space particle filter: a Wasserstein auto-encoder of windows, and
their step in latent space."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from agents import make
from agents.models.process import Process
from agents.particle.latent import WINDOW, LatentModel
from agents.policies.adapters import LocalizerPolicy
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import Observation, all_leaves
from coloc_env.options import Factor, PositiveCount
from coloc_env.scenario import Scenario
from coloc_env.scenarios import parse_scenario
from training.evaluation import metrics
from training.evaluation.record import record
from training.learning.collectors import (
    EpochCollector,
    Epochs,
    ScoreRuns,
    Seed,
    Worlds,
    episode_collector,
    world_seed,
)
from training.learning.replay_buffer import replay_buffer_trainer
from training.learning.run import Progress, Training

AHEAD = 8  # latent steps that are trained through
EVERY = 4  # steps between the windows that are learned from
DRAWS = 4  # references of each window
NEWEST = 0.75
UNBIASED = 10  # numbers of a state [p, v, q]
# Scales of what references are wrong by at a window's start, log-uniform: position (m); velocity as
# a share of it a window's length; attitude by the velocity (rad) that it makes so. From the first
# step's to those of a settled filter.
POSITION, VELOCITY, ATTITUDE = (0.02, 3.0), (0.05, 1.0), (0.02, 1.0)
_GRAVITY = 9.81  # m/s²
_MOST = 0.1  # rad
_KERNELS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # widths of the MMD's, of 2 L


class LatentLoss(LossModule):
    """Reconstruction of windows, of those ``AHEAD`` latent steps later, and the maximum mean
    discrepancy of latent states from N(0, I) (Tolstikhin et al. 2018).

    Reads ``errors`` [R, W + AHEAD, 6], [δp, T δv] over the position's scale; ``scale`` [R, 6] of
    each channel; ``normal`` [R, L], draws of N(0, I). Squares are relative to the scales, and the
    newest state, which is what particles are weighed by, counts ``NEWEST`` of it.
    """

    in_keys = ["errors", "scale", "normal"]  # noqa: RUF012
    out_keys = ["loss_reconstruction", "loss_transition", "loss_mmd"]  # noqa: RUF012

    def __init__(self, model: LatentModel, mmd: float) -> None:
        super().__init__()
        self.model, self.mmd = model, mmd

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        model, errors = self.model, tensordict["errors"].transpose(0, 1)  # [W + AHEAD, R, 6]
        windows = errors.unfold(0, WINDOW, 1).movedim(-1, 2)  # [1 + AHEAD, R, W, 6]
        pushes = errors[WINDOW:, :, 3:] - errors[WINDOW - 1 : -1, :, 3:]
        latents = [model.encode(windows[0])]
        for push in pushes:
            latents.append(model.advance(latents[-1], push))
        apart = (model.decode(torch.stack(latents)) - windows) / tensordict["scale"].unsqueeze(-2)
        squared = apart.square().mean((1, 3))  # [1 + AHEAD, W]
        squared = NEWEST * squared[:, -1] + (1 - NEWEST) * squared[:, :-1].mean(-1)
        return TensorDict(
            {
                "loss_reconstruction": squared[0],
                "loss_transition": squared[1:].mean(),
                "loss_mmd": self.mmd * discrepancy(latents[0], tensordict["normal"]),
            }
        )


def discrepancy(x: Float[Tensor, "R L"], y: Float[Tensor, "R L"]) -> Float[Tensor, ""]:
    """MMD² of two samples, unbiased, by inverse multiquadric kernels Σ C / (C + ‖x − y‖²)."""
    n, size = x.shape

    def kernel(a: Tensor, b: Tensor) -> Tensor:
        squared = (a.unsqueeze(1) - b.unsqueeze(0)).square().sum(-1)
        return sum((2 * size * c / (2 * size * c + squared) for c in _KERNELS), squared * 0)

    within = (kernel(x, x).sum() + kernel(y, y).sum() - 2 * n * len(_KERNELS)) / (n * (n - 1))
    return within - 2 * kernel(x, y).mean()


def samples(
    batch: TensorDictBase, process: Process, scenario: Scenario, latents: int, seed: int
) -> TensorDict:
    """Errors of references that start ``WINDOW + AHEAD`` steps earlier beside the truth and
    integrate the IMU that was sensed; rows of every ``EVERY``-th window and UAV."""
    n, steps = scenario.arena.n_uavs, WINDOW + AHEAD
    state = batch["state"].unflatten(-1, (n, -1))
    truth = state[..., : process.state_size]
    seen = batch["uav", "observation"]
    observed = Observation({k: seen[k].flatten(0, 1) for k in all_leaves(scenario)})
    u = process.inputs(observed).unflatten(0, batch.shape)
    device = truth.device
    starts = torch.arange(0, batch.shape[1] - steps + 1, EVERY, device=device)
    at = starts.unsqueeze(-1) + torch.arange(steps, device=device)
    truth, u = (x[:, at].movedim(2, -2).flatten(0, 2).double() for x in (truth, u))
    truth, u = (x.repeat(DRAWS, 1, 1) for x in (truth, u))  # [R, steps, S]
    g = torch.Generator().manual_seed(seed)
    rows, length = len(truth), WINDOW * process.dt

    def scale(bounds: tuple[float, float]) -> Tensor:
        low, high = torch.tensor(bounds, dtype=torch.float64).log()
        drawn = torch.rand(rows, 1, generator=g, dtype=torch.float64)
        return (low + (high - low) * drawn).exp().to(device)

    position = scale(POSITION)
    velocity = scale(VELOCITY) * position / length
    turn = (scale(ATTITUDE) * position / (_GRAVITY * length**2)).clamp_max(_MOST)
    delta = torch.cat([s.expand(-1, 3) for s in (position, velocity, turn)], -1)
    delta = delta * torch.randn(rows, 9, generator=g, dtype=torch.float64).to(device)
    dt = truth.new_full((rows,), process.dt)
    x, errors = process.boxplus(truth[:, 0], delta), []
    for k in range(steps):
        x = process.propagate(x, u[:, k], dt) if k else x
        apart = truth[:, k, :6] - x[:, :6]
        errors.append(torch.cat((apart[:, :3], length * apart[:, 3:]), -1) / position)
    pace = length * (velocity + _GRAVITY * turn * length) / position
    one = torch.ones_like(pace)
    entries = {
        "errors": torch.stack(errors, 1),
        "scale": torch.cat((one.expand(-1, 3), pace.expand(-1, 3)), -1),
        "normal": torch.randn(rows, latents, generator=g, dtype=torch.float64).to(device),
    }
    kept = (state[..., -1] > 0).all(1).unsqueeze(1).expand(-1, len(starts), -1).flatten()
    return TensorDict({k: v.float() for k, v in entries.items()}, (rows,))[kept.repeat(DRAWS)]


def dlspf(
    device: str = "cpu",
    *,
    scenario: str = "indoor-v0:motion=random:horizon=100",
    worlds: Worlds = 8,
    epochs: Epochs = 24,
    passes: PositiveCount = 8,
    minibatch: PositiveCount = 256,
    learning_rate: Factor = 5e-3,
    mmd: Factor = 0.01,
    seed: Seed = 0,
    score_runs: ScoreRuns = 10,
) -> Training:
    """The Wasserstein auto-encoder and latent step of ``dlspf``.

    In every epoch UAVs move in ``worlds`` new worlds of ``scenario`` by themselves. Its windows
    beside references that start somewhere near and integrate the IMU are learned from: they are
    reconstructed, also after eight latent steps, and latent states are drawn to N(0, I) by ``mmd``
    times the discrepancy. The learning rate falls linearly to a fiftieth. At the end ``pf500`` and
    ``dlspf`` are compared in ``score_runs`` held-out worlds of the scenario.
    """
    parsed = parse_scenario(scenario)
    if parsed.horizon < WINDOW + AHEAD:
        raise ValueError(
            f"dlspf: a horizon of {parsed.horizon} steps is too short: {WINDOW + AHEAD} at least"
        )
    localizer: Any = make("dlspf", parsed, weights="none", seed=seed).to(device)
    if localizer.process.state_size != UNBIASED:
        raise ValueError(f"dlspf: {scenario}: a scenario with an IMU without biases is needed")
    model: LatentModel = localizer.model
    still: Any = make("dead_reckoning", parsed).to(device)
    loss = LatentLoss(model, mmd)
    starts = len(range(0, parsed.horizon - WINDOW - AHEAD + 1, EVERY))

    def collect(epoch: int) -> Any:
        for group in trainer.optimizer.param_groups:
            group["lr"] = learning_rate * (1 - 0.98 * epoch / max(1, epochs - 1))
        env = CoLocEnv(parsed, worlds, device, seed=world_seed(seed, epoch, worlds))
        policy = LocalizerPolicy(still, parsed)
        return episode_collector(env, policy, parsed.horizon, compact_obs=True)

    collector = EpochCollector(collect, epochs)

    def rows(batch: TensorDictBase) -> TensorDict:
        first = world_seed(seed, collector.epoch, worlds)
        return samples(batch, localizer.process, parsed, model.latents, first)

    trainer = replay_buffer_trainer(
        collector,
        loss,
        rows,
        partial(_held_out, loss),
        learning_rate=learning_rate,
        capacity=worlds * parsed.arena.n_uavs * starts * DRAWS,
        minibatch=minibatch,
        passes=passes,
        seed=seed,
        device=device,
    )
    return Training(model, collector, trainer, partial(score, localizer, parsed, score_runs))


def _held_out(loss: LatentLoss, rows: TensorDict) -> dict[str, float | Tensor]:
    """The losses, of at most 2048 rows."""
    found = loss(rows[:2048])
    return {f"held_out_{key.removeprefix('loss_')}": found[key] for key in loss.out_keys}


def score(localizer: Any, scenario: Scenario, runs: int, progress: Progress) -> Mapping[str, Any]:
    """RMSE (m) of ``pf500`` and of the trained filter in the worlds of seeds 0 … runs − 1."""
    if runs == 0:
        return {}
    found: dict[str, Any] = {"runs": runs, "seeds": [0, runs - 1]}
    for name, one in (("pf500", make("pf500", scenario)), ("dlspf", localizer.to("cpu"))):
        result = record(one, scenario, torch.arange(runs))
        found[f"{name}_rmse"] = metrics.rmse(result.error, result.worlds.scored)
        progress("scoring", len(found) - 2, 2)
    return found
