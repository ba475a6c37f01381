"""The study of robustness: every agent in every variant, paired, and what ours were to reach."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coloc_env.render.style import FLOOR, INK, MUTED, uav_colours
from training.evaluation import metrics
from training.evaluation.metrics import Difference
from training.evaluation.tables import short
from training.reproduce.drawing import headline
from training.reproduce.measures import rmse
from training.reproduce.pfnn.bank import gain_table
from training.reproduce.pfnn.plan import robust_agents, variants
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.tables import DASH, Table
from training.reproduce.verdicts import Goal, exactly
from training.reproduce.work import Variant

REFERENCES = ("apf", "ekf:robust=huber")  # paired differences are taken to these
_HUBER, _GATE = "ekf:robust=huber", "ekf:robust=gate"
_HARD = ("few-nlos", "few-nlos-false", "hard")
_MATRICES = {
    "rmse": "RMSE over the whole run (m)",
    "rmse_after_10s": "RMSE after 10 s (m)",
    "median": "Median error (m)",
    "nees": "NEES (ideal: 3; 2 in the plane)",
    "lost_uavs": "Lost UAVs, of all UAVs of all runs",
}
Compared = Callable[[Runs, Runs], Difference]
_WORST = 30.0  # × the bound: what lies beyond has the same colour
_SHOWN = ("apf", "pf_trust", "ekf_trust", _GATE, "ekf_joint")
_SHADES = LinearSegmentedColormap.from_list("shades", (FLOOR, "#9ecae9", "#0072B2", "#0b1f3a"))
_WIDEST = 100.0  # %: differences beyond are drawn at the edge


# ------------------------------------------------------------------ goals


def goals(settings: Settings) -> Iterator[Goal]:
    """All of them, for every agent of a goal's name whatever its options (several trainings of one
    learned part are several agents)."""
    titles = {variant.key: variant.title for variant in variants()}
    agents = robust_agents(settings)

    def named(name: str) -> list[str]:
        return [agent for agent in agents if agent.split(":")[0] == name] or [name]

    def most(
        name: str, where: str, figure: str, words: str, limit: float, unit: str
    ) -> Iterator[Goal]:
        for agent in named(name):
            yield Goal(f"`{agent}`, {titles[where]}: {words}", unit, limit, False,
                       ((where, agent),), _figure(figure))  # fmt: skip

    def against(name: str, where: str, other: str, words: str, limit: float, unit: str,
                of: Compared, by: Any = "mean") -> Iterator[Goal]:  # fmt: skip
        for agent in named(name):
            yield Goal(f"`{agent}`, {titles[where]}: {words} `{other}`", unit, limit, False,
                       ((where, agent), (where, other)), of, by)  # fmt: skip

    for name in ("apf", "pfnn"):
        yield from most(name, "default", "rmse_after_10s", "steady RMSE", 0.036, "m")
        yield from most(name, "default", "diverged_runs", "no run lost", 0, "runs")
    better, worse = "RMSE below that, interval and all, of", "RMSE not worse than that of"
    ratio, typical = "RMSE as a multiple of that of", "typical ratio, interval and all, to"
    yield from against("pfnn", "default", "apf", worse, 0, "mm", _apart, "not worse")
    for where in ("default", "uniform"):
        yield from against("pf_trust", where, "apf", ratio, 1.05, "", _ratio)
    yield from against("pf_trust", "nlos", "apf", ratio, 0.55, "", _ratio)
    yield from most("pf_trust", "nlos", "rmse_after_10s", "steady RMSE", 0.040, "m")
    yield from most("pf_trust", "false", "rmse", "RMSE", 0.045, "m")
    yield from against("pf_trust", "false", _HUBER, better, 0, "mm", _apart, "interval")
    for where in _HARD:
        yield from against("pf_trust", where, _HUBER, ratio, 0.85, "", _ratio)
        yield from against("pf_trust", where, _HUBER, typical, 0.85, "", _typical, "interval")
        yield from against("pf_trust", where, _HUBER, better, 0, "mm", _apart, "interval")
    for where in _HARD[:2]:
        yield from against("pf_trust", where, _GATE, worse, 0, "mm", _apart, "not worse")
    yield from most("pf_trust", "hard", "nees", "NEES", 4.0, "")
    for where in ("default", "uniform", "nlos", "false", *_HARD):
        yield from most("pf_trust", where, "diverged_runs", "no run lost", 0, "runs")


def _figure(key: str) -> Callable[[Runs], Difference]:
    """A figure of the evaluation's summary."""
    return lambda one: exactly(np.nan if one.summary[key] is None else float(one.summary[key]))


