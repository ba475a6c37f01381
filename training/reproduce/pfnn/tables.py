"""Tables 3 to 5, and figure 2 in numbers: the paper's figures beside ours."""

from collections.abc import Iterable

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Floats
from training.evaluation.results import short
from training.reproduce.pfnn import paper
from training.reproduce.pfnn.flown import Flown
from training.reproduce.pfnn.in_flight import NAME as LEARNING
from training.reproduce.pfnn.plan import ablation_agents
from training.reproduce.reporting import DASH, difference

Table = tuple[list[str], list[list[str]]]  # header and lines


def spread(values: Floats | None) -> str:
    """Mean ± standard deviation over runs, or over steps."""
    if values is None or not np.isfinite(values).any():
        return DASH
    kept = values[np.isfinite(values)]
    deviation = f" ± {short(kept.std(ddof=1))}" if len(kept) > 1 else ""
    return short(metrics.mean(kept)) + deviation


def table_3(flown: Flown) -> Table:
    """Errors of each UAV (m), mean over runs."""
    header = ["UAV"]
    for column in ("RMSE", "mean", "max"):
        header += [f"{column}, paper", f"{column}, ours"]
    lines, scored = [], flown.tables.worlds.scored
    errors = flown.tables.agents["pfnn"].error if "pfnn" in flown.tables.agents else None
    for i, (name, row) in enumerate(paper.TABLE_3.items()):
        ours: Iterable[str] = (DASH,) * 3
        if errors is not None:
            part = slice(None) if name == "Average" else slice(i, i + 1)
            error, counts = errors[:, :, part], scored[:, :, part]
            tracks = metrics.rmse_per_track(error, counts)
            largest = np.where(counts, error, 0.0).max(1)
            means = metrics.mean_per_run(error, counts)
            ours = (spread(tracks.mean(1)), spread(means), spread(largest.mean(1)))
        theirs = (f"{x:.3f}" for x in row)
        lines.append([name, *(cell for pair in zip(theirs, ours, strict=True) for cell in pair)])
    return header, lines


def table_4(flown: Flown) -> Table:
    """Errors (m) and particles of each method, mean ± standard deviation over runs."""
    header = ["method", "agent"]
    for column in ("RMSE", "mean", "max", "particles"):
        header += [f"{column}, paper", f"{column}, ours"]
    header += ["ours: diverged runs", "NEES", "× bound"]
    summary, lines = flown.tables.summary["agents"], []
    for agent, row in paper.TABLE_4.items():
        theirs = [_printed(cell) if cell else "N/A" for cell in row]
        ours = [DASH] * 4
        more = [DASH] * 3
        if agent in summary:
            ours = [
                spread(flown.rmse(agent)),
                spread(flown.mean(agent)),
                spread(flown.largest(agent)),
                spread(flown.particles(agent)),
            ]
            figures = summary[agent]
            more = [short(figures[key]) for key in ("diverged_runs", "nees", "ratio_to_bound")]
        pairs = (cell for pair in zip(theirs, ours, strict=True) for cell in pair)
        lines.append([paper.METHODS[agent], f"`{agent}`", *pairs, *more])
    blank = [DASH] * len(header)
    if flown.learning is not None:
        error = flown.learning.error
        scored = flown.tables.worlds.scored[:, : error.shape[1]]
        line = [paper.METHODS["pfnn"], LEARNING, *blank[2:]]
        largest = np.where(scored, error, 0.0).max(1).mean(1)
        line[3], line[5], line[7], line[9] = map(
            spread,
            (
                metrics.rmse_per_run(error, scored),
                metrics.mean_per_run(error, scored),
                largest,
                metrics.mean_per_run(flown.learning.count, scored),
            ),
        )
        lines.append(line)
    if flown.tables.bound is not None:
        mse, scored = (x.numpy() for x in (flown.tables.bound.mse, flown.tables.bound.scored))
        bound = metrics.rmse_per_run(np.sqrt(mse), scored)
        lines.append(["*posterior bound*", *blank[1:3], spread(bound), *blank[4:-1], "1"])
    return header, lines


def table_5(flown: Flown) -> Table:
    """Time of a team's step (ms, mean ± standard deviation over steps), of all (s), and memory."""
    header = ["method", "agent", "ms/step, paper", "ours", "total s, paper", "ours"]
    header += ["MB, paper", "ours: belief", "working set"]
    lines = []
    for agent, row in paper.TABLE_5.items():
        theirs = (_printed(row.ms), f"{row.total:g}", f"{row.memory:g}")
        ours = (DASH,) * 4
        if agent in flown.cost:
            cost = flown.cost[agent]
            total = f"{cost.ms.sum() / 1e3:.2f}"
            ours = (spread(cost.ms), total, f"{cost.belief / 1e6:.3f}", f"{cost.working / 1e6:.2f}")
        lines.append([paper.METHODS[agent], f"`{agent}`"])
        lines[-1] += [theirs[0], ours[0], theirs[1], ours[1], theirs[2], *ours[2:]]
    return header, lines


def figure_2(flown: Flown) -> Table:
    """The ablation in numbers: RMSE and largest error (m), particles; paired with [0.4, 1.0]."""
    header = ["range", "agent", "RMSE", "minus that of [0.4, 1.0]", "largest error", "particles"]
    lines = []
    for agent, span in ablation_agents().items():
        cells = [DASH] * 4
        if agent in flown.tables.agents:
            apart = DASH
            if agent != "pfnn" and "pfnn" in flown.tables.agents:
                apart = difference(
                    metrics.paired_difference(flown.rmse(agent), flown.rmse("pfnn")), 1e3, "mm"
                )
            particles = spread(flown.particles(agent))
            cells = [spread(flown.rmse(agent)), apart, spread(flown.largest(agent)), particles]
        lines.append([f"[{span[0]}, {span[1]}]", f"`{agent}`", *cells])
    return header, lines


def _printed(value: paper.Spread) -> str:
    return f"{value.mean:g}" + ("" if value.std is None else f" ± {value.std:g}")
