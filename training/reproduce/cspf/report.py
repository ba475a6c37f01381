"""Tables, and the paper's figure 4 over many runs; convergence against the share of outliers."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from training.evaluation.metrics import rmse_per_run
from training.reproduce.cspf import plan
from training.reproduce.cspf.plan import converged, converged_over_time, late, late_nees, worst
from training.reproduce.drawing import panels
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.tables import Table, by_agent, shortened
from training.reproduce.verdicts import share
from training.reproduce.work import WORLD

_COLOURS = ("#D55E00", "#E69F00", "#CC79A7", "#0072B2", "#009E73", "#56B4E9", "#332288", "#999999")
_Places = Mapping[str, Mapping[str, Runs]]


def text(settings: Settings) -> list[str]:
    """What is to be known of the tables."""
    return [
        f"Three UAVs, {settings.runs} runs. *Converged*: every holder's pose of every UAV, "
        "relative to UAV 0, is within 0.3 m and 10°. *Worst error*: the largest over holders and "
        f"UAVs, after {plan.EARLY} steps. Pose graphs are solved at every 50th step; their time is "
        "that of a step without a solution."
    ]


def paper_tables(results: Results) -> Iterator[Table]:
    """The paper's share of outliers, and the others."""
    published = [plan.world(dim, outliers=plan.PUBLISHED).key for dim in plan.DIMS]
    agents = (*plan.METHODS, *plan.BESIDE, *plan.LITERAL)
    yield _table("A fifth of outliers", _places(results, published, agents))
    keys = [plan.world(dim, outliers=x).key for dim in plan.DIMS for x in plan.SHARES]
    yield _table("None to half", _places(results, keys, plan.METHODS))


def beyond_tables(results: Results) -> Iterator[Table]:
    """Particles, teams, hard worlds."""
    agents = (*(f"cspf:particles={m}" for m in plan.PARTICLES), *plan.ACROSS)
    yield _table("Particles, and eq. 16", _places(results, [plan.CLOUDS], agents))
    teams, hard = ([v.key for v in some] for some in (plan.teams(None), plan.hard(None)))
    yield _table("Larger teams", _places(results, teams, plan.METHODS))
    yield _table("Moving in space", _places(results, [plan.moving(None).key], plan.METHODS))
    methods = (*plan.METHODS, *plan.CENTRAL)
    yield _table("Where many modes persist", _places(results, hard, methods))


def real_tables(results: Results) -> Iterator[Table]:
    """Errors on recordings."""
    keys = [plan.murp(trial, x).key for trial in plan.TRIALS for x in plan.WRONG]
    team = _places(results, keys, (WORLD, *plan.TEAM))
    keys = [plan.flights(x).key for x in plan.WRONG]
    inertial = _places(results, keys, (WORLD, *plan.INERTIAL))
    keys = [plan.euroc(name, x).key for name in plan.SEQUENCES for x in plan.MISTAKEN]
    columns = [
        ("runs", lambda one: str(len(one.error))),
        ("RMSE (m)", shortened(lambda x: np.mean(rmse_per_run(x.error, x.scored)))),
        ("last third (m)", shortened(lambda x: np.mean(late(x)))),
        ("worst run's (m)", shortened(lambda x: np.max(late(x)))),
        ("converged at the end (%)", _converged_at_end),
        ("NEES", shortened(late_nees)),
        ("ms a step", _cost),
    ]
    places = team | inertial | _places(results, keys, (WORLD, *plan.ALONE))
    yield by_agent("Errors", places, columns, where="recording")


def _places(
    results: Results, keys: list[str], agents: tuple[str, ...]
) -> dict[str, dict[str, Runs]]:
    found = {key: results.runs(key, agents) for key in keys}
    return {results.variant(key).title: there for key, there in found.items() if there}


