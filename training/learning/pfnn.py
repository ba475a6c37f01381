"""Training of the PF-NN paper's weight corrector (equations 11–16)."""

from collections.abc import Mapping
from functools import partial
from itertools import cycle
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.trainers import Trainer

from agents import make
from agents.kalman.filter import elapsed
from agents.models.process import make_process
from agents.particle import particle_count
from agents.particle.cloud import select
from agents.particle.corrector import motion_features
from agents.policies.adapters import LocalizerPolicy
from coloc_env import noise
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import Observation, all_leaves
from coloc_env.options import Factor, PositiveCount
from coloc_env.scenario import Scenario
from coloc_env.scenarios import parse_scenario
from training.evaluation import metrics
from training.evaluation.record import record
from training.learning.collectors import (
    Batches,
    EpochCollector,
    Epochs,
    ScoreRuns,
    Seed,
    Worlds,
    episode_collector,
    world_seed,
)
from training.learning.labels import Labels, labels_of
from training.learning.replay_buffer import replay_buffer_trainer
from training.learning.run import Progress, Training, make_trainer

EVERY = 10  # steps between trainings (section 2.3)
PARTICLES = 50  # of each UAV that one training looks at (section 3.3.2)
LEARNING_RATE = 0.01
LabelName = Literal["truth", "calibration", "self_supervised", "prediction", "contrastive"]
LATE = ("calibration", "self_supervised")  # which only later steps give


class CorrectorLoss(LossModule):
    """Equation 16: L = mean (y − t)² over particles.

    Reads ``features`` [*w, P, 6], ``target`` and ``mask`` [*w, P] (False: a particle that does not
    count); leading dimensions are networks of their own, whose losses add up.
    """

    in_keys = ["features", "target", "mask"]  # noqa: RUF012
    out_keys = ["loss_corrector"]  # noqa: RUF012

    def __init__(self, corrector: torch.nn.Module) -> None:
        super().__init__()
        self.corrector = corrector

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        return TensorDict({"loss_corrector": self.error(tensordict).sum()})

    def error(self, tensordict: TensorDictBase) -> Float[Tensor, "*w"]:
        """Each network's own loss."""
        y, t = self.corrector(tensordict["features"]), tensordict["target"]
        return masked_mean((y - t) ** 2, tensordict["mask"])


def masked_mean(x: Float[Tensor, "*w P"], mask: Bool[Tensor, "*w P"]) -> Float[Tensor, "*w"]:
    """Mean over the last dimension where ``mask`` is True; 0 where it never is."""
    return (x * mask).sum(-1) / mask.sum(-1).clamp_min(1)


