"""The tables: errors and resets, costs, the detector, recovery."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from agents.particle.hpff import LIMIT
from training.evaluation.metrics import Flags, Floats
from training.evaluation.tables import short
from training.learning.nnhpff import FAILED
from training.reproduce.cost import COST
from training.reproduce.measures import mean_error, quantile, rmse_of_all
from training.reproduce.nnhpff import plan
from training.reproduce.nnhpff.detection import calibration, confusion, curve
from training.reproduce.nnhpff.plan import (
    WITHIN,
    corner_peak,
    first_reset,
    recovery,
    resets_per_run,
    settled_error,
)
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.tables import DASH, Table, by_agent, lost, nees, shortened, with_ends

PAPER_MS = {"pf": 4.15, "hpff:bank=false": 4.55, "nnhpff:bank=false": 7.01}
THRESHOLD = 0.5  # of the probability, beyond which the paper restarts
THRESHOLDS = {"network": THRESHOLD, "Σr² alone": LIMIT}
_Places = Mapping[str, Mapping[str, Runs]]


def paper_text(settings: Settings) -> list[str]:
    """What is to be known of the paper's cases."""
    return [f"`wsn-v0`, {settings.runs} runs; means with 95 % intervals over runs."]


def paper(results: Results) -> Iterator[Table]:
    """Errors and costs."""
    agents = (*plan.METHODS, *plan.BESIDE)
    places = {t: results.runs(plan.case(n).key, agents) for n, t in plan.CASES.items()}
    yield _errors("Errors and resets (figures 5 to 8)", places)
    header = ["agent", "mean (ms)", "median (ms)", "paper (ms)", "times the PF's mean"]
    costs = results.kinds(plan.case(1).key, COST)
    own = costs["pf"].ms.mean() if "pf" in costs else np.nan
    rows = []
    for agent, one in costs.items():
        theirs = PAPER_MS.get(agent)
        times = f"{one.ms.mean() / own:.2f}"
        if theirs is not None:
            times += f" (paper {theirs / PAPER_MS['pf']:.2f})"
        cells = [f"{one.ms.mean():.2f}", f"{one.median:.2f}", f"{theirs or ''}", times]
        rows.append([f"`{agent}`", *cells])
    caption = (
        "Case 1, one world, one thread, all filters step by step in turn. The paper's are MATLAB's "
        "on an i5-12500."
    )
    yield Table("Table 1: time of a localization, 5000 particles", header, rows, 1, caption)


def _errors(title: str, places: _Places) -> Table:
    """ALE, resets, peak and first reset after the corner, NEES."""
    titled = {}
    for place, there in places.items():
        bound = next((one.evaluation.bound for one in there.values()), None)
        words = "" if bound is None else f" (its model's bound: {bound.rmse:.3f} RMSE)"
        titled[place + words] = there
    columns = [
        ("ALE (m)", with_ends(mean_error)),
        ("after 2 s", shortened(lambda one: settled_error(one).mean())),
        ("resets a run", _resets),
        ("peak at the corner (m)", with_ends(corner_peak)),
        ("first reset after it (step)", _first_reset),
        ("largest (m)", shortened(lambda one: one.error.max(1).mean())),
        ("NEES", nees),
    ]
    return by_agent(title, titled, columns)


def _resets(one: Runs) -> str:
    """Nothing for what has none."""
    known = "resets_per_run" in one.record.series
    return short(float(resets_per_run(one).mean())) if known else ""


def _first_reset(one: Runs) -> str:
    """Median step, and in how many runs there is one."""
    if "resets_per_run" not in one.record.series:
        return ""
    step = first_reset(one)
    reset = np.isfinite(step)
    if not reset.any():
        return "never"
    return f"{np.median(step[reset]):.0f} ({100 * reset.mean():.0f} % of runs)"


# ------------------------------------------------------------------ the detector


@dataclass(frozen=True, eq=False)
class Detections:
    """Samples of a detector that only watches: the network's probability, the Mahalanobis distance,
    the residuals' root mean square (m), the estimate's error (m)."""

    probability: Floats
    distance: Floats
    residual: Floats
    error: Floats

    @property
    def failed(self) -> Flags:
        return self.error > FAILED

    @property
    def scores(self) -> dict[str, Floats]:
        """What a threshold may be set to, by name."""
        return {
            "network": self.probability,
            "Σr² alone": self.residual,
            "d alone": self.distance,
        }


def detector_text(settings: Settings) -> list[str]:
    """What is to be known of the detector."""
    return [
        f"{settings.fraction(10)} worlds a scenario; nothing is restarted here.",
        "Σr²: the bare sum of squared residuals, as the root of its mean, √(Σr²/n), called a "
        f"failure beyond {LIMIT:g} m, which errs least on the worlds that the network is trained "
        f"on; the network beyond {THRESHOLD:g}; d: the Mahalanobis distance, which the believed R "
        "scales.",
    ]


def detections(results: Results) -> dict[str, Detections]:
    """All samples of the training's scenarios and of others, each with its filter."""
    groups = {
        "the 27 scenarios, other worlds": plan.trained_on(),
        "scenarios never seen": plan.never_seen(),
    }
    found = {title: _detections(results, planned) for title, planned in groups.items()}
    return {title: one for title, one in found.items() if one is not None}


