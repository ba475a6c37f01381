"""The tables: errors beside bounds, what each part adds, campus and recordings, times."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from coloc_env.bounds import SnapshotBound
from training.evaluation import metrics
from training.evaluation.tables import short
from training.reproduce.cost import COST, Cost
from training.reproduce.measures import quantile, rmse, rmse_of_all, rmse_of_bound
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.links import Loop
from training.reproduce.stdcl.measures import (
    ate,
    better,
    drift,
    fge,
    nrmse,
    nrmse_of_all,
    radius,
    ratio_to,
    ratio_to_alone,
)
from training.reproduce.stdcl.plan import LOOP, W
from training.reproduce.tables import (
    DASH,
    Table,
    by_agent,
    lost,
    nees,
    number,
    numbered,
    signed,
    with_ends,
)
from training.reproduce.work import POSTERIOR, SNAPSHOT, WORLD, Variant

PAPER_NRMSE = {plan.FAST: 0.0077, plan.MODERATE: 0.0068}
PAPER_MS = {"dwmds": 28.0, plan.PAPERS_LOOP: 36.0}  # N = 200, MATLAB, i7-12700K
PAPER_NANO_MS = {plan.PAPERS_LOOP: 45.0}  # N = 10, Jetson Nano
PAPER_FGE = {("s2", plan.PAPERS_LOOP): 1.52, ("s2", "vmds"): 2.45, ("s2", "dwmds"): 3.01}
GROWS_FROM = 100  # UAVs: smaller swarms cost what calls cost


def paper_text(settings: Settings) -> list[str]:
    """What is to be known of the simulations."""
    some = settings.fraction(10)
    return [f"`swarm-v0`; {settings.runs} runs of the main table, {some} of the others."]


def stress_text(settings: Settings) -> list[str]:
    """What is to be known of the cases under stress."""
    runs = settings.fraction(10)
    return [f"v_max 50 m/s, {runs} runs; INS without bias unless one is given."]


def learned_text(settings: Settings) -> list[str]:
    """What is to be known of the learned part."""
    return [f"INS bias 0.3 m/s, 15 % NLOS, {settings.fraction(10)} runs."]


def campus_text(settings: Settings) -> list[str]:
    """What is to be known of the campus."""
    return ["The paper's Jetson Nano (45 ms for ST-DCL) is not at hand; this machine's is below."]


def real_text(settings: Settings) -> list[str]:
    """What is to be known of the recordings."""
    return ["Runs differ in what is drawn at their start."]


def paper(results: Results) -> Iterator[Table]:
    """Figure 6's averages, other worlds, times."""
    yield _averages(results)
    others = [*(W.layout(x) for x in ("u", "o")), *(W.radius(x) for x in plan.RADII)]
    yield _errors("Layouts and radii", others, results)
    at = results.kinds(W.timed(200).key, COST)
    caption = "Whole team, one thread, all methods step by step in turn."
    yield _costs("Time of a step, N = 200", at, PAPER_MS, caption)
    yield _growth({n: results.kinds(W.timed(n).key, COST) for n in plan.GROWTH})


def stress(results: Results) -> Iterator[Table]:
    """Every case."""
    yield _errors("Every case", plan.stressed(W), results)


def learned(results: Results) -> Iterator[Table]:
    """What the network adds, and whether the loop is stable."""
    yield _ablation((W.speed(plan.MODERATE), *W.held_out().values()), results)
    yield _papers(results)
    yield _stability(results)


def _averages(results: Results) -> Table:
    """NRMSE with its interval, RMSE, and what is between it and the bounds."""
    header = ["v_max (m/s)", "agent", "NRMSE (95 %)", "paper", "RMSE (m)", "median (m)"]
    header += ["90 % (m)", "× bound with motion", "NEES", "runs lost"]
    rows = []
    for v_max in (plan.FAST, plan.MODERATE):
        key = W.speed(v_max).key
        there, bound = results.runs(key), results.get(key, "", POSTERIOR)
        for kind, name in ((SNAPSHOT, "CRLB of a snapshot"), (POSTERIOR, "bound with motion")):
            known = results.get(key, "", kind)
            if known is not None and there:
                allowed = rmse_of_bound(known)
                reach = radius(next(iter(there.values())))
                start = [f"{v_max:g}", name, number(allowed / reach, "{:.6f}"), ""]
                rows.append([*start, number(allowed), "", "", "", "", ""])
        for agent, one in there.items():
            printed = PAPER_NRMSE[v_max] if agent == plan.PAPERS_LOOP else ""
            start = [f"{v_max:g}", f"`{agent}`", with_ends(nrmse, "{:.6f}")(one), f"{printed}"]
            figures = (rmse_of_all(one), quantile(0.5)(one), quantile(0.9)(one))
            cells = [*map(number, (*figures, ratio_to(one, bound))), nees(one), lost(one)]
            rows.append([*start, *cells])
    return Table("Average NRMSE (figure 6)", header, rows, 2)


