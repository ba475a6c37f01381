"""Rivals that the field would ask for, beside the paper's: where each is good, and its cost."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from training.evaluation import metrics
from training.evaluation.tables import short
from training.reproduce.cost import COST, MEMORY
from training.reproduce.measures import rmse_of_all
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.tables import Table, nees
from training.reproduce.work import Cell, Variant

AGENTS = (
    *("pf500", "pf_auxiliary", "pf_rao_blackwell", "pf_mixture", "apf"),
    *("dlspf", "dfgo", "ukf", "ekf"),
)
STEPS = 400  # of a run, unless a study is cut shorter
CARRIED_AT = 10.0  # s
LOST = 2.0  # m: a UAV farther off at the end of a run is lost
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "default": ("default", {}),
    "uniform": ("uniform prior", {"prior": "uniform"}),
    "kidnapped": (
        f"three of six UAVs carried away at {CARRIED_AT:g} s",
        {"kidnap_at": CARRIED_AT, "kidnapped": (0, 1, 2)},
    ),
    "few-nlos": ("5 landmarks + NLOS 30 %", {"landmarks": 5, "nlos": 0.3}),
    "anchors4": (
        "ranges alone: 4 anchors, uniform prior",
        {"landmarks": 0, "anchors": 4, "prior": "uniform"},
    ),
}


def variants(steps: int | None = None) -> list[Variant]:
    """The default and what is hard for one filter or the other."""
    return [
        Variant(f"rivals-{key}", words, tuple(chosen.items()), steps=steps or STEPS, bounded=False)
        for key, (words, chosen) in VARIANTS.items()
    ]


def cells(settings: Settings) -> Iterator[Cell]:
    """All rivals everywhere, in half of the runs; costs in the first variant."""
    for variant in variants(settings.steps):
        yield Cell(variant, AGENTS, settings.fraction(2))
    yield Cell(variants(settings.steps)[0], AGENTS, 1, COST)


def text(settings: Settings) -> list[str]:
    """What is to be known of it."""
    return [
        f"{settings.fraction(2)} runs of {settings.steps or STEPS} steps each. RMSE over all "
        "steps, over the second half, and the median, in m; NEES (3 is consistent); lost: UAVs "
        f"more than {LOST:g} m off at the end.",
        "`pf_auxiliary` looks at a step's measurements before it resamples (Pitt & Shephard 1999, "
        "with the kernel of Liu & West 2001); `pf_rao_blackwell` has particles of the position "
        "alone, velocity and attitude are marginalized; `pf_mixture` draws a tenth of its "
        "particles from what is measured (Thrun et al. 2001). 500 particles each.",
    ]


def tables(results: Results) -> Iterator[Table]:
    """Accuracy, a line for each agent, and costs."""
    header = ["agent", "RMSE", "second half", "median", "NEES", "lost"]
    for variant in variants(results.settings.steps):
        found = results.runs(variant.key, AGENTS)
        rows = [
            [
                f"`{agent}`",
                short(rmse_of_all(one)),
                short(_late(one)),
                short(float(np.median(one.error[one.scored]))),
                nees(one),
                f"{int((one.error[:, -1] > LOST).sum())} of {one.error[:, -1].size}",
            ]
            for agent, one in found.items()
        ]
        yield Table(f"Rivals: {variant.title}", header, rows)
    costs = results.kinds(variants(results.settings.steps)[0].key, COST)
    rows = [
        [
            f"`{agent}`",
            f"{one.median:.1f}",
            f"{one.belief / 1e6:.3f}",
            f"{one.working / 1e6:.2f}",
        ]
        for agent, one in costs.items()
    ]
    header = ["agent", "ms a step (median)", "MB: belief", "working set"]
    caption = f"One world, one thread, all agents step by step in turn. {MEMORY}"
    yield Table("Rivals: cost of a team's step", header, rows, 1, caption)


def _late(one: Runs) -> float:
    """RMSE over the second half of all runs, m."""
    half = one.steps // 2
    return metrics.rmse(one.error[:, half:], one.scored[:, half:])
