"""Training of the NN-HPFF paper's failure detector on what a filter's estimates look like."""

from collections.abc import Mapping
from functools import partial
from itertools import product
from typing import Any

import torch
from jaxtyping import Bool, Float, Float32
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from agents import make
from agents.models.measurements import AnchorRanges
from agents.models.process import make_process
from agents.particle.failure import FailureDetector, evidence, network_features
from agents.parts import move
from agents.policies.adapters import LocalizerPolicy
from agents.weights import untrained
from coloc_env.observation import Observation, all_leaves
from coloc_env.options import Factor, PositiveCount
from coloc_env.scenario import Scenario
from coloc_env.scenarios import parse_scenario
from coloc_env.sensors import AnchorRanging
from training.evaluation.record import record
from training.learning.collectors import (
    EpochCollector,
    Epochs,
    ScoreRuns,
    Seed,
    Worlds,
    world_seed,
)
from training.learning.episodes import Episode, Episodes
from training.learning.replay_buffer import replay_buffer_trainer
from training.learning.run import Progress, Training

FAILED = 0.5  # m: an estimate farther off has failed
# Low, medium and high: the team's beliefs of the acceleration (m²/s⁴) and of ranges (m²), and the
# number of particles. Lowest and highest are those of the cases 1 to 3.
_Q, _R, _PARTICLES = (0.0036, 0.06, 1.0), (0.0016, 0.04, 0.36), (500, 2000, 5000)
VARIANTS = "/".join(f"q={q:g}:believed_uwb_std={r**0.5:g}" for q, r in product(_Q, _R))
MAINS = "/".join(f"pf:particles={count}" for count in _PARTICLES)


class DetectorLoss(LossModule):
    """Mean cross-entropy of ``failed`` [P] given ``features`` [P, 5]."""

    in_keys = ["features", "failed"]  # noqa: RUF012
    out_keys = ["loss_detector"]  # noqa: RUF012

    def __init__(self, detector: FailureDetector) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        logits = self.detector(tensordict["features"])
        loss = torch.nn.functional.cross_entropy(logits, tensordict["failed"].long())
        return TensorDict({"loss_detector": loss})


class Samples:
    """What an episode records, as a ``LocalizerPolicy``'s ``record``: ``features`` [B, N, 5] of
    the estimate, whether it has ``failed``, its ``error`` (m) and whether that is ``scored``
    [B, N]."""

    def __init__(self, scenario: Scenario, device: str = "cpu") -> None:
        sensor = scenario.believed.sensor(AnchorRanging)
        if sensor is None or sensor.tags:
            raise ValueError(f"nnhpff: {scenario.name} has no anchors, or lever arms to them")
        self.model, self.process = AnchorRanges(sensor), make_process(scenario.believed)
        move([self.model, self.process], device)
        self.leaves, self.n_uavs = tuple(all_leaves(scenario)), scenario.arena.n_uavs

    def __call__(self, before: Any, after: Any, tensordict: TensorDictBase) -> dict[str, Tensor]:
        d, observed = self.process.dim, tensordict["uav", "observation"]
        state = tensordict["state"].unflatten(-1, (self.n_uavs, -1))
        position = tensordict["uav", "action"][..., :d]
        seen = evidence(
            self.model, self.process, position, Observation({k: observed[k] for k in self.leaves})
        )
        error = (position - state[..., :d]).norm(dim=-1)
        return {
            "features": network_features(seen),
            "failed": error > FAILED,
            "error": error,
            "scored": (state[..., -1] > 0) & (seen.count > 0),
        }


def samples_of(batch: TensorDictBase) -> TensorDict:
    """An episode's samples [P], whichever world, step and UAV they are of."""
    train = batch["train"]
    entries = {key: train[key].flatten(0, 2) for key in ("features", "failed", "error")}
    rows = TensorDict(entries, entries["failed"].shape)[train["scored"].flatten()]
    if not len(rows):
        raise ValueError("nnhpff: no step had truth and distances to anchors to learn from")
    return rows


def _anchors(scenario: Scenario) -> int:
    """How many anchors the team believes in."""
    sensor = scenario.believed.sensor(AnchorRanging)
    return 0 if sensor is None else len(sensor.anchors)


