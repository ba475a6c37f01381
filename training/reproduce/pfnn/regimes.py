"""Where the corrector works, if anywhere: geometry, width of the cloud, and motion, each with a
corrector that was trained there."""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Floats
from training.evaluation.tables import short
from training.reproduce.measures import rmse
from training.reproduce.pfnn.plan import ORACLE
from training.reproduce.results import Results
from training.reproduce.settings import Settings
from training.reproduce.tables import Table
from training.reproduce.verdicts import apart
from training.reproduce.work import WORLD, Cell, Training, Variant

STEPS = 300  # of a run, and of a training episode, unless a study is cut shorter
EPOCHS = 5
UNTRAINED = "pfnn:weights=none"
PLAIN, KALMAN = "apf", "ekf"
GEOMETRIES: dict[str, tuple[str, dict[str, Any]]] = {
    "landmarks": ("20 landmarks, start within 2 m", {}),
    "landmarks-anywhere": ("20 landmarks, start anywhere", {"prior": "uniform"}),
    "landmark": ("1 landmark, start anywhere", {"prior": "uniform", "landmarks": 1}),
    "anchors8": ("8 anchors", {"prior": "uniform", "landmarks": 0, "anchors": 8}),
    "anchors4": ("4 anchors in a plane", {"prior": "uniform", "landmarks": 0, "anchors": 4}),
    "anchors2": ("2 anchors: a line", {"prior": "uniform", "landmarks": 0, "anchors": 2}),
    "ranges": ("ranges between UAVs alone, start within 2 m", {"landmarks": 0}),
}
MOTIONS = {"circle": "fixed circle", "random": "random motion"}


def regimes(steps: int | None = None) -> list[Variant]:
    """Every geometry with every motion."""
    return [
        Variant(
            f"{geometry}-{motion}",
            f"{words}; {MOTIONS[motion]}",
            tuple((overrides | {"motion": motion}).items()),
            steps=steps or STEPS,
            bounded=False,
        )
        for (geometry, (words, overrides)), motion in product(GEOMETRIES.items(), MOTIONS)
    ]


def cells(settings: Settings) -> Iterator[Cell]:
    """Each regime, half of the runs: filters, a corrector trained there, an untrained one, and one
    that knows the truth."""
    for variant in regimes(settings.steps):
        agents = (PLAIN, trained(variant, settings.out), UNTRAINED, KALMAN)
        yield Cell(variant, agents, settings.fraction(2))
        yield Cell(variant, ("pfnn",), settings.fraction(2), ORACLE)


def trainings(settings: Settings) -> Iterator[Training]:
    """Of every regime that is asked for."""
    for variant in regimes(settings.steps):
        if settings.variants is None or variant.key in settings.variants:
            yield _training(variant)


def trained(variant: Variant, out: Path) -> str:
    """The filter with the corrector that was trained in a regime."""
    return f"pfnn:weights={_training(variant).folder(out)}/pfnn.safetensors"


def _training(variant: Variant) -> Training:
    overrides = (f"{key}={value}" for key, value in variant.overrides)
    scenario = ":".join((variant.scenario, *overrides, f"horizon={variant.steps}"))
    options = (("scenario", scenario), ("epochs", EPOCHS), ("score_runs", 0))
    return Training(f"{variant.key}-{variant.steps}", "pfnn", options)


def text(settings: Settings) -> list[str]:
    """What is to be known of it."""
    steps = settings.steps or STEPS
    return [
        f"{settings.fraction(2)} runs of {steps} steps a regime. *Trained*: a corrector that "
        f"learned in {EPOCHS} epochs of 8 worlds of the same regime; *untrained*: random weights; "
        "*oracle*: its own target, computed from the truth; `ekf`: iterated. Differences are "
        "paired by world, in per cent of the other's RMSE, below 0 where the first is better, with "
        "95 % intervals.",
        "A regime where the corrector works must keep its interval below 0 beside `apf`, beside "
        "the untrained network, and beside `ekf`; on the fixed circle position follows from time, "
        "which a network can learn by heart.",
    ]


def tables(results: Results) -> Iterator[Table]:
    """One line a regime."""
    header = [
        "regime",
        "`apf`: RMSE (m)",
        "trained (%)",
        "untrained (%)",
        "oracle (%)",
        "`ekf` (%)",
    ]
    header += ["trained − untrained (%)", "trained − `ekf` (%)"]
    rows, out = [], results.settings.out
    for variant in regimes(results.settings.steps):
        found = results.runs(variant.key, (PLAIN, trained(variant, out), UNTRAINED, KALMAN))
        if PLAIN not in found:
            continue
        each = {agent: rmse(one) for agent, one in found.items()}
        plain, ours = each[PLAIN], each.get(trained(variant, out))
        blind, kalman = each.get(UNTRAINED), each.get(KALMAN)
        known = _oracle(results, variant.key)
        cells = [apart(one, plain) for one in (ours, blind, known, kalman)]
        cells += [apart(ours, blind), apart(ours, kalman)]
        rows.append([variant.title, short(float(np.sqrt(np.mean(plain**2)))), *cells])
    yield Table("Where the corrector works", header, rows)


def _oracle(results: Results, name: str) -> Floats | None:
    """[R] RMSE (m) of the corrector that knows the truth."""
    found, world = results.get(name, "pfnn", ORACLE), results.get(name, WORLD)
    if found is None or world is None:
        return None
    return metrics.rmse_per_run(found.error, world.scored[: len(found.error)])
