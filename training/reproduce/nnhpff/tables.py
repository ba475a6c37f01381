"""The report's tables, as a header and lines."""

from collections.abc import Mapping

import numpy as np

from training.evaluation.results import short
from training.reproduce.nnhpff.detection import calibration, confusion, curve
from training.reproduce.nnhpff.flown import Detections, Flown
from training.reproduce.nnhpff.measures import WITHIN, Runs
from training.reproduce.reporting import Table, ends
from training.reproduce.verdicts import interval

PAPER_MS = {"pf": 4.15, "hpff": 4.55, "nnhpff": 7.01}


def errors(found: Mapping[str, Mapping[str, Runs]]) -> Table:
    """By variant's title and agent: ALE, resets, peak and first reset after the corner, NEES."""
    header = ["variant", "agent", "ALE (m)", "after 2 s", "resets a run", "peak at the corner (m)"]
    header += ["first reset after it (step)", "largest (m)", "NEES"]
    lines = []
    for title, there in found.items():
        bound = next((one.results.bound for one in there.values()), None)
        words = title if bound is None else f"{title} (its model's bound: {bound.rmse:.3f} RMSE)"
        for agent, one in there.items():
            nees = one.one.nees[one.results.worlds.scored]
            lines.append(
                [
                    words,
                    f"`{agent}`",
                    ends(interval(one.ale())),
                    short(float(one.settled_ale().mean())),
                    resets(one),
                    ends(interval(one.corner_peak())),
                    first_reset(one),
                    short(float(one.error.max(1).mean())),
                    short(float(np.nanmean(nees))),
                ]
            )
    return header, lines


def costs(flown: Flown) -> Table:
    """Table 1, with the paper's figures (another machine)."""
    header = ["agent", "mean (ms)", "median (ms)", "paper (ms)", "times the PF's mean"]
    lines = []
    own = flown.cost["pf"].ms.mean() if "pf" in flown.cost else np.nan
    for agent, one in flown.cost.items():
        paper = PAPER_MS.get(agent)
        lines.append(
            [
                f"`{agent}`",
                f"{one.ms.mean():.2f}",
                f"{np.median(one.ms):.2f}",
                "" if paper is None else f"{paper}",
                f"{one.ms.mean() / own:.2f}"
                + ("" if paper is None else f" (paper {paper / PAPER_MS['pf']:.2f})"),
            ]
        )
    return header, lines


def detectors(samples: Mapping[str, Detections | None], threshold: float) -> Table:
    """The network and d itself as detectors, over groups of scenarios."""
    header = ["samples", "detector", "count", "failed (%)", "ROC area", "average precision"]
    header += ["precision", "recall", "false alarms (%)", "accuracy", "Brier", "calibration error"]
    lines = []
    for title, group in samples.items():
        if group is None:
            continue
        failed = group.failed
        start = [f"{failed.size}", f"{100 * failed.mean():.1f}"]
        for name, score in (("network", group.probability), ("d alone", group.distance)):
            shape = ["–", "–"]
            if 0 < failed.sum() < failed.size:
                drawn = curve(score, failed)
                shape = [f"{drawn.auc:.4f}", f"{drawn.average_precision:.3f}"]
            rest = [""] * 6
            if name == "network":
                hit, sure = confusion(score, failed, threshold), calibration(score, failed)
                rest = [f"{hit.precision:.3f}", f"{hit.recall:.3f}"]
                rest += [f"{100 * hit.false_alarm_rate:.2f}", f"{hit.accuracy:.4f}"]
                rest += [f"{sure.brier:.4f}", f"{sure.error:.4f}"]
            lines.append([title, name, *start, *shape, *rest])
    return header, lines


def confusions(samples: Mapping[str, Detections | None], threshold: float) -> Table:
    """What was called failed and what had."""
    header = ["samples", "had failed", "called failed", "called sound"]
    lines = []
    for title, group in samples.items():
        if group is None:
            continue
        hit = confusion(group.probability, group.failed, threshold)
        lines.append([title, "yes", str(hit.hits), str(hit.misses)])
        lines.append([title, "no", str(hit.false_alarms), str(hit.correct_rejections)])
    return header, lines


def recoveries(found: Mapping[str, tuple[Mapping[str, Runs], int, slice]]) -> Table:
    """Time from a kidnapping until a UAV's error stays small, and how many come so far."""
    header = ["variant", "agent", "recovered in 10 s (%)", "median time (s)", "slowest (s)"]
    header += ["mean error in those 10 s (m)", "resets a run"]
    lines = []
    for title, (there, step, uavs) in found.items():
        for agent, one in there.items():
            time = one.recovery(step, uavs).ravel()
            back = time[np.isfinite(time)]
            after = one.error[:, step : step + WITHIN, uavs]
            lines.append(
                [
                    title,
                    f"`{agent}`",
                    f"{100 * len(back) / len(time):.0f}",
                    f"{np.median(time):.1f}" if 2 * len(back) > len(time) else "–",
                    f"{back.max():.1f}" if len(back) else "–",
                    short(float(after.mean())),
                    resets(one),
                ]
            )
    return header, lines


def plain_errors(found: Mapping[str, Mapping[str, Runs]], lost: str) -> Table:
    """By variant's title and agent: RMSE, mean, median and largest error, resets."""
    header = ["variant", "agent", "RMSE (m)", "mean", "median", "largest", "resets a run", lost]
    lines = []
    for title, there in found.items():
        for agent, one in there.items():
            error = one.error[one.results.worlds.scored]
            lines.append(
                [
                    title,
                    f"`{agent}`",
                    short(float(np.sqrt((error.astype(np.float64) ** 2).mean()))),
                    short(float(error.mean())),
                    short(float(np.median(error))),
                    short(float(error.max())),
                    resets(one),
                    f"{int(one.results.diverged(agent).sum())} of {one.results.runs}",
                ]
            )
    return header, lines


def resets(one: Runs) -> str:
    """Resets a run; nothing for what has none."""
    if "resets_per_run" not in one.one.series:
        return ""
    return short(float(one.resets_per_run().mean()))


def first_reset(one: Runs) -> str:
    """Median step, and in how many runs there is one."""
    if "resets_per_run" not in one.one.series:
        return ""
    step = one.first_reset()
    reset = np.isfinite(step)
    if not reset.any():
        return "never"
    return f"{np.median(step[reset]):.0f} ({100 * reset.mean():.0f} % of runs)"
