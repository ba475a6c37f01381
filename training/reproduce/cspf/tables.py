"""The report's tables, as a header and lines."""

from collections.abc import Mapping

import numpy as np

from training.evaluation.tables import short
from training.reproduce.cspf import plan
from training.reproduce.cspf.measures import Runs
from training.reproduce.verdicts import share

Table = tuple[list[str], list[list[str]]]


def figures(found: Mapping[str, Mapping[str, Runs]]) -> Table:
    """By variant's title and agent: share converged, worst error, NEES, time of a step."""
    header = ["world", "agent", "runs", f"converged at {plan.EARLY} (%)", f"at {plan.LATE} (%)"]
    header += ["worst error, median (m)", "90 % of runs (m)", "NEES", "ms a step"]
    lines = []
    for title, there in found.items():
        for agent, one in there.items():
            worst, cost = one.worst(plan.EARLY), one.one.ms_per_step
            lines.append(
                [
                    title,
                    f"`{agent}`",
                    str(one.results.runs),
                    _share(one, plan.EARLY),
                    _share(one, plan.LATE),
                    short(float(np.median(worst))),
                    short(float(np.quantile(worst, 0.9, method="higher"))),
                    short(one.nees()),
                    "" if cost is None else f"{cost:.2f}",
                ]
            )
    return header, lines


def _share(one: Runs, steps: int) -> str:
    """Per cent of the runs with the exact interval; nothing where runs were cut before."""
    if one.steps < steps:
        return ""
    found = share(one.converged(steps))
    return f"{found.mean:.0f} ({found.low:.0f} to {found.high:.0f})"