def _ratio(one: Runs, other: Runs) -> Difference:
    """Of the RMSEs over all runs."""
    return exactly(one.summary["rmse"] / other.summary["rmse"])


def _apart(one: Runs, other: Runs) -> Difference:
    """RMSE minus the other's in the same worlds, mm."""
    found = metrics.paired_difference(rmse(one), rmse(other))
    return Difference(1e3 * found.mean, 1e3 * found.low, 1e3 * found.high)


def _typical(one: Runs, other: Runs) -> Difference:
    """Geometric mean of the runs' ratios, which two lost worlds out of twenty do not decide."""
    logs = metrics.paired_difference(np.log(rmse(one)), np.log(rmse(other)))
    return Difference(*(float(np.exp(x)) for x in (logs.mean, logs.low, logs.high)))


# ------------------------------------------------------------------ tables


def tables(results: Results) -> Iterator[Table]:
    """One figure each: variants down, agents across, the best of a line bold; then everything."""
    agents = robust_agents(results.settings)
    places = [variant for variant in variants() if results.runs(variant.key)]
    for key, title in _MATRICES.items():
        bounded = key == "rmse"
        header = ["variant", *(["bound"] if bounded else []), *(f"`{a}`" for a in agents)]
        rows = []
        for variant in places:
            there = results.runs(variant.key, agents)
            values = {agent: _value(one, key) for agent, one in there.items()}
            known = [value for value in values.values() if value is not None]
            best = min(known) if known and key not in ("nees", "lost_uavs") else None
            bound = [short(_bound(results, variant))] if bounded else []
            cells = [_bold(values.get(agent), best) for agent in agents]
            rows.append([variant.title, *bound, *cells])
        yield Table(title, header, rows)
    gains = gain_table(results)
    if gains is not None:
        yield gains
    header = ["variant", "agent", "runs", "bound", "RMSE (m)", "± runs", "after 10 s", "mean"]
    header += ["median", "max", "NEES", "particles", "lost UAVs", "diverged runs", "× bound"]
    header += [f"minus `{x}` (95 %)" for x in REFERENCES]
    rows = []
    for variant in places:
        there = results.runs(variant.key, agents)
        for agent, one in there.items():
            rows.append([variant.title, f"`{agent}`", str(len(one.error))])
            rows[-1] += [short(_bound(results, variant)), *_figures(one)]
            rows[-1] += [_minus(one, there.get(other)) for other in REFERENCES]
    yield Table("All figures, with paired differences", header, rows, 2, long=True)


def _figures(one: Runs) -> list[str]:
    keys = ("rmse", "rmse_std", "rmse_after_10s", "mean", "median", "max", "nees", "avg_particles")
    cells = [short(_value(one, x)) for x in (*keys, "lost_uavs", "diverged_runs", "ratio_to_bound")]
    if one.record.messages:
        cells[-2] += f" ({len(one.record.messages)} raised)"
    return cells


def _minus(one: Runs, other: Runs | None) -> str:
    if other is None or other.agent == one.agent:
        return DASH
    found = metrics.paired_difference(rmse(one), rmse(other))
    values = (found.mean, found.low, found.high)
    mean, low, high = (f"{v:+.2g}".replace("-", "−").replace("inf", "∞") for v in values)
    return f"{mean} ({low} to {high})"


def _value(one: Runs, key: str) -> Any:
    """A figure of the evaluation's summary, or the number of UAVs that end lost."""
    if key != "lost_uavs":
        return one.summary[key]
    limit = one.evaluation.lost_beyond
    return int(metrics.lost(one.error, one.scored, one.dt, limit).sum())


def _bound(results: Results, variant: Variant) -> float | None:
    for one in results.runs(variant.key).values():
        return None if one.evaluation.bound is None else one.evaluation.bound.rmse
    return None


def _bold(value: float | None, best: float | None) -> str:
    text = short(value)
    return f"**{text}**" if value is not None and value == best else text


# ------------------------------------------------------------------ figures


