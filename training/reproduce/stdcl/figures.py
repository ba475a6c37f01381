"""The paper's figures 4 to 9."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from coloc_env.bounds import Bound
from coloc_env.render.style import MUTED
from training.evaluation import metrics
from training.evaluation.figures import log_axis
from training.evaluation.metrics import Floats
from training.evaluation.results import short
from training.reproduce.cost import Cost
from training.reproduce.drawing import panels
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.flown import Teams
from training.reproduce.stdcl.looks import OF_SNAPSHOT, WITH_MOTION, legend, log, look, metres, name
from training.reproduce.stdcl.measures import Runs, told_by
from training.reproduce.stdcl.plan import POSTERIOR, SNAPSHOT
from training.reproduce.stdcl.tables import exponent, medians, spread
from training.reproduce.verdicts import interval

Bounds = Mapping[str, Bound | None]
_BOTH = ("mds", plan.WHOLE)  # whom figures 4 and 5 compare
_FROM = 21  # the first of the paper's four UAVs


def layouts(found: Mapping[str, Teams]) -> Figure:
    """Figure 4: the last step of the first run from above, by layout. Grey: true positions,
    triangles: anchors; coloured: estimates, joined to the truth."""
    figure, grid = panels(2, len(found), (3.6 * len(found), 7.0), "Estimates by layout")
    for column, (title, there) in enumerate(found.items()):
        for row, agent in enumerate(_BOTH):
            axes = grid[row][column]
            axes.set(xlabel="x (km)", ylabel="y (km)", aspect="equal")
            if agent not in there:
                continue
            one = there[agent]
            truth, scored = one.results.worlds.truth[0, -1] / 1e3, one.scored[0, -1]
            found_at = truth + one.one.offset[0, -1] / 1e3
            _dots(axes, truth[scored], s=26, facecolors="none", edgecolors="#aaaaaa", lw=0.8)
            _dots(axes, truth[~scored], s=16, marker="^", color=MUTED)
            colour = look(agent)["color"]
            for start, end in zip(truth[scored, :2], found_at[scored, :2], strict=True):
                axes.plot(*np.transpose((start, end)), color=colour, linewidth=0.8)
            _dots(axes, found_at[scored], s=7, color=colour, zorder=3)
            axes.set_title(f"{name(agent)}, {title}: {short(one.whole)} m", fontsize=9.5)
            _frame(axes, truth[:, :2])
    return figure


def maps(there: Teams) -> Figure:
    """Figure 5: mean error by place, seen from above, over all runs and steps; and the
    distribution of all errors. Each map has its own scale."""
    figure, (grid,) = panels(1, 3, (12.5, 4.0), "Errors in random layouts")
    for axes, agent in zip(grid, _BOTH, strict=False):
        axes.set(xlabel="x (km)", ylabel="y (km)", aspect="equal", title=name(agent))
        if agent not in there:
            continue
        one = there[agent]
        place, error = one.results.worlds.truth[one.scored] / 1e3, one.error[one.scored]
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
        axes.plot(np.quantile(errors, share), 100 * share, **look(agent, i))
    axes.set(xlabel="error (m)", ylabel="errors below (%)", xscale="log", ylim=(0, 100))
    axes.set_title("distribution")
    legend(figure, [axes], 6)
    return figure


def over_time(found: Mapping[float, Teams], bounds: Mapping[float, Bounds]) -> Figure:
    """Figure 6: NRMSE over time, root mean square over runs and UAVs."""
    figure, (grid,) = panels(1, len(found), (5.6 * len(found), 4.6), "NRMSE over time", sharey=True)
    for axes, (v_max, there) in zip(grid, found.items(), strict=True):
        in_time(axes, there, bounds[v_max])
        axes.set_title(f"v_max = {v_max:g} m/s")
    grid[0].set_ylabel("NRMSE")
    metres(grid[-1], next((x.radius for x in there.values()), np.nan))
    legend(figure, grid)
    return figure


def tracks(one: Runs) -> Figure:
    """Figure 7: four UAVs of the first run at 10 m/s, each from where it starts, from above and
    from the side. Black: truth; coloured: ST-DCL."""
    scored = np.flatnonzero(one.scored[0].any(0))
    late = scored[scored >= _FROM]
    shown = (late if len(late) >= 4 else scored)[:4]
    figure, grid = panels(2, len(shown), (2.9 * len(shown), 5.6), "Estimated tracks")
    truth = one.results.worlds.truth[0]
    found = truth + one.one.offset[0]
    for column, uav in enumerate(shown):
        start = truth[0, uav]
        for row, (a, b) in enumerate(((0, 1), (2, 0))):
            axes, words = grid[row][column], "xyz"
            axes.plot(*(truth[:, uav] - start)[:, [a, b]].T, "--", color="black", linewidth=1.2)
            colour = look(plan.WHOLE)["color"]
            axes.plot(*(found[:, uav] - start)[:, [a, b]].T, color=colour, linewidth=1.0)
            axes.set(xlabel=f"{words[a]} (m)", ylabel=f"{words[b]} (m)")
            axes.set_aspect("equal", adjustable="datalim")
        grid[0][column].set_title(f"UAV {uav}")
    return figure


def radii(found: Mapping[float, Teams], bounds: Mapping[float, Bounds]) -> Figure:
    """Figure 8: NRMSE by radius of communication, with 95 % intervals over runs; errors in m are
    divided by that radius. The snapshot's bound: of the UAVs that one step's ranges localize."""
    figure, ((own, plain),) = panels(1, 2, (11.0, 4.6), "Radius of communication, v_max = 10 m/s")
    agents = dict.fromkeys(agent for there in found.values() for agent in there)
    for axes, scaled in ((own, True), (plain, False)):
        for i, agent in enumerate(agents):
            curve(
                axes,
                agent,
                i,
                {r: there[agent] for r, there in found.items() if agent in there},
                scaled,
            )
        for which, style in ((POSTERIOR, WITH_MOTION), (SNAPSHOT, OF_SNAPSHOT)):
            known = {r: b for r, each in bounds.items() if (b := each.get(which)) is not None}
            height = [told_by(b) / (r if scaled else 1.0) for r, b in known.items()]
            axes.plot(list(known), height, **style)
        axes.set(xlabel="R (m)")
        log(axes)
    own.set(ylabel="NRMSE")
    plain.set(ylabel="RMSE (m)")
    legend(figure, [own])
    return figure


def times(grown: Mapping[int, Mapping[str, Cost]], at: Mapping[str, Cost], there: Teams) -> Figure:
    """Figure 9: median time of a whole team's step on one thread, by number of UAVs (in brackets
    the exponent of its growth from N = 100 on), and the error that it buys (hollow: Huber)."""
    figure, ((growth, trade),) = panels(1, 2, (12.0, 4.6), "Time of a step")
    agents = dict.fromkeys(agent for cost in grown.values() for agent in cost)
    for i, agent in enumerate(agents):
        spent = [medians(cost, agent) for cost in grown.values()]
        style = look(agent, i)
        style["label"] += f" ({exponent(list(grown), spent):.1f})"
        growth.plot(list(grown), spent, marker="o", markersize=3.5, **style)
    growth.axhline(100, color=MUTED, linewidth=0.8, linestyle=":")
    growth.set(xlabel="UAVs", ylabel="median time (ms)", xscale="log", yscale="log")
    growth.set_xticks(list(grown), [str(n) for n in grown])
    growth.minorticks_off()
    legend(figure, [growth])
    for i, agent in enumerate(a for a in at if a in there):
        colour, dashed = look(agent, i)["color"], agent == plan.HUBER
        face = "none" if dashed else colour
        x, y = float(np.median(at[agent].ms)), there[agent].whole
        trade.plot(x, y, "o", color=colour, markerfacecolor=face, markersize=8)
    trade.set(xlabel="median time (ms)", ylabel="RMSE (m)", title="N = 200, v_max = 10 m/s")
    log_axis(trade.xaxis, trade.set_xscale)
    log_axis(trade.yaxis, trade.set_yscale)
    return figure


# ------------------------------------------------------------------ parts


def curve(axes: Axes, agent: str, index: int, found: Mapping[float, Runs], scaled: bool) -> None:
    """An agent's RMSE, or NRMSE, with 95 % intervals over a quantity."""
    if not found:
        return
    told = [interval(one.nrmse if scaled else one.rmse) for one in found.values()]
    half = np.transpose([spread(x) for x in told])
    style = look(agent, index)
    axes.errorbar(list(found), [x.mean for x in told], half, marker=".", elinewidth=0.8, **style)


def in_time(axes: Axes, there: Teams, bounds: Bounds) -> None:
    """NRMSE over time with its bounds."""
    reach = dt = float("nan")
    for i, (agent, one) in enumerate(there.items()):
        reach, dt = one.radius, one.results.dt
        axes.plot(seconds(one.per_step, dt), one.per_step / reach, **look(agent, i))
    for which, style in ((POSTERIOR, WITH_MOTION), (SNAPSHOT, OF_SNAPSHOT)):
        known = bounds.get(which)
        if known is not None and there:
            counts = (known.scored & known.mse.isfinite()).numpy()
            height = metrics.rmse_per_step(known.mse.sqrt().numpy(), counts) / reach
            axes.plot(seconds(height, dt), height, **style)
    axes.set(xlabel="time (s)")
    log(axes)


def seconds(values: Floats, dt: float) -> Floats:
    """Times of steps."""
    return dt * np.arange(len(values))


def _dots(axes: Axes, places: Floats, **style: Any) -> None:
    axes.scatter(places[:, 0], places[:, 1], **style)


def _frame(axes: Axes, places: Floats, margin: float = 0.6) -> None:
    """Limits about the truth; estimates far outside leave the picture."""
    low, high = places.min(0) - margin, places.max(0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