def _errors(title: str, variants: Iterable[Variant], results: Results) -> Table:
    """RMSE, median, 90th percentile, as multiples of INS alone and of the bound; per variant the
    share that is localizable from one step's ranges."""
    header = ["variant", "agent", "RMSE (m)", "NRMSE", "median (m)", "90 % (m)"]
    header += ["of INS alone", "× bound with motion", "NEES", "runs lost"]
    rows = []
    for variant in variants:
        there = results.runs(variant.key)
        bound, words = results.get(variant.key, "", POSTERIOR), described(variant, results)
        for agent, one in there.items():
            cells = [
                with_ends(rmse, "{:.2f}")(one),
                number(nrmse_of_all(one), "{:.5f}"),
                number(quantile(0.5)(one)),
                number(quantile(0.9)(one)),
                number(ratio_to_alone(one, there.get(WORLD))),
                number(ratio_to(one, bound)),
            ]
            rows.append([words, f"`{agent}`", *cells, nees(one), lost(one)])
    return Table(title, header, rows, 2)


def described(variant: Variant, results: Results) -> str:
    """A variant's title with its bounds and the share that a snapshot localizes."""
    words, known = [variant.title], results.get(variant.key, "", POSTERIOR)
    if known is not None:
        words.append(f"bound {known.rmse:.2f} m")
    snapshot = results.get(variant.key, "", SNAPSHOT)
    if isinstance(snapshot, SnapshotBound):
        words.append(f"{100 * snapshot.share_localizable:.1f} % localizable from one step")
    return "; ".join(words)


def _ablation(variants: Iterable[Variant], results: Results) -> Table:
    """What each part of the network changes, paired by world, against the optimizer alone."""
    header = ["worlds", "agent", "what it has", "RMSE (m)", "better than DW-MDS alone (%)"]
    header += ["better than the line above (%)"]
    names = {plan.HUBER: "DW-MDS alone, Huber"} | plan.ABLATION | plan.LOOPS
    rows = []
    for variant in variants:
        there = results.runs(variant.key, list(names))
        before: Runs | None = None
        for agent, one in there.items():
            alone = there.get(plan.OPTIMIZER)
            gains = [
                DASH if other in (None, one) else signed(better(one, other), "")
                for other in (alone, before if agent in plan.ABLATION else None)
            ]
            error = with_ends(rmse, "{:.2f}")(one)
            rows.append([variant.title, f"`{agent}`", names[agent], error, *gains])
            before = one if agent in plan.ABLATION else before
    return Table("Step by step", header, rows, 3)


def _papers(results: Results) -> Table:
    """The paper's own loop, part by part, against its optimizer alone."""
    rows = []
    for variant in (W.speed(plan.MODERATE), W.lasting(0.15), W.lasting(0.5)):
        there = results.runs(variant.key, list(plan.PAPERS))
        alone = there.get(plan.PAPERS_OPTIMIZER)
        for agent, one in there.items():
            gain = DASH if alone in (None, one) else signed(better(one, alone), "")
            cells = [plan.PAPERS[agent], with_ends(rmse, "{:.2f}")(one), gain, nees(one)]
            rows.append([variant.title, f"`{agent}`", *cells])
    header = ["worlds", "agent", "what it has", "RMSE (m)", "better than its optimizer (%)", "NEES"]
    return Table("The paper's loop as printed", header, rows, 3)


def _stability(results: Results) -> Table:
    """A long run: whether errors or confidences drift."""
    header = ["agent", "RMSE (m)", "last 100 steps ÷ steps 10–110"]
    header += ["largest change of a link's confidence in a step (%)"]
    key, rows = W.long().key, []
    for agent, one in results.runs(key).items():
        if agent != WORLD:  # which drifts
            loop: Loop | None = results.get(key, agent, LOOP)
            change = DASH if loop is None else f"{100 * loop.change.max():.2f}"
            cells = [f"{rmse_of_all(one):.2f}", with_ends(drift)(one), change]
            rows.append([f"`{agent}`", *cells])
    return Table(f"{plan.LONG} steps", header, rows)