def heat_map(results: Results) -> Figure | None:
    """RMSE over whole runs as a multiple of the posterior bound (of the best agent's where there is
    no bound: ‡). †: UAVs lost, of all runs'."""
    agents = robust_agents(results.settings)
    places = [v for v in variants() if results.runs(v.key, agents)]
    if not places:
        return None
    ratio = np.full((len(places), len(agents)), np.nan)
    labels = []
    for i, variant in enumerate(places):
        there, bound = results.runs(variant.key, agents), _bound(results, variant)
        errors = {agent: one.summary["rmse"] for agent, one in there.items()}
        known = [value for value in errors.values() if value is not None]
        unit = bound or (min(known) if known else np.nan)
        labels.append(variant.title if bound else f"{variant.title} ‡")
        for j, agent in enumerate(agents):
            if errors.get(agent) is not None:
                ratio[i, j] = errors[agent] / unit
    figure = Figure((2.6 + 0.78 * len(agents), 1.6 + 0.3 * len(places)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    image = axes.imshow(ratio, aspect="auto", cmap=_SHADES, norm=LogNorm(1.0, _WORST))
    for (i, j), value in np.ndenumerate(ratio):
        text, colour = DASH, MUTED
        if np.isfinite(value):
            lost = _value(results[places[i].key, agents[j]], "lost_uavs")
            text = (f"{value:.2f}" if value < 10 else short(value)) + (f" †{lost}" * (lost > 0))
            colour = "white" if value > 0.8 * np.sqrt(_WORST) else INK
        axes.text(j, i, text, ha="center", va="center", fontsize=7.5, color=colour)
    axes.set_yticks(range(len(labels)), labels, fontsize=8.5)
    axes.set_xticks(range(len(agents)), agents, fontsize=8.5, rotation=35, ha="left")
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
    axes.set_xticks(np.arange(0.5, len(agents) - 1), minor=True)
    axes.set_yticks(np.arange(0.5, len(labels) - 1), minor=True)
    axes.grid(True, which="minor", color="white", linewidth=1.5)
    axes.tick_params(which="minor", length=0)
    bar = figure.colorbar(image, ax=axes, shrink=0.5, aspect=30, pad=0.02, extend="max")
    ticks = [1, 2, 5, 10, 20]
    bar.set_ticks(ticks, labels=[f"{tick} ×" for tick in ticks])
    bar.ax.minorticks_off()
    bar.set_label("RMSE ÷ bound")
    headline(figure, "RMSE over whole runs ÷ posterior bound")
    return figure


def forest(results: Results) -> Figure | None:
    """RMSE against `ekf:robust=huber` on the same worlds, with 95 % intervals of the paired
    differences; left is better; beyond ±100 % an arrow."""
    agents = robust_agents(results.settings)
    shown = [agent for agent in _SHOWN if agent in agents]
    shown += [agent for agent in agents if agent.startswith("pf_trust:")]
    places = [v for v in variants() if len(there := results.runs(v.key, agents)) > 1
              and _HUBER in there]  # fmt: skip
    if not places or not shown:
        return None
    figure = Figure(figsize=(7.5, 1.6 + 0.36 * len(places)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.axvline(0, color=INK, linewidth=1.0)
    for i in range(0, len(places), 2):
        axes.axhspan(i - 0.5, i + 0.5, color=FLOOR, zorder=0)
    handles = []
    for j, (agent, colour) in enumerate(zip(shown, uav_colours(len(shown)).tolist(), strict=True)):
        handles.append(Line2D([], [], color=colour, marker="o", lw=2, ms=4, label=agent))
        for i, variant in enumerate(places):
            one, other = results.get(variant.key, agent), results[variant.key, _HUBER]
            if one is None:
                continue
            apart, scale = _apart(one, other), 0.1 / metrics.mean(rmse(other))  # of mm in %
            y = i + 0.7 * ((j + 0.5) / len(shown) - 0.5)
            ends = np.clip([scale * apart.low, scale * apart.high], -_WIDEST, _WIDEST)
            if np.isfinite(apart.low):
                axes.plot(ends, [y, y], color=colour, linewidth=1.6)
            middle = scale * apart.mean
            mark = "o" if abs(middle) <= _WIDEST else "<" if middle < 0 else ">"
            at = float(np.clip(middle, -_WIDEST, _WIDEST))
            axes.plot(at, y, mark, color=colour, markersize=4, clip_on=False)
    axes.set_yticks(range(len(places)), [variant.title for variant in places], fontsize=8.5)
    axes.set(xlim=(-_WIDEST, _WIDEST), ylim=(len(places) - 0.5, -0.5))
    axes.set_xlabel(f"RMSE against {_HUBER} (%)")
    axes.grid(False, axis="y")
    axes.set_title(f"Paired with {_HUBER} on the same worlds")
    figure.legend(handles=handles, loc="outside lower center", ncols=min(4, len(handles)))
    return figure


FIGURES = {"robustness.png": heat_map, "robustness_paired.png": forest}
