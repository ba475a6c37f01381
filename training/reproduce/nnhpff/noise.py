"""Detectors over several true σ of the ranges: fitted to one of them or to all, on half of the
worlds, and judged on the other half."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from agents import make
from agents.models.measurements import AnchorRanges
from agents.models.process import make_process
from agents.particle.failure import FailureDetector, evidence, network_features
from agents.weights import untrained
from coloc_env.scenarios import parse_overrides
from coloc_env.sensors import AnchorRanging
from training.evaluation.evaluate import Progress
from training.evaluation.metrics import Flags, Floats
from training.evaluation.rollout import rollout
from training.learning.nnhpff import FAILED, VARIANTS
from training.reproduce.nnhpff.detection import confusion, curve, least_wrong
from training.reproduce.results import Results
from training.reproduce.settings import Settings
from training.reproduce.store import Arrays, Facts
from training.reproduce.tables import DASH, Table
from training.reproduce.work import Cell, Kind, Piece, Variant

FITTED = (0.1, 0.2, 0.4)  # m, the true σ of ranges; the paper has the middle one
JUDGED = (*FITTED, 0.3)  # and one that nothing was fitted to
MAIN = "pf:particles=1000"
_STEPS = 400  # of Adam, over all samples
_RATE = 0.02
SAMPLES = Kind(
    "samples", f"{__name__}:compute", f"{__name__}:load", ("training.reproduce.nnhpff.noise",)
)


@dataclass(frozen=True, eq=False)
class Samples:
    """What a detector sees of a filter that nothing restarts, [R, P] for R worlds: the network's
    ``features``, d, the residuals' root mean square ``rms`` (m), and the ``error`` (m)."""

    features: Floats  # [R, P, 5]
    distance: Floats
    rms: Floats
    error: Floats


def cells(settings: Settings) -> Iterator[Cell]:
    """The beliefs of the training's scenarios, under every σ."""
    for variant in (v for std in JUDGED for v in variants(std, settings.steps)):
        yield Cell(variant, (MAIN,), max(2, settings.fraction(10)), SAMPLES)


def variants(std: float, steps: int | None = None) -> list[Variant]:
    """The nine beliefs, with a true σ (m)."""
    return [
        Variant(
            f"noise-{std:g}-{text.replace(':', '-')}",
            f"σ {std:g} m, {text.replace(':', ', ')}",
            (*parse_overrides("wsn-v0", text.split(":")).items(), ("uwb_std", std)),
            "wsn-v0",
            steps,
        )
        for text in VARIANTS.split("/")
    ]


