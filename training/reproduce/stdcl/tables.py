"""The report's tables, as a header and lines."""

from collections.abc import Mapping, Sequence

import numpy as np

from coloc_env.bounds import SnapshotBound
from training.evaluation import metrics
from training.evaluation.metrics import Difference
from training.evaluation.tables import short
from training.reproduce.cost import Cost
from training.reproduce.reporting import DASH, Table, difference, ends
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.flown import Flown, Teams
from training.reproduce.stdcl.links import Loop
from training.reproduce.stdcl.measures import Runs, better, told_by
from training.reproduce.stdcl.plan import POSTERIOR, SNAPSHOT, Scene
from training.reproduce.study import WORLD
from training.reproduce.verdicts import interval

PAPER_NRMSE = {plan.FAST: 0.0077, plan.MODERATE: 0.0068}
PAPER_MS = {"dwmds": 28.0, "stdcl": 36.0}  # N = 200, MATLAB, i7-12700K
PAPER_NANO_MS = {"stdcl": 45.0}  # N = 10, Jetson Nano
PAPER_FGE = {("s2", "stdcl"): 1.52, ("s2", "vmds"): 2.45, ("s2", "dwmds"): 3.01}
GROWS_FROM = 100  # UAVs: smaller swarms cost what calls cost


def averages(found: Mapping[float, Teams], flown: Flown, keys: Mapping[float, str]) -> Table:
    """Figure 6's averages: NRMSE with its interval, RMSE, and what is between it and the bounds."""
    header = ["v_max (m/s)", "agent", "NRMSE (95 %)", "paper", "RMSE (m)", "median (m)"]
    header += ["90 % (m)", "× bound with motion", "NEES", "runs lost"]
    lines = []
    for v_max, there in found.items():
        bound = flown.bound(keys[v_max], POSTERIOR)
        for which, name in ((SNAPSHOT, "CRLB of a snapshot"), (POSTERIOR, "bound with motion")):
            known = flown.bound(keys[v_max], which)
            if known is not None and there:
                reach = next(iter(there.values())).radius
                start = [f"{v_max:g}", name, number(told_by(known) / reach, "{:.6f}"), ""]
                lines.append([*start, number(told_by(known)), "", "", "", "", ""])
        for agent, one in there.items():
            paper = PAPER_NRMSE[v_max] if agent == plan.WHOLE else None
            lines.append(
                [
                    f"{v_max:g}",
                    f"`{agent}`",
                    ends(interval(one.nrmse), "{:.6f}".format),
                    "" if paper is None else f"{paper}",
                    f"{one.whole:.2f}",
                    f"{one.quantile(0.5):.2f}",
                    f"{one.quantile(0.9):.2f}",
                    number(one.ratio_to(bound)),
                    nees(one),
                    lost(one),
                ]
            )
    return header, lines


def errors(scenes: Sequence[Scene], flown: Flown) -> Table:
    """By variant and agent: RMSE, median, 90th percentile, as multiples of INS alone and of the
    bound; per variant the share that is localizable from one step's ranges."""
    header = ["variant", "agent", "RMSE (m)", "NRMSE", "median (m)", "90 % (m)"]
    header += ["of INS alone", "× bound with motion", "NEES", "runs lost"]
    lines = []
    for scene in scenes:
        there, key = flown.runs(scene.variant.key), scene.variant.key
        bound, title = flown.bound(key, POSTERIOR), described(scene, flown)
        alone = there.get(WORLD)
        for agent, one in there.items():
            lines.append(
                [
                    title,
                    f"`{agent}`",
                    ends(interval(one.rmse), "{:.2f}".format),
                    number(one.whole / one.radius, "{:.5f}"),
                    f"{one.quantile(0.5):.2f}",
                    f"{one.quantile(0.9):.2f}",
                    number(of_alone(one, alone)),
                    number(one.ratio_to(bound)),
                    nees(one),
                    lost(one),
                ]
            )
    return header, lines


def described(scene: Scene, flown: Flown) -> str:
    """A variant's title with its bounds and the share that a snapshot localizes."""
    words = [scene.variant.title]
    known = flown.bound(scene.variant.key, POSTERIOR)
    if known is not None:
        words.append(f"bound {known.rmse:.2f} m")
    snap = flown.bound(scene.variant.key, SNAPSHOT)
    if isinstance(snap, SnapshotBound):
        words.append(f"{100 * snap.share_localizable:.1f} % localizable from one step")
    return "; ".join(words)


def ablation(scenes: Sequence[Scene], flown: Flown) -> Table:
    """What each part of the network changes, paired by world, against the optimizer alone."""
    header = ["worlds", "agent", "what it has", "RMSE (m)", "better than DW-MDS alone (%)"]
    header += ["better than the line above (%)"]
    names = {plan.HUBER: "DW-MDS alone, Huber"} | plan.ABLATION | plan.LOOPS
    lines = []
    for scene in scenes:
        there = flown.runs(scene.variant.key)
        before: Runs | None = None
        for agent, words in names.items():
            if agent not in there:
                continue
            one, alone = there[agent], there.get(plan.OPTIMIZER)
            gains = [
                DASH if other is None or other is one else difference(better(one, other), 1.0, "")
                for other in (alone, before if agent in plan.ABLATION else None)
            ]
            error = ends(interval(one.rmse), "{:.2f}".format)
            lines.append([scene.variant.title, f"`{agent}`", words, error, *gains])
            before = one if agent in plan.ABLATION else before
    return header, lines