class Samples:
    """What the filter records for training, as a ``LocalizerPolicy``'s ``record``.

    Of ``size`` random particles of each UAV: ``features`` [B, N, P, 6] (equation 11), ``target``
    [B, N, P] and ``mask``; and of the filter itself ``error`` (m) and ``count`` [B, N], which no
    loss sees. The target is exp(−‖p − p̃‖), p̃ being the truth, ``late``'s labels, or the
    ``prediction``, the last estimate moved on at its velocity; or (``contrastive``) 1 for a
    displacement since the last step that fits the IMU, 0 for another UAV's particle's.
    """

    def __init__(
        self,
        scenario: Scenario,
        size: int = PARTICLES,
        labels: LabelName = "truth",
        late: Labels | None = None,
    ) -> None:
        self.dim, self.n_uavs, self.size = scenario.arena.dim, scenario.arena.n_uavs, size
        self.labels, self.late, self.scenario = labels, late, scenario
        self.process = make_process(scenario.believed)

    def __call__(self, before: Any, after: Any, tensordict: TensorDictBase) -> dict[str, Tensor]:
        d = self.dim
        state = tensordict["state"].unflatten(-1, (self.n_uavs, -1))
        truth, scored = state[..., :d], state[..., -1] > 0
        if self.labels == "contrastive":
            samples = self._contrasted(before, after, tensordict)
        else:
            chosen, alive = self._chosen(after, after)
            particles = select(after.particles, chosen)
            where, there = truth, scored
            if self.labels != "truth":
                where, there = self._without_truth(before, tensordict)
            distance = (particles[..., :d] - where.unsqueeze(-2)).norm(dim=-1)
            samples = {
                "features": motion_features(particles, before.last, d),
                "target": torch.exp(-distance),
                "mask": alive & there.unsqueeze(-1),
            }
        return {
            **samples,
            "error": (tensordict["uav", "action"][..., :d] - truth).norm(dim=-1),
            "scored": scored,
            "count": after.count,
        }

    def _chosen(self, cloud: Any, after: Any) -> tuple[Tensor, Tensor]:
        """Indices of random live particles of a cloud [B, N, P], and which of them are alive."""
        m = cloud.particles.shape[-2]
        alive = particle_count.alive(cloud.count, m)
        draws = noise.uniform(noise.fold(after.key, after.step), "train.particles", m)
        chosen = draws.masked_fill(~alive, 2.0).topk(self.size, -1, largest=False).indices
        return chosen, alive.gather(-1, chosen)

    def _without_truth(self, before: Any, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """p̃ [B, N, d], and where it counts."""
        d, there = self.dim, tensordict["uav", "mask"]
        if self.late is None:
            return before.last[..., :d] + self.process.dt * before.last[..., d:], there
        where, known = self.late.at(int(before.step.flatten()[0]))
        return where.to(before.last), there & known

    def _contrasted(self, before: Any, after: Any, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """The particles before the step moved by the IMU, half of them by what moved a particle of
        the next UAV."""
        d, half = self.dim, self.size // 2
        seen = tensordict["uav", "observation"]
        observation = Observation({name: seen[name] for name in all_leaves(self.scenario)})
        u = self.process.inputs(observation).to(torch.float32).unsqueeze(-2)
        dt = elapsed(self.process, before.step).to(torch.float32).unsqueeze(-1)
        chosen, alive = self._chosen(before, after)
        first = select(before.particles, chosen)
        moved = (self.process.propagate(first, u, dt) - first)[..., : 2 * d]
        shuffled = moved.roll((1, half), (1, 2))
        fits = torch.arange(self.size, device=moved.device) < half
        ends = first[..., : 2 * d] + torch.where(fits[:, None], moved, shuffled)
        return {
            "features": motion_features(ends, before.last, d),
            "target": fits.to(ends).expand(ends.shape[:-1]).clone(),
            "mask": alive & tensordict["uav", "mask"].unsqueeze(-1),
        }


def samples_of(batch: TensorDictBase) -> TensorDict:
    """The particles of every EVERY-th step of a batch [B, T], by world and UAV: [B, N, P]."""
    train = batch["train"][:, EVERY - 1 :: EVERY]
    keys = ("features", "target", "mask")
    entries = {key: train[key].movedim(1, 2).flatten(2, 3) for key in keys}
    return TensorDict(entries, entries["mask"].shape)


class InTurn:
    """The samples of one UAV after the other, from the same batch: Algorithm 1 trains in its loop
    over UAVs, a step of gradient descent each."""

    def __init__(self, n_uavs: int) -> None:
        self.turn = cycle(range(n_uavs))

    def __call__(self, batch: TensorDictBase) -> TensorDict:
        """[B, P] of a batch [B, T]."""
        return samples_of(batch)[:, next(self.turn)]


def pfnn(
    device: str = "cpu",
    *,
    mode: Literal["offline", "online"] = "offline",
    labels: LabelName = "truth",
    start: str = "none",
    scenario: str = "indoor-v0",
    worlds: Worlds = 8,
    epochs: Epochs = 20,
    passes: PositiveCount = 4,
    minibatch: PositiveCount = 1024,
    learning_rate: Factor = LEARNING_RATE,
    seed: Seed = 0,
    score_runs: ScoreRuns = 10,
) -> Training:
    """The PF-NN paper's weight corrector (equations 11 to 16).

    In every epoch the filter runs in new worlds with its newest weights. With ``mode=offline`` it
    learns after the episode, from a replay buffer of the episode's particles, in several passes.
    ``mode=online`` is the paper's way: every 10 steps a step of gradient descent on each UAV's
    particles in turn, which the filter uses at once (no ``passes``, no ``minibatch``).

    ``labels``: the ``truth`` (of the simulator, or a recording's); or, without any truth,
    ``calibration``, trilateration from anchors averaged over ± 5 steps; ``self_supervised``,
    ``dfgo``'s smoothed window a second later, UAVs tied by landmarks that they see in common;
    ``prediction``, the motion model's, at a tenth of the ``learning_rate`` (the paper's online
    phase); ``contrastive``, displacements that fit the IMU against other particles'.
    ``start``: the checkpoint whose weights it starts from, by name or path (``none``: random).

    The ``scenario`` takes overrides: ``indoor-v0:motion=random:horizon=300``. At the end ``apf``
    and ``pfnn`` are compared in ``score_runs`` held-out worlds of it.
    """
    parsed = parse_scenario(scenario)
    if parsed.horizon < EVERY:
        raise ValueError(
            f"pfnn: a horizon of {parsed.horizon} steps is too short: {EVERY} at least"
        )
    if labels in LATE and mode == "online":
        raise ValueError(f"pfnn: labels={labels} is not allowed with mode=online: known too late")
    if labels == "prediction":
        learning_rate *= 0.1
    localizer: Any = make("pfnn", parsed, weights=start, seed=seed).to(device)
    loss = CorrectorLoss(localizer.corrector)
    steps = EVERY if mode == "online" else parsed.horizon // EVERY * EVERY

    def collect(epoch: int) -> Batches:
        first = world_seed(seed, epoch, worlds)
        late = labels_of(labels, parsed, worlds, first, device) if labels in LATE else None
        samples = Samples(parsed, labels=labels, late=late)
        policy = LocalizerPolicy(localizer, parsed, record=samples)
        env = CoLocEnv(parsed, worlds, device, seed=first)
        return episode_collector(env, policy, steps, compact_obs=True)

    collector = EpochCollector(collect, epochs)
    if mode == "online":
        trainer = _online(collector, loss, learning_rate, parsed.arena.n_uavs)
    else:
        trainer = replay_buffer_trainer(
            collector,
            loss,
            _samples,
            partial(_held_out, loss),
            learning_rate=learning_rate,
            capacity=worlds * parsed.arena.n_uavs * PARTICLES * (steps // EVERY),
            minibatch=minibatch,
            passes=passes,
            seed=seed,
            device=device,
        )
    trainer.register_op("pre_steps_log", _figures)
    return Training(
        module=localizer.corrector,
        collector=collector,
        trainer=trainer,
        score=partial(score, localizer, parsed, score_runs),
    )


def _online(
    collector: EpochCollector, loss: CorrectorLoss, learning_rate: float, n_uavs: int
) -> Trainer:
    """Plain gradient descent on each UAV's particles in turn, once a batch (Algorithm 1)."""
    optimizer = torch.optim.SGD(loss.parameters(), learning_rate)
    trainer, in_turn = make_trainer(collector, loss, optimizer, n_uavs), InTurn(n_uavs)
    trainer.register_op("process_optim_batch", lambda batch: in_turn(batch).flatten())
    return trainer


def _samples(batch: TensorDictBase) -> TensorDict:
    """All particles of an episode that count."""
    rows = samples_of(batch).flatten()
    return rows[rows["mask"]]


def _held_out(loss: CorrectorLoss, rows: TensorDict) -> dict[str, float | Tensor]:
    """The loss, and that of the best constant."""
    return {
        "held_out_loss": loss(rows)["loss_corrector"],
        "constant_loss": rows["target"].var(unbiased=False),
    }


def _figures(batch: TensorDictBase) -> dict[str, float]:
    """RMSE (m) and mean number of particles of a batch."""
    train = batch["train"]
    squared = masked_mean(train["error"].flatten() ** 2, train["scored"].flatten())
    return {"rmse": float(squared.sqrt()), "particles": float(train["count"].double().mean())}


def score(localizer: Any, scenario: Scenario, runs: int, progress: Progress) -> Mapping[str, Any]:
    """RMSE (m) of ``apf`` and of the trained filter in the worlds of seeds 0 … runs − 1."""
    if runs == 0:
        return {}
    plain, records = make("apf", scenario, seed=localizer.seed), {}
    for name, one in (("apf", plain), ("pfnn", localizer.to("cpu"))):
        done = 0

        def tick(steps: int, name: str = name) -> None:
            nonlocal done
            done += steps
            progress(f"scoring {name}", done, runs * scenario.horizon)

        records[name] = record(one, scenario, torch.arange(runs), tick)
    per_run = {
        name: metrics.rmse_per_run(result.error, result.worlds.scored)
        for name, result in records.items()
    }
    difference = metrics.paired_difference(per_run["pfnn"], per_run["apf"])
    return {
        "runs": runs,
        "seeds": [0, runs - 1],
        **{f"{name}_rmse": float(np.sqrt(np.mean(x**2))) for name, x in per_run.items()},
        "difference": difference.mean,
        "difference_95": [difference.low, difference.high] if runs > 1 else None,
    }