def compute(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """Run the filter, and look at its estimates as a detector does."""
    (agent,), scenario = piece.agents, piece.variant.build()
    sensor = scenario.believed.sensor(AnchorRanging)
    assert sensor is not None
    model, process = AnchorRanges(sensor), make_process(scenario.believed)
    found: list[tuple[torch.Tensor, ...]] = []
    seeds = torch.arange(piece.seed, piece.seed + piece.runs)
    for step in rollout(make(agent, scenario), scenario, seeds):
        assert step.estimate is not None
        position = step.estimate.position
        seen = evidence(model, process, position, step.observation)
        error = (position.double() - step.world.truth.position).norm(dim=-1).float()
        found.append((network_features(seen), seen.distance, seen.rms, error))
        progress(agent, piece.runs * (step.k + 1), piece.size)
    names = ("features", "distance", "rms", "error")
    columns = (torch.stack(x, 1).flatten(1, 2) for x in zip(*found, strict=True))
    return {name: x.numpy() for name, x in zip(names, columns, strict=True)}, {}


def load(variant: Variant, arrays: Arrays, facts: Facts) -> Samples:
    """What ``compute`` made."""
    return Samples(**arrays)


def text(settings: Settings) -> list[str]:
    """What is to be known of it."""
    return [
        "The training's nine beliefs under several true σ of the ranges; "
        f"{max(2, settings.fraction(10))} worlds each, `{MAIN}`, which nothing restarts. The "
        "network (5–10–5–2, Adam on all samples at once), the threshold of √(Σr²/n) and that of d "
        "are fitted to every other world, and judged on the rest; nothing was fitted to σ 0.3 m."
    ]


def tables(results: Results) -> Iterator[Table]:
    """Each detector, fitted to the paper's σ or to three, on each σ."""
    found = {std: _samples(results, std) for std in JUDGED}
    if any(one is None for one in found.values()):
        return
    there: dict[float, Samples] = {std: one for std, one in found.items() if one is not None}
    header = ["fitted to σ (m)", "detector", *(f"σ {std:g} m: ROC area" for std in JUDGED)]
    header += [f"σ {std:g} m: accuracy" for std in JUDGED]
    rows = []
    for fitted in ((0.2,), FITTED):
        for name, judge in _fit([_half(there[std], 0) for std in fitted]).items():
            areas, right = [], []
            for std in JUDGED:
                other = _half(there[std], 1)
                score, failed = judge.score(other), other.error.ravel() > FAILED
                both = 0 < failed.sum() < failed.size
                areas.append(f"{curve(score, failed).auc:.4f}" if both else DASH)
                right.append(f"{confusion(score, failed, judge.threshold).accuracy:.4f}")
            words = ", ".join(f"{std:g}" for std in fitted)
            rows.append([words, name, *areas, *right])
    yield Table("Detectors over true σ", header, rows, 2)


@dataclass(frozen=True, eq=False)
class _Judge:
    """A score, beyond whose ``threshold`` a filter counts as failed: a network's log odds, or d,
    or the residuals' root mean square."""

    threshold: float
    network: FailureDetector | None = None
    of: str = ""

    def score(self, one: Samples) -> Floats:
        """[R P]."""
        if self.network is None:
            scores: Floats = getattr(one, self.of).ravel().astype(np.float64)
            return scores
        with torch.no_grad():
            logits = self.network(torch.from_numpy(one.features).flatten(0, 1))
        odds: Floats = (logits[:, 1] - logits[:, 0]).numpy().astype(np.float64)
        return odds


def _fit(parts: list[Samples]) -> Mapping[str, _Judge]:
    """The three detectors, by name."""
    failed = np.concatenate([one.error.ravel() for one in parts]) > FAILED
    features = np.concatenate([one.features.reshape(-1, one.features.shape[-1]) for one in parts])
    found = {"network": _Judge(0.0, _trained(features, failed))}
    for name, of in (("√(Σr²/n)", "rms"), ("d", "distance")):
        score = np.concatenate([getattr(one, of).ravel() for one in parts]).astype(np.float64)
        found[name] = _Judge(least_wrong(score, failed), of=of)
    return found


def _trained(features: Floats, failed: Flags) -> FailureDetector:
    """The paper's network by cross-entropy."""
    network = untrained(FailureDetector, 0)
    inputs, labels = torch.from_numpy(features), torch.from_numpy(failed).long()
    optimizer = torch.optim.Adam(network.parameters(), _RATE)
    for _ in range(_STEPS):
        optimizer.zero_grad()
        torch.nn.functional.cross_entropy(network(inputs), labels).backward()
        optimizer.step()
    return network.requires_grad_(False)


def _samples(results: Results, std: float) -> Samples | None:
    """Of all beliefs at a σ, side by side; None unless all were run."""
    parts = [results.get(variant.key, MAIN, SAMPLES) for variant in variants(std)]
    if any(part is None for part in parts):
        return None
    return Samples(
        **{
            name: np.concatenate([getattr(part, name) for part in parts], 1)
            for name in ("features", "distance", "rms", "error")
        }
    )


def _half(one: Samples, first: int) -> Samples:
    """Every other world, from the ``first`` on."""
    return Samples(one.features[first::2], one.distance[first::2], one.rms[first::2],
                   one.error[first::2])  # fmt: skip