def stability(there: Teams, loop: Loop | None) -> Table:
    """A long run: whether errors or confidences drift."""
    header = ["agent", "RMSE (m)", "last 100 steps ÷ steps 10–110", "largest change of a link's"]
    header[-1] += " confidence in a step (%)"
    lines = []
    for agent, one in there.items():
        change = DASH
        if agent == plan.WHOLE and loop is not None:
            change = f"{100 * loop.change.max():.2f}"
        drift = ends(interval(one.drift()), "{:.3f}".format)
        lines.append([f"`{agent}`", f"{one.whole:.2f}", drift, change])
    return header, lines


def flights(found: Mapping[str, Teams]) -> Table:
    """Table 2: ATE and FGE per flight, against the truth and against the reference that the paper
    had."""
    header = ["flight", "agent", "FGE (m, 95 %)", "paper", "ATE (m, 95 %)", "FGE to reference (m)"]
    header += ["ATE to reference (m)", "runs lost"]
    lines = []
    for name, there in found.items():
        for agent, one in there.items():
            told = one.results.summary["agents"][agent]["diagnostics"]
            paper = PAPER_FGE.get((name, agent))
            lines.append(
                [
                    plan.FLIGHTS[name],
                    f"`{agent}`",
                    ends(interval(one.fge), "{:.2f}".format),
                    "" if paper is None else f"{paper}",
                    ends(interval(one.ate), "{:.2f}".format),
                    short(told.get("fge_reference")),
                    short(told.get("ate_reference")),
                    lost(one),
                ]
            )
    return header, lines


def recorded(scenes: Sequence[Scene], flown: Flown) -> Table:
    """Recordings: errors and what they are of dead reckoning's."""
    header = ["recording", "agent", "RMSE (m)", "median", "90 %", "ATE", "FGE", "of dead reckoning"]
    header += ["runs lost"]
    lines = []
    for scene in scenes:
        there = flown.runs(scene.variant.key)
        for agent, one in there.items():
            figures = (one.whole, one.quantile(0.5), one.quantile(0.9))
            means = (metrics.mean(one.ate), metrics.mean(one.fge))
            ratio = of_alone(one, there.get(WORLD))
            lines.append(
                [
                    scene.variant.title,
                    f"`{agent}`",
                    *(number(x, "{:.3f}") for x in (*figures, *means)),
                    number(ratio),
                    lost(one),
                ]
            )
    return header, lines


def costs(cost: Mapping[str, Cost], papers: Mapping[str, float]) -> Table:
    """Time of a whole team's step, with the paper's on another machine."""
    own = plan.WHOLE
    header = ["agent", "median (ms)", "mean (ms)", "paper (ms)", f"times `{own}`", "memory (MiB)"]
    unit = medians(cost, own)
    lines = []
    for agent, one in cost.items():
        middle, paper = float(np.median(one.ms)), papers.get(agent)
        held = (one.belief + one.working) / 2**20
        lines.append(
            [
                f"`{agent}`",
                f"{middle:.1f}",
                f"{one.ms.mean():.1f}",
                "" if paper is None else f"{paper:g}",
                number(middle / unit),
                f"{held:.1f}",
            ]
        )
    return header, lines


def growth(cost: Mapping[int, Mapping[str, Cost]]) -> Table:
    """Median time of a step by number of UAVs, and the exponent of its growth."""
    header = ["agent", *(f"N = {n} (ms)" for n in cost), f"exponent from N = {GROWS_FROM} on"]
    agents = dict.fromkeys(agent for there in cost.values() for agent in there)
    lines = []
    for agent in agents:
        times = [medians(there, agent) for there in cost.values()]
        grown = number(exponent(list(cost), times))
        lines.append([f"`{agent}`", *(number(t, "{:.1f}") for t in times), grown])
    return header, lines


def medians(cost: Mapping[str, Cost], agent: str) -> float:
    """Median time of an agent's step in ms; NaN if it was not timed."""
    return float(np.median(cost[agent].ms)) if agent in cost else float("nan")


def exponent(sizes: Sequence[int], times: Sequence[float]) -> float:
    """Slope of log time over log N, from ``GROWS_FROM`` UAVs on; NaN for fewer than two."""
    n, t = np.array(sizes, float), np.array(times)
    kept = np.isfinite(t) & (n >= GROWS_FROM)
    return float(np.polyfit(np.log(n[kept]), np.log(t[kept]), 1)[0]) if kept.sum() > 1 else np.nan


def of_alone(one: Runs, alone: Runs | None) -> float:
    """RMSE as a multiple of dead reckoning's in the same worlds."""
    if alone is None:
        return float("nan")
    count = min(len(one.error), len(alone.error))
    errors_ = (metrics.rmse(x.error[:count], x.scored[:count]) for x in (one, alone))
    return next(errors_) / next(errors_)


def nees(one: Runs) -> str:
    """Mean NEES of the position; 3 in space, 2 in the plane, is consistent."""
    return short(metrics.mean(one.one.nees[one.scored]))


def lost(one: Runs) -> str:
    """Runs that ended lost or not finite."""
    return f"{int(one.results.diverged(one.agent).sum())} of {one.results.runs}"


def number(value: float, form: str = "{:.2f}") -> str:
    """A number, or a dash."""
    return form.format(value) if np.isfinite(value) else DASH


def spread(x: Difference) -> tuple[float, float]:
    """How far an interval reaches below and above its mean; 0 where it is infinite."""
    reach = (x.mean - x.low, x.high - x.mean)
    return reach if np.isfinite(reach).all() else (0.0, 0.0)
