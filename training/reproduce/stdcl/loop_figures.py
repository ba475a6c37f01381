"""What the learned part adds, a long run, and a link through an NLOS event (figure 14)."""

import numpy as np
from matplotlib.figure import Figure

from coloc_env.render.style import MUTED
from training.evaluation import metrics
from training.reproduce.drawing import legend, panels, seconds
from training.reproduce.measures import per_step, rmse, rmse_of_all
from training.reproduce.results import Results
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.links import LOW, Links, Loop
from training.reproduce.stdcl.plan import LINKS, LOOP, W
from training.reproduce.stdcl.style import log, spread, style_of
from training.reproduce.verdicts import interval
from training.reproduce.work import WORLD

_PARTED = (plan.WHOLE, plan.OPTIMIZER, "map", "dwmds", "vmds", WORLD)
_SHOWN = 8.0  # s before and after an event
_STEPS = ("#bdbdbd", "#E69F00", "#56B4E9", "#009E73", "#D55E00", "#CC79A7", "#332288", "#999999")


def ablation(results: Results) -> Figure | None:
    """RMSE step by step from the optimizer to the whole, with 95 % intervals over runs; all worlds
    but the first are held out of training."""
    agents = plan.ABLATION | plan.LOOPS
    variants = (W.speed(plan.MODERATE), *W.held_out().values())
    every = {variant.title: results.runs(variant.key, list(agents)) for variant in variants}
    found = {title: there for title, there in every.items() if there}
    if not found:
        return None
    figure, ((axes,),) = panels(1, 1, (11.0, 4.2), "What each part adds")
    shown = [agent for agent in agents if any(agent in there for there in found.values())]
    width = 0.84 / max(1, len(shown))
    for i, agent in enumerate(shown):
        at, errors = [], []
        for j, there in enumerate(found.values()):
            if agent in there:
                at.append(j + (i - 0.5 * (len(shown) - 1)) * width)
                errors.append(interval(rmse(there[agent])))
        half = np.transpose([spread(x) for x in errors])
        colour = _STEPS[i % len(_STEPS)]
        axes.bar(at, [x.mean for x in errors], 0.92 * width, color=colour, label=agents[agent])
        axes.errorbar(
            at, [x.mean for x in errors], half, fmt="none", ecolor="black", elinewidth=0.8
        )
    axes.set_xticks(range(len(found)), list(found), fontsize=8.5)
    axes.set_ylabel("RMSE (m)")
    tops = [rmse_of_all(there[a]) for there in found.values() for a in plan.ABLATION if a in there]
    if tops:
        axes.set_ylim(0, 1.6 * max(tops))  # what diverges leaves the picture
    axes.grid(False, axis="x")
    legend(figure, [axes], 4)
    return figure


def long_run(results: Results) -> Figure | None:
    """A run ten times as long: RMSE over time, and how far the loop moves links' confidences: the
    largest change of any link in a step, and their mean."""
    key = W.long().key
    loop: Loop | None = results.get(key, plan.WHOLE, LOOP)
    there = {agent: one for agent, one in results.runs(key).items() if agent != WORLD}
    if not there:
        return None
    figure, ((error,), (change,)) = panels(2, 1, (9.0, 5.6), "The loop over 1000 steps")
    for i, (agent, one) in enumerate(there.items()):
        style, heights = style_of(agent, i) | {"linewidth": 1.0}, per_step(one)
        error.plot(seconds(heights, one.dt), heights, **style)
    error.set(ylabel="RMSE (m)", xlabel="time (s)")
    log(error)
    error.legend(fontsize=8)
    if loop is not None:
        steps = np.arange(len(loop.change))
        change.plot(
            steps, 100 * loop.change, color="#D55E00", linewidth=0.8, label="largest change"
        )
        change.axhline(10, color=MUTED, linewidth=0.8, linestyle=":")
        change.plot(steps, 100 * loop.mean, color="#0072B2", label="mean confidence")
        change.legend(fontsize=8)
    change.set(xlabel="step", ylabel="%", ylim=(0, 105))
    return figure


