"""Where the network might still win over a sum of squared residuals: several anchors that are wrong
alike, a bias that grows slowly, kidnapping."""

from collections.abc import Iterator

import numpy as np

from agents.robust.mahalanobis import chi_square
from training.evaluation.metrics import Difference, Flags, Floats
from training.evaluation.tables import short
from training.learning.nnhpff import FAILED
from training.reproduce.measures import rmse, rmse_of_all
from training.reproduce.nnhpff.detection import confusion, curve
from training.reproduce.nnhpff.plan import KIDNAPPED_AT, RESIDUALS, open_loop, variant_of
from training.reproduce.nnhpff.tables import THRESHOLDS
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.tables import DASH, Table
from training.reproduce.verdicts import apart
from training.reproduce.work import Cell, Variant

WATCHED = open_loop("ekf")
NETWORK, TEST = "nnhpff:bank=false:main=ekf", "hpff:bank=false:main=ekf"
SUM = f"{RESIDUALS}:main=ekf"
AGENTS = ("ekf", TEST, SUM, NETWORK, "ekf:robust=huber")
TROUBLES = (
    "biased_anchors=2:anchor_bias=1",
    "biased_anchors=2:anchor_bias=2:anchor_bias_rise=30",
    f"kidnap_at={KIDNAPPED_AT:g}",
)
_SURE = 0.98  # quantile of d's test, with four ranges
_ANCHORS = 4
_DRAWS = 200  # of worlds with replacement


def variants(steps: int | None = None) -> list[Variant]:
    """Every trouble, with the noise known and with its variance overestimated."""
    texts = (f"case={case}:{trouble}" for trouble in TROUBLES for case in (1, 3))
    return [variant_of("bias", text, steps) for text in texts]


def cells(settings: Settings) -> Iterator[Cell]:
    """A Kalman filter, which has no luck of the draw: one that nothing restarts, watched, and one
    that each detector restarts."""
    for variant in variants(settings.steps):
        yield Cell(variant, (WATCHED, *AGENTS), max(2, settings.fraction(5)))


def text(settings: Settings) -> list[str]:
    """What is to be known of it."""
    return [
        f"{max(2, settings.fraction(5))} worlds each. ROC areas: an `ekf` that nothing restarts "
        "has failed where it is more than 0.5 m off; 95 % intervals from worlds drawn with "
        "replacement. d orders the samples of a scenario as Σr² does, and so has the same area. "
        "Errors: filters that are restarted at once (`bank=false`); differences of RMSE are paired "
        "by world, below 0 where the network is better."
    ]


def tables(results: Results) -> Iterator[Table]:
    """The detectors, and what restarting by them does."""
    found = {v.title: results.runs(v.key, (WATCHED, *AGENTS)) for v in variants()}
    there = {title: one for title, one in found.items() if one}
    yield _detectors({title: one[WATCHED] for title, one in there.items() if WATCHED in one})
    header = ["scenario", *(f"`{agent}`" for agent in AGENTS)]
    header += ["network − Σr² (%)", "network − d (%)"]
    rows = []
    for title, one in there.items():
        cells = [short(rmse_of_all(one[a])) if a in one else DASH for a in AGENTS]
        cells += [_less(one, NETWORK, other) for other in (SUM, TEST)]
        rows.append([title, *cells])
    yield Table("Anchors that are wrong alike, drift, kidnapping: RMSE in m", header, rows)


def _detectors(found: dict[str, Runs]) -> Table:
    header = ["scenario", "failed (%)", "network: ROC area", "Σr² and d: ROC area"]
    header += ["network − Σr²", "accuracy: network", "Σr²", "d"]
    rows = []
    for title, one in found.items():
        network, residual, distance = (
            one.record.series[name] for name in ("failure", "residual_rms", "mahalanobis")
        )
        failed = one.error > FAILED
        areas = [DASH] * 3
        if 0 < failed.sum() < failed.size:
            each = [f"{curve(x.ravel(), failed.ravel()).auc:.4f}" for x in (network, residual)]
            apart = areas_apart(network, residual, failed)
            areas = [*each, f"{apart.mean:+.4f} ({apart.low:+.4f} to {apart.high:+.4f})"]
        judged = (
            (network, THRESHOLDS["network"]),
            (residual, THRESHOLDS["Σr² alone"]),
            (distance, chi_square(_SURE, _ANCHORS)),
        )
        right = [confusion(x.ravel(), failed.ravel(), at).accuracy for x, at in judged]
        rows.append([title, f"{100 * failed.mean():.1f}", *areas, *(f"{x:.3f}" for x in right)])
    return Table("Anchors that are wrong alike, drift, kidnapping: detectors", header, rows)


def areas_apart(first: Floats, second: Floats, failed: Flags) -> Difference:
    """How much larger the first score's ROC area is, with a 95 % bootstrap interval over worlds
    (the first dimension), each drawing with failures and without."""
    rng, found = np.random.default_rng(0), []
    draws = [np.arange(len(failed)), *rng.integers(len(failed), size=(_DRAWS, len(failed)))]
    for draw in draws:
        truth = failed[draw].ravel()
        if 0 < truth.sum() < truth.size:
            ours, other = (curve(score[draw].ravel(), truth).auc for score in (first, second))
            found.append(ours - other)
    low, high = np.percentile(found[1:] or found, (2.5, 97.5))
    return Difference(found[0], float(low), float(high))


def _less(there: dict[str, Runs], first: str, second: str) -> str:
    """How much larger the first's RMSE is, in per cent of the second's."""
    ours, other = (rmse(there[x]) if x in there else None for x in (first, second))
    return apart(ours, other)