def nnhpff(
    device: str = "cpu",
    *,
    scenario: str = "wsn-v0",
    variants: str = VARIANTS,
    mains: str = MAINS,
    worlds: Worlds = 2,
    epochs: Epochs = 20,
    passes: PositiveCount = 4,
    minibatch: PositiveCount = 1024,
    learning_rate: Factor = 0.01,
    seed: Seed = 0,
    score_runs: ScoreRuns = 20,
) -> Training:
    """The NN-HPFF paper's failure detector (5–10–5–2), from filters that run into trouble.

    In each of ``epochs`` epochs every filter of ``mains`` runs in ``worlds`` new worlds of the
    ``scenario`` in every one of ``variants`` (overrides; both lists are separated by slashes). An
    estimate more than 0.5 m off has failed. The defaults are the paper's 27 scenarios: low, medium
    and high process noise, range noise and number of particles. ``score_runs``: held-out worlds in
    which pf, hpff and nnhpff are compared at the end.
    """
    scenarios = [parse_scenario(scenario, one) for one in variants.split("/")]
    kinds = {(one.horizon, one.arena.n_uavs, _anchors(one)) for one in scenarios}
    if len(kinds) > 1:
        raise ValueError(
            f"nnhpff: variants={variants!r} must have one horizon, one number of UAVs and one of "
            "anchors"
        )
    filters = [
        (LocalizerPolicy(make(main, one).to(device), one, record=Samples(one, device)), one)
        for one in scenarios
        for main in mains.split("/")
    ]
    detector, ((steps, n_uavs, _),) = untrained(FailureDetector, seed).to(device), kinds

    def collect(epoch: int) -> Episodes:
        first = world_seed(seed, epoch, worlds * len(filters))
        return Episodes(
            [
                Episode(one, worlds, first + i * worlds, policy, device=device)
                for i, (policy, one) in enumerate(filters)
            ]
        )

    collector = EpochCollector(collect, epochs)
    loss = DetectorLoss(detector)
    trainer = replay_buffer_trainer(
        collector,
        loss,
        samples_of,
        partial(_figures, loss),
        learning_rate=learning_rate,
        capacity=worlds * len(filters) * steps * n_uavs,
        minibatch=minibatch,
        passes=passes,
        seed=seed,
        device=device,
    )
    return Training(
        module=detector,
        collector=collector,
        trainer=trainer,
        score=partial(score, detector, scenario, score_runs),
    )


def _figures(loss: DetectorLoss, rows: TensorDict) -> dict[str, float | Tensor]:
    """Cross-entropy, a constant forecast's, the share that failed, and the accuracy."""
    failed: Bool[Tensor, "P"] = rows["failed"]
    share = failed.double().mean()
    logits: Float32[Tensor, "P 2"] = loss.detector(rows["features"])
    right: Float[Tensor, ""] = ((logits[:, 1] > logits[:, 0]) == failed).double().mean()
    constant = -torch.special.xlogy(share, share) - torch.special.xlogy(1 - share, 1 - share)
    return {
        "held_out_loss": loss(rows)["loss_detector"],
        "constant_loss": constant,
        "failed_share": share,
        "accuracy": right,
    }


def score(detector: FailureDetector, base: str, runs: int, progress: Progress) -> Mapping[str, Any]:
    """Mean error (m) and resets a run of pf, hpff and nnhpff (without banks) in the worlds of seeds
    0 … runs − 1 of the three cases."""
    found: dict[str, Any] = {}
    if runs == 0 or base.split(":")[0] != "wsn-v0":
        return found
    for case in (1, 2, 3):
        scenario = parse_scenario(base, f"case={case}")
        each: dict[str, float] = {}
        for name in ("pf", "hpff", "nnhpff"):
            options: dict[str, Any] = {} if name == "pf" else {"bank": False}
            if name == "nnhpff":
                options["weights"] = "none"
            one: Any = make(name, scenario, **options)
            if name == "nnhpff":
                one.learn(detector)
            result = record(one, scenario, torch.arange(runs))
            each[f"{name}_mean"] = float(result.error.mean())
            if "resets_per_run" in result.series:
                each[f"{name}_resets"] = float(result.series["resets_per_run"].sum(1).mean())
        found[f"case {case}"] = each
        progress("scoring", case, 3)
    return {"runs": runs, "seeds": [0, runs - 1], **found}