def campus(results: Results) -> Iterator[Table]:
    """Table 2: ATE and FGE per flight, against the truth and against the reference that the paper
    had; table 1: times."""
    header = ["flight", "agent", "FGE (m, 95 %)", "paper", "ATE (m, 95 %)", "FGE to reference (m)"]
    header += ["ATE to reference (m)", "runs lost"]
    rows = []
    for name, title in plan.FLIGHTS.items():
        for agent, one in results.runs(W.flight(name).key).items():
            printed = PAPER_FGE.get((name, agent), "")
            found = one.summary["diagnostics"]
            cells = [with_ends(fge, "{:.2f}")(one), f"{printed}", with_ends(ate, "{:.2f}")(one)]
            cells += [short(found.get("fge_reference")), short(found.get("ate_reference"))]
            rows.append([title, f"`{agent}`", *cells, lost(one)])
    yield Table("Table 2: formation geometry and trajectories", header, rows, 2)
    at = results.kinds(W.timed_flight().key, COST)
    yield _costs("Table 1: time of a step, ten UAVs", at, PAPER_NANO_MS)


def real(results: Results) -> Iterator[Table]:
    """Recordings: errors and what they are of dead reckoning's."""
    places = {v.title: results.runs(v.key) for v in W.recordings()}
    alone = {id(one): there.get(WORLD) for there in places.values() for one in there.values()}
    columns = [
        ("RMSE (m)", numbered(rmse_of_all, "{:.3f}")),
        ("median", numbered(quantile(0.5), "{:.3f}")),
        ("90 %", numbered(quantile(0.9), "{:.3f}")),
        ("ATE", numbered(lambda one: metrics.mean(ate(one)), "{:.3f}")),
        ("FGE", numbered(lambda one: metrics.mean(fge(one)), "{:.3f}")),
        ("of dead reckoning", numbered(lambda one: ratio_to_alone(one, alone[id(one)]))),
        ("runs lost", lost),
    ]
    yield by_agent("Every method", places, columns, where="recording")


def _costs(
    title: str, costs: Mapping[str, Cost], papers: Mapping[str, float], caption: str = ""
) -> Table:
    """Time of a whole team's step, with the paper's on another machine."""
    own = plan.WHOLE
    header = ["agent", "median (ms)", "mean (ms)", "paper (ms)", f"times `{own}`", "memory (MiB)"]
    unit, rows = median(costs, own), []
    for agent, one in costs.items():
        printed = f"{papers[agent]:g}" if agent in papers else ""
        cells = [f"{one.median:.1f}", f"{one.ms.mean():.1f}", printed]
        rows.append([f"`{agent}`", *cells, number(one.median / unit), f"{one.held / 2**20:.1f}"])
    return Table(title, header, rows, 1, caption)


def _growth(costs: Mapping[int, Mapping[str, Cost]]) -> Table:
    """Median time of a step by number of UAVs, and the exponent of its growth."""
    costs = {n: there for n, there in costs.items() if there}
    header = ["agent", *(f"N = {n} (ms)" for n in costs), f"exponent from N = {GROWS_FROM} on"]
    rows = []
    for agent in dict.fromkeys(agent for there in costs.values() for agent in there):
        times = [median(there, agent) for there in costs.values()]
        cells = [*(number(t, "{:.1f}") for t in times), number(exponent(list(costs), times))]
        rows.append([f"`{agent}`", *cells])
    return Table("Growth", header, rows)


def median(costs: Mapping[str, Cost], agent: str) -> float:
    """Median time of an agent's step in ms; NaN if it was not timed."""
    return costs[agent].median if agent in costs else float("nan")


def exponent(sizes: Sequence[int], times: Sequence[float]) -> float:
    """Slope of log time over log N, from ``GROWS_FROM`` UAVs on; NaN for fewer than two."""
    n, t = np.array(sizes, float), np.array(times)
    kept = np.isfinite(t) & (n >= GROWS_FROM)
    return float(np.polyfit(np.log(n[kept]), np.log(t[kept]), 1)[0]) if kept.sum() > 1 else np.nan
