"""The paper's figures 4 to 11, and why the paper's confidence is too weak."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coloc_env.render.style import MUTED
from training.evaluation.figures import log_axis
from training.evaluation.metrics import Floats
from training.evaluation.tables import short
from training.reproduce.cost import COST
from training.reproduce.drawing import legend, panels
from training.reproduce.measures import rmse_of_all
from training.reproduce.results import Results, Runs
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.measures import radius
from training.reproduce.stdcl.plan import W
from training.reproduce.stdcl.style import (
    curves,
    metres,
    name,
    over_time,
    shown,
    style_of,
)
from training.reproduce.stdcl.tables import exponent, median

_BOTH = ("mds", plan.WHOLE)  # whom figures 4 and 5 compare
_FROM = 21  # the first of the paper's four UAVs


def layouts(results: Results) -> Figure | None:
    """Figure 4: the last step of the first run from above, by layout. Grey: true positions,
    triangles: anchors; coloured: estimates, joined to the truth."""
    every = {x: shown(results, W.layout(x).key) for x in ("random", "u", "o")}
    found = {x: there for x, there in every.items() if there}
    if not found:
        return None
    figure, grid = panels(2, len(found), (3.6 * len(found), 7.0), "Estimates by layout")
    for column, (title, there) in enumerate(found.items()):
        for row, agent in enumerate(_BOTH):
            axes = grid[row][column]
            axes.set(xlabel="x (km)", ylabel="y (km)", aspect="equal")
            if agent not in there:
                continue
            one = there[agent]
            truth, scored = one.truth[0, -1] / 1e3, one.scored[0, -1]
            found_at = truth + one.record.offset[0, -1] / 1e3
            _dots(axes, truth[scored], s=26, facecolors="none", edgecolors="#aaaaaa", lw=0.8)
            _dots(axes, truth[~scored], s=16, marker="^", color=MUTED)
            colour = style_of(agent)["color"]
            for start, end in zip(truth[scored, :2], found_at[scored, :2], strict=True):
                axes.plot(*np.transpose((start, end)), color=colour, linewidth=0.8)
            _dots(axes, found_at[scored], s=7, color=colour, zorder=3)
            axes.set_title(f"{name(agent)}, {title}: {short(rmse_of_all(one))} m", fontsize=9.5)
            _frame(axes, truth[:, :2])
    return figure


def maps(results: Results) -> Figure | None:
    """Figure 5: mean error by place, seen from above, over all runs and steps; and the
    distribution of all errors. Each map has its own scale."""
    there = shown(results, W.layout("random").key)
    if not there:
        return None
    figure, (grid,) = panels(1, 3, (12.5, 4.0), "Errors in random layouts")
    for axes, agent in zip(grid, _BOTH, strict=False):
        axes.set(xlabel="x (km)", ylabel="y (km)", aspect="equal", title=name(agent))
        if agent not in there:
            continue
        one = there[agent]
        place, error = one.truth[one.scored] / 1e3, one.error[one.scored]
        top = float(np.quantile(error, 0.98))
        picture = axes.hexbin(
            place[:, 0],
            place[:, 1],
            error,
            gridsize=22,
            cmap="viridis",
            vmin=0,
            vmax=top,
            linewidths=0.1,
        )
        axes.grid(False)
        bar = figure.colorbar(picture, ax=axes, shrink=0.85, pad=0.02)
        bar.set_label("mean error (m)")
    axes = grid[-1]
    share = np.linspace(0.001, 0.999, 400)
    for i, (agent, one) in enumerate(there.items()):
        errors = one.error[one.scored]
        axes.plot(np.quantile(errors, share), 100 * share, **style_of(agent, i))
    axes.set(xlabel="error (m)", ylabel="errors below (%)", xscale="log", ylim=(0, 100))
    axes.set_title("distribution")
    legend(figure, [axes], 6)
    return figure


def speeds(results: Results) -> Figure | None:
    """Figure 6: NRMSE over time, root mean square over runs and UAVs."""
    every = {v: shown(results, W.speed(v).key) for v in (plan.FAST, plan.MODERATE)}
    found = {v: there for v, there in every.items() if there}
    if not found:
        return None
    size = (5.6 * len(found), 4.6)
    figure, (grid,) = panels(1, len(found), size, "NRMSE over time", sharey=True)
    for axes, v_max in zip(grid, found, strict=True):
        over_time(axes, results, W.speed(v_max).key)
        axes.set_title(f"v_max = {v_max:g} m/s")
    grid[0].set_ylabel("NRMSE")
    metres(grid[-1], list(found.values())[-1:])
    legend(figure, grid)
    return figure


def tracks(results: Results) -> Figure | None:
    """Figure 7: four UAVs of the first run at 10 m/s, each from where it starts, from above and
    from the side. Black: truth; coloured: ST-DCL."""
    one = results.get(W.speed(plan.SLOW).key, plan.WHOLE)
    if one is None:
        return None
    scored = np.flatnonzero(one.scored[0].any(0))
    late = scored[scored >= _FROM]
    uavs = (late if len(late) >= 4 else scored)[:4]
    figure, grid = panels(2, len(uavs), (2.9 * len(uavs), 5.6), "Estimated tracks")
    truth = one.truth[0]
    found = truth + one.record.offset[0]
    for column, uav in enumerate(uavs):
        start = truth[0, uav]
        for row, (a, b) in enumerate(((0, 1), (2, 0))):
            axes, words = grid[row][column], "xyz"
            axes.plot(*(truth[:, uav] - start)[:, [a, b]].T, "--", color="black", linewidth=1.2)
            colour = style_of(plan.WHOLE)["color"]
            axes.plot(*(found[:, uav] - start)[:, [a, b]].T, color=colour, linewidth=1.0)
            axes.set(xlabel=f"{words[a]} (m)", ylabel=f"{words[b]} (m)")
            axes.set_aspect("equal", adjustable="datalim")
        grid[0][column].set_title(f"UAV {uav}")
    return figure


def radii(results: Results) -> Figure | None:
    """Figure 8: NRMSE by radius of communication, with 95 % intervals over runs; errors in m are
    divided by that radius. The snapshot's bound: of the UAVs that one step's ranges localize."""
    keys = {r: W.radius(r).key for r in plan.RADII}
    keys = {r: key for r, key in keys.items() if shown(results, key)}
    if not keys:
        return None
    figure, ((own, plain),) = panels(1, 2, (11.0, 4.6), "Radius of communication, v_max = 10 m/s")
    for axes, scaled, label in ((own, True, "NRMSE"), (plain, False, "RMSE (m)")):
        curves(axes, results, keys, scaled)
        axes.set(xlabel="R (m)", ylabel=label)
    legend(figure, [own])
    return figure


def times(results: Results) -> Figure | None:
    """Figure 9: median time of a whole team's step on one thread, by number of UAVs (in brackets
    the exponent of its growth from N = 100 on), and the error that it buys (hollow: Huber)."""
    every = {n: results.kinds(W.timed(n).key, COST) for n in plan.GROWTH}
    grown = {n: costs for n, costs in every.items() if costs}
    if not grown:
        return None
    figure, ((growth, trade),) = panels(1, 2, (12.0, 4.6), "Time of a step")
    agents = dict.fromkeys(agent for costs in grown.values() for agent in costs)
    for i, agent in enumerate(agents):
        spent = [median(costs, agent) for costs in grown.values()]
        style = style_of(agent, i)
        style["label"] += f" ({exponent(list(grown), spent):.1f})"
        growth.plot(list(grown), spent, marker="o", markersize=3.5, **style)
    growth.axhline(100, color=MUTED, linewidth=0.8, linestyle=":")
    growth.set(xlabel="UAVs", ylabel="median time (ms)", xscale="log", yscale="log")
    growth.set_xticks(list(grown), [str(n) for n in grown])
    growth.minorticks_off()
    legend(figure, [growth])
    there, at = results.runs(W.speed(plan.SLOW).key), grown.get(200, {})
    for i, agent in enumerate(agent for agent in at if agent in there):
        colour = style_of(agent, i)["color"]
        face = "none" if agent == plan.HUBER else colour
        x, y = at[agent].median, rmse_of_all(there[agent])
        trade.plot(x, y, "o", color=colour, markerfacecolor=face, markersize=8)
    trade.set(xlabel="median time (ms)", ylabel="RMSE (m)", title="N = 200, v_max = 10 m/s")
    log_axis(trade.xaxis, trade.set_xscale)
    log_axis(trade.yaxis, trade.set_yscale)
    return figure


# ------------------------------------------------------------------ stress


def nlos(results: Results) -> Figure | None:
    """Figure 10: NRMSE by share of NLOS ranges: 25 m too long, and with 50 m of noise instead of
    10; INS without bias; 95 % intervals over runs. The paper's NRMSE of 0.08 is 400 m."""
    biased = {100 * x: W.share(x).key for x in plan.SHARES}
    heavy = {100 * x: W.tail(x).key for x in (0.0, *plan.TAILS)}
    teams = [shown(results, key) for key in (*heavy.values(), *biased.values())]
    if not any(teams):
        return None
    figure, (grid,) = panels(1, 2, (11.5, 4.8), "NLOS", sharey=True)
    titles = ("25 m too long", "mixture: 50 m of noise")
    for axes, keys, title in zip(grid, (biased, heavy), titles, strict=True):
        curves(axes, results, keys, scaled=True)
        axes.set(xlabel="NLOS ranges (%)", title=title)
    grid[0].set_ylabel("NRMSE")
    metres(grid[-1], teams)
    legend(figure, grid)
    return figure


