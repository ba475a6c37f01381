"""How far constants carry: for each dataset those that are best on all *others*, and what they are
worth on it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
import torch

from agents.errors import NotServed
from agents.registry import make
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from training.evaluation import metrics
from training.evaluation.evaluate import Progress, silent
from training.evaluation.record import RunRecord, record
from training.evaluation.recordings import best_elsewhere, recorded
from training.evaluation.tables import short

Which = Literal["bank", "biases"]
HUBER, BANK = "ekf:robust=huber", "ekf_trust"
SIMULATED: Mapping[str, Mapping[str, Any]] = {  # where learned trust gains most
    "NLOS": {"nlos": 0.3},
    "false matches": {"false_matches": 0.1},
    "both with five landmarks": {"nlos": 0.3, "false_matches": 0.1, "landmarks": 5},
}
WORLDS, STEPS = 8, 300  # of each of these
_MRCLAM_STD = 0.2  # m, of the noise of its ranges: its biases are believed in multiples of that


@dataclass(frozen=True)
class Constants:
    """Values of constants: options of an ``agent``, and ``overrides`` of scenarios by dataset."""

    label: str
    agent: str
    overrides: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """What constants are worth: the ``score`` that they are chosen by (less is better), and the
    ``figure`` that tables show."""

    score: float
    figure: float


def bank_constants() -> list[Constants]:
    """Those of a bank: as shipped (λ = 0.995, ν = 4, θ = −10), then one of them changed."""
    changed = [
        *(("λ", "forgetting", x) for x in (0.98, 0.99, 0.998, 0.9999)),
        *(("ν", "degrees", x) for x in (2, 10)),
        *(("θ", "restart", x) for x in (-3, -30)),
    ]
    one_changed = [Constants(f"{s} = {x:g}", f"{BANK}:{key}={x:g}") for s, key, x in changed]
    return [Constants("as shipped", BANK), *one_changed]


def bias_constants() -> list[Constants]:
    """Those of considered biases: σ_b of ranges (m) and τ (s), the believed ones first."""
    believed = (0.1, 100.0)

    def one(std: float, time: float) -> Constants:
        ranges = {"range_bias_std": std, "range_bias_time": time}
        by_dataset = dict.fromkeys(("miluv", "tuc", "hanyang", "tiers"), ranges)
        sightings = {"sighting_bias": std / _MRCLAM_STD, "bias_time": time}
        return Constants(f"{std:g} m, {time:g} s", HUBER, {"mrclam": sightings, **by_dataset})

    others = [(std, time) for time in (10.0, 100.0, 1000.0) for std in (0.05, 0.1, 0.2, 0.3)]
    pairs = [believed, (0.0, believed[1]), *(pair for pair in others if pair != believed)]
    return [one(*pair) for pair in pairs]


def measure(
    which: Which,
    only: Sequence[str] | None = None,
    seed: int = 0,
    progress: Progress = silent,
    **overrides: Any,
) -> dict[str, dict[str, Found]]:
    """By dataset and label of constants, the mean over its recordings (with ``overrides``); a
    bank's constants in simulation, too. ``only`` these datasets (None: all that serve).

    A bank is scored by log(RMSE ÷ that with Huber's weights alone), and shows that ratio. Biases
    are scored by −log N(error; 0, P) of the position, and show the NEES scaled to 3 dimensions.
    """
    choices = bank_constants() if which == "bank" else bias_constants()
    found: dict[str, dict[str, list[Found]]] = {}
    for dataset, make_world, seeds in _worlds(which, only, seed, overrides):
        try:
            classical = _log_rmse(_record(HUBER, make_world(), seeds)) if which == "bank" else 0.0
        except NotServed:
            continue
        for i, one in enumerate(choices):
            progress(dataset, i, len(choices))
            run = _record(one.agent, make_world(**one.overrides.get(dataset, {})), seeds)
            if which == "bank":
                ratio = _log_rmse(run) - classical
                worth = Found(ratio, float(np.exp(ratio)))
            else:
                worth = _consistency(run)
            found.setdefault(dataset, {}).setdefault(one.label, []).append(worth)
        progress(dataset, len(choices), len(choices))
    return {
        dataset: {label: _mean(which, every) for label, every in by_label.items()}
        for dataset, by_label in found.items()
    }


def table(
    which: Which, found: Mapping[str, Mapping[str, Found]], command: str, provenance: str
) -> dict[str, Any]:
    """A measured table (``docs/results/measured``): a line a dataset.

    Raises:
        ValueError: there is but one dataset.
    """
    scores = {d: {label: one.score for label, one in here.items()} for d, here in found.items()}
    rows = []
    for dataset, chosen in best_elsewhere(scores).items():
        here, score = found[dataset], scores[dataset]
        ours = next(iter(here))
        best, worst = min(score, key=score.__getitem__), max(score, key=score.__getitem__)
        figures = [short(here[label].figure) for label in (chosen, ours)]
        ends = [f"{short(here[label].figure)} ({label})" for label in (best, worst)]
        rows.append([dataset, chosen, *figures, *ends, f"{score[chosen] - score[best]:.3f}"])
    title, caption, figure, believed = _WORDS[which]
    return {
        "title": title,
        "caption": caption,
        "command": command,
        "provenance": provenance,
        "header": [
            *("left out", "chosen elsewhere", figure, f"with {believed}"),
            *("best here", "worst here", "lost to the best here, nats"),
        ],
        "align": ["left", "left", *["right"] * 5],
        "rows": rows,
    }


_WORDS: Mapping[Which, tuple[str, str, str, str]] = {
    "bank": (
        "Banks with constants that were chosen without a dataset",
        "Geometric mean, over a dataset's recordings, of RMSE ÷ that of `ekf:robust=huber`. One of "
        "λ, ν and θ is changed at a time; chosen: those with the least mean log ratio over all "
        f"*other* datasets. Simulation: {WORLDS} worlds of {STEPS} steps each with NLOS, false "
        "matches, and both with five landmarks.",
        "ratio",
        "λ = 0.995, ν = 4, θ = −10",
    ),
    "biases": (
        "Considered biases that were chosen without a dataset",
        "NEES of `ekf:robust=huber`, scaled so that 3 is honest (mean over a dataset's "
        "recordings). Chosen: σ_b of ranges and τ that give true positions the greatest likelihood "
        "on all *other* datasets. MRCLAM's bearings are believed to be biased in proportion, "
        "MILUV's heights as always.",
        "NEES",
        "0.1 m, 100 s",
    ),
}


def _worlds(
    which: Which, only: Sequence[str] | None, seed: int, overrides: Mapping[str, Any]
) -> Iterator[tuple[str, Callable[..., Scenario], torch.Tensor]]:
    """Datasets, what makes each world of them (with more overrides), and its seeds."""
    for one in recorded():
        serves = which == "bank" or one.dataset in bias_constants()[0].overrides
        if serves and (only is None or one.dataset in only):
            yield one.dataset, partial(one.scenario, **overrides), torch.tensor([seed])
    if which == "bank":
        for variant in SIMULATED.values():
            make_world = partial(make_scenario, "indoor-v0", horizon=STEPS, **variant)
            yield "simulation", make_world, torch.arange(seed, seed + WORLDS)


def _record(agent: str, scenario: Scenario, seeds: torch.Tensor) -> RunRecord:
    return record(make(agent, scenario), scenario, seeds)


def _log_rmse(run: RunRecord) -> float:
    """Mean over runs of log RMSE."""
    return float(np.log(metrics.rmse_per_run(run.error, run.worlds.scored)).mean())


def _consistency(run: RunRecord) -> Found:
    """Mean of −log N(error; 0, P) over the first run, and its NEES scaled to 3 dimensions."""
    assert run.covariance is not None
    scored, dim = run.worlds.scored[0], run.offset.shape[-1]
    nees = run.nees[0][scored].astype(float)
    log_volume = np.linalg.slogdet(run.covariance[scored].astype(float))[1]
    score = 0.5 * (nees + log_volume + dim * np.log(2 * np.pi))
    return Found(float(score.mean()), 3 / dim * float(nees.mean()))


def _mean(which: Which, every: Sequence[Found]) -> Found:
    """Over recordings; a ratio's is geometric."""
    score = float(np.mean([one.score for one in every]))
    figure = np.exp(score) if which == "bank" else np.mean([one.figure for one in every])
    return Found(score, float(figure))