def _table(title: str, places: _Places) -> Table:
    """Share converged, worst error, NEES, time of a step."""
    columns = [
        ("runs", lambda one: str(len(one.error))),
        (f"converged at {plan.EARLY} (%)", lambda one: _share(one, plan.EARLY)),
        (f"at {plan.LATE} (%)", lambda one: _share(one, plan.LATE)),
        ("worst error, median (m)", shortened(lambda x: np.median(worst(x, plan.EARLY)))),
        (
            "90 % of runs (m)",
            shortened(lambda x: np.quantile(worst(x, plan.EARLY), 0.9, method="higher")),
        ),
        ("NEES", shortened(late_nees)),
        ("ms a step", _cost),
    ]
    return by_agent(title, places, columns, where="world")


def _share(one: Runs, steps: int) -> str:
    """Per cent of the runs with the exact interval; nothing where runs were cut before."""
    if one.steps < steps:
        return ""
    found = share(converged(one, steps))
    return f"{found.mean:.0f} ({found.low:.0f} to {found.high:.0f})"


def _converged_at_end(one: Runs) -> str:
    known = "converged" in one.record.series
    return f"{100 * converged(one, one.steps).mean():.0f}" if known else ""


def _cost(one: Runs) -> str:
    cost = one.record.ms_per_step
    return "" if cost is None else f"{cost:.2f}"


# ------------------------------------------------------------------ figures


def over_time(results: Results) -> Figure | None:
    """Share of the runs in which every holder's pose of every UAV is within 0.3 m and 10°, over
    steps, at the paper's share of outliers (its figure 4 shows one run)."""
    keys = [plan.world(dim, outliers=plan.PUBLISHED).key for dim in plan.DIMS]
    places = _places(results, keys, plan.METHODS)
    if not places:
        return None
    size = (4.8 * len(places), 3.4)
    figure, (row,) = panels(1, len(places), size, "Convergence, a fifth of all matches wrong")
    for axes, (title, there) in zip(row, places.items(), strict=True):
        for i, (agent, one) in enumerate(there.items()):
            axes.plot(100 * converged_over_time(one), linewidth=1.4, **_style(agent, i))
        axes.set(xlabel="step", ylabel="runs converged (%)", ylim=(-3, 103), title=title)
    row[0].legend(fontsize=7, loc="center right")
    return figure


def over_shares(results: Results) -> Figure | None:
    """Above: share of the runs converged after 150 steps, with exact 95 % intervals; below: median
    of the worst error over holders and UAVs; against the share of wrong matches."""
    found = {
        dim: {x: results.runs(plan.world(dim, outliers=x).key, plan.METHODS) for x in plan.SHARES}
        for dim in plan.DIMS
    }
    dims = [dim for dim, there in found.items() if any(there.values())]
    if not dims:
        return None
    figure, rows = panels(2, len(dims), (4.8 * len(dims), 6.0), "How many wrong matches it takes")
    for upper, lower, dim in zip(*rows, dims, strict=True):
        for i, agent in enumerate(plan.METHODS):
            have = {x: there[agent] for x, there in found[dim].items() if agent in there}
            if not have:
                continue
            hits = [share(converged(one, plan.EARLY)) for one in have.values()]
            reach = np.array([(h.mean - h.low, h.high - h.mean) for h in hits]).T
            errors = [float(np.median(worst(one, plan.EARLY))) for one in have.values()]
            at, style = np.array(list(have)) + 0.003 * (i - 2), _style(agent, i)
            upper.errorbar(at, [h.mean for h in hits], reach, marker="o", markersize=3, **style)
            lower.plot(at, errors, marker="o", markersize=3, **style)
        upper.set(ylabel="runs converged (%)", ylim=(-3, 103), title=f"{dim}-D")
        lower.set(ylabel="worst error (m)", xlabel="share of outliers", yscale="log")
    rows[0][0].legend(fontsize=7, loc="lower left")
    return figure


def _style(agent: str, index: int) -> dict[str, Any]:
    return {"label": plan.NAMES.get(agent, agent), "color": _COLOURS[index % len(_COLOURS)]}


FIGURES = {"convergence.png": over_time, "outliers.png": over_shares}