def connectivity(results: Results) -> Figure | None:
    """Figure 11: (a) RMSE by mean number of neighbours, from 2.5 on; (b) NRMSE over time with every
    link failing in 25 % of the steps. INS without bias."""
    sparse = {degree(next(iter(there.values()))): W.sparse(r).key for r in plan.SPARSE
              if (there := shown(results, W.sparse(r).key))}  # fmt: skip
    failing = W.failing(plan.FAILURES[0]).key
    if not sparse and not shown(results, failing):
        return None
    figure, ((by_degree, in_steps),) = panels(1, 2, (11.5, 4.8), "Connectivity")
    curves(by_degree, results, sparse, scaled=False)
    by_degree.set(xlabel="mean degree", ylabel="RMSE (m)", xscale="log", title="a  sparse networks")
    if sparse:
        by_degree.set_xticks(list(sparse), [f"{x:.3g}" for x in sparse], fontsize=8)
        by_degree.minorticks_off()
    over_time(in_steps, results, failing)
    in_steps.set(title="b  25 % of the links failing", ylabel="NRMSE")
    metres(in_steps, [shown(results, failing)])
    legend(figure, [by_degree, in_steps])
    return figure


def degree(one: Runs) -> float:
    """Mean number of UAVs within reach, over the runs' first, middle and last step."""
    places = one.truth[:, [0, one.steps // 2, -1]].reshape(-1, *one.truth.shape[2:])
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    return float((apart <= radius(one)).sum(-1).mean() - 1)


def confidence(results: Results) -> Figure | None:
    """The optimizer with no confidence, the paper's, Huber's loss and calibrated weights: halving
    the weight of a link halves its pull, no more; a bias of one sign stays."""
    keys = {100 * x: W.share(x).key for x in plan.SHARES}
    agents = (*plan.CONFIDENCES_OF, plan.OPTIMIZER)
    if not any(results.runs(key, agents) for key in keys.values()):
        return None
    figure, ((axes,),) = panels(1, 1, (6.4, 4.4), "How much a doubtful link counts")
    curves(axes, results, keys, False, agents)
    axes.set(xlabel="NLOS ranges (%)", ylabel="RMSE (m)")
    axes.legend(fontsize=8)
    return figure


# ------------------------------------------------------------------ parts


def _dots(axes: Axes, places: Floats, **style: Any) -> None:
    axes.scatter(places[:, 0], places[:, 1], **style)


def _frame(axes: Axes, places: Floats, margin: float = 0.6) -> None:
    """Limits about the truth; estimates far outside leave the picture."""
    low, high = places.min(0) - margin, places.max(0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


PAPER = {
    "figure_4_layouts.png": layouts,
    "figure_5_errors.png": maps,
    "figure_6_nrmse.png": speeds,
    "figure_7_tracks.png": tracks,
    "figure_8_radius.png": radii,
    "figure_9_time.png": times,
}
STRESS = {
    "figure_10_nlos.png": nlos,
    "figure_11_connectivity.png": connectivity,
    "confidence.png": confidence,
}