def link(results: Results) -> Figure | None:
    """Figure 14: a link of S2 through an NLOS event (grey: ranges through a light building).
    (a) its true length, what was measured, and its weight as a multiple of a clean range's; (b)
    mean error of its UAVs that are no anchors."""
    found: dict[str, Links] = results.kinds(W.lighter().key, LINKS)
    own = found.get(plan.WHOLE) or found.get(plan.OPTIMIZER)
    event = None if own is None else own.event()
    if event is None:
        return None
    figure, grid = panels(2, 1, (9.0, 6.4), f"UAVs {event.i} and {event.j}", sharex=True)
    (upper,), (lower,) = grid
    first = next(iter(found.values()))
    margin = round(_SHOWN / first.dt)
    part = slice(max(0, event.first - margin), event.last + margin + 1)
    time = first.dt * np.arange(len(first.error))[part]
    upper.plot(time, first.length[part, event.i, event.j], color="black", label="true distance")
    upper.plot(
        time, first.range[part, event.i, event.j], ".", color="#D62728", markersize=3, label="range"
    )
    upper.set(ylabel="m", title="a")
    weights = upper.twinx()
    for i, (agent, one) in enumerate(found.items()):
        style = style_of(agent, i) | {"linewidth": 1.3}
        measured = np.isfinite(one.range[part, event.i, event.j])
        weight = np.where(measured, one.weight[part, event.i, event.j], np.nan)
        weights.plot(time, weight, marker=".", markersize=2, **style)
        error = one.error[part][:, [event.i, event.j]]
        lower.plot(time, np.nanmean(error, 1), **style)
    weights.axhline(LOW, color=MUTED, linewidth=0.8, linestyle=":")
    weights.set(ylabel="weight", ylim=(0, 1.6))
    weights.grid(False)
    weights.spines["right"].set_visible(True)
    for axes in (upper, lower):
        axes.axvspan(first.dt * event.first, first.dt * event.last, color=MUTED, alpha=0.15, lw=0)
    lower.set(xlabel="time (s)", ylabel="error (m)", title="b")
    legend(figure, [upper, weights], 5)
    return figure


def parting(results: Results) -> Figure | None:
    """S2: two sub-teams pass a building on both sides. RMSE of each over all runs, and the number
    of parts of the network in the first one. The first sub-team has the anchors."""
    key = W.flight("s2").key
    there = results.runs(key)
    links: Links | None = results.get(key, plan.OPTIMIZER, LINKS)
    if not there:
        return None
    figure, grid = panels(3, 1, (9.0, 7.6), "Partition and rejoining", sharex=True)
    (parts,), *teams = grid
    if links is not None:
        time = links.dt * np.arange(len(links.error))
        parts.step(time, links.components, color="black", linewidth=1.0)
        parts.set_yticks(range(1, 1 + max(2, links.components.max())))
    parts.set(ylabel="parts of the network", title="a")
    shown = [agent for agent in _PARTED if agent in there]
    for (axes,), letter, words in zip(teams, "bc", ("first", "second"), strict=True):
        for i, agent in enumerate(shown):
            one = there[agent]
            n = one.error.shape[2]
            half = slice(0, (n + 1) // 2) if words == "first" else slice((n + 1) // 2, n)
            error = metrics.rmse_per_step(one.error[:, :, half], one.scored[:, :, half])
            axes.plot(seconds(error, one.dt), error, **style_of(agent, i))
        axes.set(ylabel="RMSE (m)", title=f"{letter}  {words} sub-team")
        log(axes)
    teams[-1][0].set_xlabel("time (s)")
    legend(figure, [teams[0][0]])
    return figure


LEARNED = {"ablation.png": ablation, "loop.png": long_run}
CAMPUS = {"partition.png": parting, "figure_14_link.png": link}