def _detections(results: Results, planned: Sequence[plan.Planned]) -> Detections | None:
    """Of some scenarios, each with its filters; None if nothing was run."""
    parts: list[list[Floats]] = []
    for variant, agents in planned:
        for one in results.runs(variant.key, agents).values():
            series = one.record.series
            values = (*(series[x] for x in ("failure", "mahalanobis", "residual_rms")), one.error)
            parts.append([x[one.scored] for x in values])
    if not parts:
        return None
    return Detections(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def detector(results: Results) -> Iterator[Table]:
    """The network, Σr² and d as classifiers, the first two's confusion, and each kind of
    failure."""
    header = ["samples", "detector", "count", "failed (%)", "ROC area", "average precision"]
    header += ["precision", "recall", "false alarms (%)", "accuracy", "Brier", "calibration error"]
    rows, confusions = [], []
    for title, group in detections(results).items():
        failed = group.failed
        for name, score in group.scores.items():
            areas, rest = [DASH] * 2, [""] * 6
            if 0 < failed.sum() < failed.size:
                drawn = curve(score, failed)
                areas = [f"{drawn.auc:.4f}", f"{drawn.average_precision:.3f}"]
            if name in THRESHOLDS:
                hit = confusion(score, failed, THRESHOLDS[name])
                rest = [f"{hit.precision:.3f}", f"{hit.recall:.3f}"]
                rest += [f"{100 * hit.false_alarm_rate:.2f}", f"{hit.accuracy:.4f}", "", ""]
                confusions.append([title, name, "yes", str(hit.hits), str(hit.misses)])
                counts = str(hit.false_alarms), str(hit.correct_rejections)
                confusions.append([title, name, "no", *counts])
            if name == "network":
                sure = calibration(score, failed)
                rest[4:] = [f"{sure.brier:.4f}", f"{sure.error:.4f}"]
            count = [f"{failed.size}", f"{100 * failed.mean():.1f}"]
            rows.append([title, name, *count, *areas, *rest])
    yield Table("As a classifier", header, rows, 2)
    header = ["samples", "detector", "had failed", "called failed", "called sound"]
    yield Table("Confusion", header, confusions, 3)
    yield _by_scenario(results)


def _by_scenario(results: Results) -> Table:
    """ROC area of each score in each scenario that was not trained on: where a network wins, if
    anywhere; and the accuracy of those with a threshold."""
    header, rows = ["scenario", "count", "failed (%)"], []
    names = ("network", "Σr² alone", "d alone")
    header += [f"{name}: ROC area" for name in names]
    header += [f"{name}: accuracy" for name in THRESHOLDS]
    planned: dict[str, list[plan.Planned]] = {}
    for variant, agents in plan.never_seen():
        planned.setdefault(variant.title, []).append((variant, agents))
    for title, some in planned.items():
        group = _detections(results, some)
        if group is None:
            continue
        failed, scores = group.failed, group.scores
        both = 0 < failed.sum() < failed.size
        areas = [f"{curve(scores[x], failed).auc:.4f}" if both else DASH for x in names]
        right = [confusion(scores[x], failed, at).accuracy for x, at in THRESHOLDS.items()]
        count = [f"{failed.size}", f"{100 * failed.mean():.1f}"]
        rows.append([title, *count, *areas, *(f"{x:.4f}" for x in right)])
    return Table("By scenario, none of them trained on", header, rows)


# ------------------------------------------------------------------ beyond


def beyond(results: Results) -> Iterator[Table]:
    """Sensitivity, recovery, NLOS, recordings."""
    title = "How σ, M, Q and the quantile move it"
    yield _errors(title, _places(results, plan.sensitivity()))
    yield _recoveries(results)
    columns = [
        ("RMSE (m)", shortened(rmse_of_all)),
        ("mean", shortened(lambda one: one.error[one.scored].mean())),
        ("median", shortened(quantile(0.5))),
        ("largest", shortened(lambda one: one.error[one.scored].max())),
        ("resets a run", _resets),
        ("runs lost", lost),
    ]
    for title, planned in (
        ("An anchor that is always NLOS", plan.blocked()),
        ("Recordings (the runs differ in what is drawn at their start)", plan.recordings()),
    ):
        yield by_agent(title, _places(results, planned), columns)


def _places(results: Results, planned: list[plan.Planned]) -> _Places:
    """Several plans may share a variant: all their agents, in turn."""
    found: dict[str, dict[str, Runs]] = {}
    for variant, agents in planned:
        found.setdefault(variant.title, {}).update(results.runs(variant.key, agents))
    return {title: there for title, there in found.items() if there}


def kidnapped(results: Results) -> dict[str, tuple[dict[str, Runs], int, slice]]:
    """By variant's title: runs, the step at which UAVs are carried, and which; where runs are long
    enough to see them recover."""
    found = {}
    for variant, agents in plan.kidnapping():
        there, step = results.runs(variant.key, agents), plan.kidnapped_step(variant)
        if there and step + WITHIN <= next(iter(there.values())).steps:
            found[variant.title] = (there, step, plan.kidnapped_uavs(variant))
    return found


def _recoveries(results: Results) -> Table:
    """Time from a kidnapping until a UAV's error stays small, and how many get so far."""
    header = ["variant", "agent", "recovered in 10 s (%)", "median time (s)", "slowest (s)"]
    header += ["mean error in those 10 s (m)", "resets a run"]
    rows = []
    for title, (there, step, uavs) in kidnapped(results).items():
        for agent, one in there.items():
            time = recovery(one, step, uavs).ravel()
            back = time[np.isfinite(time)]
            cells = [
                f"{100 * len(back) / len(time):.0f}",
                f"{np.median(time):.1f}" if 2 * len(back) > len(time) else DASH,
                f"{back.max():.1f}" if len(back) else DASH,
                short(float(one.error[:, step : step + WITHIN, uavs].mean())),
                _resets(one),
            ]
            rows.append([title, f"`{agent}`", *cells])
    return Table("Recovery from kidnapping", header, rows, 2)
