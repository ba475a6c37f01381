"""A corrector that sees what the paper's does not, in regimes that no training saw."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from training.evaluation.tables import short
from training.reproduce.measures import rmse
from training.reproduce.results import Results
from training.reproduce.settings import Settings
from training.reproduce.tables import Table
from training.reproduce.verdicts import apart
from training.reproduce.work import Cell, Variant

STEPS = 60  # of a run, unless a study is cut shorter
PLAIN, OURS = "apf", "pf_corrected"
OTHERS = ("pfnn", "pfnn:weights=none", "ekf", "ekf:robust=huber")
UNSEEN: dict[str, tuple[str, dict[str, Any]]] = {
    "anchors6-nlos": (
        "6 anchors, NLOS 20 %, start anywhere",
        {"landmarks": 0, "anchors": 6, "prior": "uniform", "nlos": 0.2},
    ),
    "anchors3": (
        "3 anchors, start anywhere",
        {"landmarks": 0, "anchors": 3, "prior": "uniform"},
    ),
    "anchors4-tails": (
        "4 anchors, heavy tails, start anywhere",
        {"landmarks": 0, "anchors": 4, "prior": "uniform", "uwb_tail": 0.2},
    ),
    "landmarks2-nlos": (
        "2 landmarks, NLOS 40 %, start anywhere",
        {"landmarks": 2, "prior": "uniform", "nlos": 0.4},
    ),
}


def variants(steps: int | None = None) -> list[Variant]:
    """Random motion, with numbers of anchors and landmarks, shares of NLOS and tails that the
    network was not trained with."""
    return [
        Variant(
            f"unseen-{key}",
            f"{words}; random motion",
            (*chosen.items(), ("motion", "random")),
            steps=steps or STEPS,
            bounded=False,
        )
        for key, (words, chosen) in UNSEEN.items()
    ]


def cells(settings: Settings) -> Iterator[Cell]:
    """All filters in each regime, in half of the runs."""
    for variant in variants(settings.steps):
        yield Cell(variant, (PLAIN, *OTHERS, OURS), settings.fraction(2))


def text(settings: Settings) -> list[str]:
    """What is to be known of it."""
    return [
        f"{settings.fraction(2)} runs of {settings.steps or STEPS} steps a regime, none of which "
        "any training met. `pf_corrected` is `apf` with a network that sees each particle's "
        "residuals, the effective sample size and the time, trained through the filter; `pfnn` the "
        "paper's, with the shipped weights and untrained. Differences of RMSE are paired by world, "
        "in per cent of the other's, below 0 where the first is better, with 95 % intervals."
    ]


def tables(results: Results) -> Iterator[Table]:
    """One line a regime."""
    header = ["regime", f"`{PLAIN}`: RMSE (m)"]
    header += [f"`{agent}` − `{PLAIN}` (%)" for agent in (OURS, *OTHERS)]
    header += [f"`{OURS}` − `{agent}` (%)" for agent in OTHERS]
    rows = []
    for variant in variants(results.settings.steps):
        found = results.runs(variant.key, (PLAIN, *OTHERS, OURS))
        if PLAIN not in found:
            continue
        each = {agent: rmse(one) for agent, one in found.items()}
        plain, ours = each[PLAIN], each.get(OURS)
        cells = [short(float(np.sqrt(np.mean(plain**2))))]
        cells += [apart(each.get(agent), plain) for agent in (OURS, *OTHERS)]
        cells += [apart(ours, each.get(agent)) for agent in OTHERS]
        rows.append([variant.title, *cells])
    yield Table("A corrector that sees residuals, where it was not trained", header, rows)
