"""The report: verdicts, tables and figures with the paper's numbers beside ours."""

import platform
from collections.abc import Callable
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from training.reproduce import drawing, reporting, verdicts
from training.reproduce.reporting import Text, section
from training.reproduce.stdcl import figures, goals, loop_figures, plan, stress_figures, tables
from training.reproduce.stdcl.claims import verdicts as judge
from training.reproduce.stdcl.flown import Flown, Teams
from training.reproduce.stdcl.plan import METHODS, OPTIMIZER, REFERENCES, WHOLE, Plan
from training.reproduce.study import BOUNDS, WORLD

FILES = (
    "figure_4_layouts.png",
    "figure_5_errors.png",
    "figure_6_nrmse.png",
    "figure_7_tracks.png",
    "figure_8_radius.png",
    "figure_9_time.png",
    "figure_10_nlos.png",
    "figure_11_connectivity.png",
    "confidence.png",
    "ablation.png",
    "loop.png",
    "partition.png",
    "figure_14_link.png",
    "stdcl.json",
)
SHOWN = (*METHODS, *REFERENCES, WORLD)
Drawings = dict[str, Callable[[], Figure]]


def claims_part(flown: Flown, the: Plan, parts: tuple[str, ...], folder: Path) -> Text:
    """What holds; and ``stdcl.json``."""
    judged, met = judge(flown, the, parts), goals.outcomes(flown, the)
    text = ["## The paper's claims", "", verdicts.RULE, "", reporting.counts(judged), ""]
    text += [*reporting.claims(judged), "", "## Our goals", "", goals.RULE, ""]
    text += section("What was to be reached", goals.lines(met), 3)
    content = {
        "runs": the.runs,
        "claims": [reporting.as_json(each) for each in judged],
        "goals": [
            {
                "goal": x.goal.words,
                "unit": x.goal.unit,
                "limit": x.goal.limit,
                "ours": None if x.found is None else x.found.mean,
                "verdict": x.verdict,
            }
            for x in met
        ],
        "rmse": {
            key: {agent: one.whole for agent, one in flown.runs(key).items()}
            for key in flown.scenes
        },
        "bounds": {
            key: {which: known.rmse for which in BOUNDS if (known := flown.bound(key, which))}
            for key in flown.scenes
        },
    }
    reporting.write_json(folder / FILES[-1], content)
    return text


def paper_part(flown: Flown, the: Plan, folder: Path) -> Text:
    """Figures 4 to 9."""
    keys = {v: the.speed(v).key for v in (plan.FAST, plan.MODERATE)}
    speeds = {v: flown.runs(key) for v, key in keys.items()}
    text = ["## Simulations", ""]
    text += [f"`swarm-v0`; {the.runs} runs of the main table, {the.some} of the others.", ""]
    text += section("Average NRMSE (figure 6)", tables.averages(speeds, flown, keys), 2)
    drawings: Drawings = {}
    layouts = {
        name: _shown(there)
        for name in ("random", "u", "o")
        if (there := flown.runs(the.layout(name).key))
    }
    if layouts:
        drawings[FILES[0]] = partial(figures.layouts, layouts)
    if "random" in layouts:
        drawings[FILES[1]] = partial(figures.maps, layouts["random"])
    if any(speeds.values()):
        shown = {v: _shown(there) for v, there in speeds.items() if there}
        known = {v: _bounds(flown, key) for v, key in keys.items()}
        drawings[FILES[2]] = partial(figures.over_time, shown, known)
    slow = flown.runs(the.speed(plan.SLOW).key)
    if WHOLE in slow:
        drawings[FILES[3]] = partial(figures.tracks, slow[WHOLE])
    radii = {r: _shown(there) for r in plan.RADII if (there := flown.runs(the.radius(r).key))}
    if radii:
        known = {r: _bounds(flown, the.radius(r).key) for r in radii}
        drawings[FILES[4]] = partial(figures.radii, radii, known)
    grown = {n: c for n in plan.GROWTH if (c := flown.cost.get(the.timed(n).key))}
    at = flown.cost.get(the.timed(200).key, {})
    if grown:
        drawings[FILES[5]] = partial(figures.times, grown, at, slow)
    text += drawing.draw(drawings, folder)
    others = [s for s in the.paper() if s.variant.key not in keys.values()]
    text += section("Layouts and radii", tables.errors(others, flown), 2)
    text += section("Time of a step, N = 200", tables.costs(at, tables.PAPER_MS), 1)
    text += section("Growth", tables.growth(grown), 1)
    machine = platform.processor() or platform.machine()
    return [*text, f"Whole team, one thread ({machine}), all methods step by step in turn.", ""]


def stress_part(flown: Flown, the: Plan, folder: Path) -> Text:
    """Figures 10 and 11."""
    shares = {x: the.share(x).key for x in plan.SHARES}
    tails = {x: the.tail(x).key for x in (0.0, *plan.TAILS)}
    reaches = {r: the.sparse(r).key for r in plan.SPARSE}
    biased, heavy, sparse = (
        {x: flown.runs(key) for x, key in keys.items()} for keys in (shares, tails, reaches)
    )
    known, heavy_known, sparse_known = (
        {x: _bounds(flown, key) for x, key in keys.items()} for keys in (shares, tails, reaches)
    )
    drawings: Drawings = {}
    if any(biased.values()) or any(heavy.values()):
        both = [{x: _shown(y) for x, y in each.items()} for each in (biased, heavy)]
        drawings[FILES[6]] = partial(stress_figures.nlos, both[0], both[1], (known, heavy_known))
    failing = the.failing(plan.FAILURES[0]).key
    if any(sparse.values()) or flown.runs(failing):
        shown = {r: _shown(there) for r, there in sparse.items()}
        drawings[FILES[7]] = partial(
            stress_figures.connectivity,
            shown,
            sparse_known,
            _shown(flown.runs(failing)),
            _bounds(flown, failing),
        )
    if any(biased.values()):
        drawings[FILES[8]] = partial(stress_figures.confidence, biased, known)
    text = [
        "## Stress",
        "",
        f"v_max 50 m/s, {the.some} runs; INS without bias but where one is said.",
        "",
    ]
    text += drawing.draw(drawings, folder)
    return text + section("Every case", tables.errors(the.stress(), flown), 2)


def learned_part(flown: Flown, the: Plan, folder: Path) -> Text:
    """What the network adds, and whether the loop is stable."""
    scenes = [s for s in the.learned() if s.variant.key != the.long().key]
    found = {s.variant.title: there for s in scenes if (there := flown.runs(s.variant.key))}
    there = flown.runs(the.long().key)
    drawings: Drawings = {}
    if found:
        drawings[FILES[9]] = partial(loop_figures.ablation, found, plan.ABLATION | plan.LOOPS)
    if there:
        drawings[FILES[10]] = partial(loop_figures.long_run, _only(there), flown.loop)
    text = ["## The learned part", "", f"INS bias 0.3 m/s, 15 % NLOS, {the.some} runs.", ""]
    text += section("Step by step", tables.ablation(scenes, flown), 3)
    text += section(f"{plan.LONG} steps", tables.stability(_only(there), flown.loop), 1)
    return text + drawing.draw(drawings, folder)


def campus_part(flown: Flown, the: Plan, folder: Path) -> Text:
    """Table 2, partition, figure 14."""
    found = {name: flown.runs(the.flight(name).key) for name in plan.FLIGHTS}
    drawings: Drawings = {}
    watched = flown.watched.get(WHOLE) or flown.watched.get(OPTIMIZER)
    if found["s2"]:
        drawings[FILES[11]] = partial(loop_figures.parting, found["s2"], flown.parted)
    event = None if watched is None else watched.event()
    if event is not None:
        drawings[FILES[12]] = partial(loop_figures.link, flown.watched, event)
    text = ["## Flights over a campus, simulated", ""]
    text += section("Table 2: formation geometry and trajectories", tables.flights(found), 2)
    at = flown.cost.get(the.timed_flight().key, {})
    text += section("Table 1: time of a step, ten UAVs", tables.costs(at, tables.PAPER_NANO_MS), 1)
    text += [
        "The paper's Jetson Nano (45 ms for ST-DCL) is not at hand; this machine's is above.",
        "",
    ]
    return text + drawing.draw(drawings, folder)


def real_part(flown: Flown, the: Plan) -> Text:
    """Recordings."""
    lines = section("Every method", tables.recorded(the.real(), flown), 2)
    return ["## Recordings", "", "Runs differ in what is drawn at their start.", "", *lines]


def _shown(there: Teams) -> Teams:
    return {agent: there[agent] for agent in SHOWN if agent in there}


def _only(there: Teams) -> Teams:
    """Without dead reckoning, which drifts."""
    return {agent: one for agent, one in there.items() if agent != WORLD}


def _bounds(flown: Flown, key: str) -> figures.Bounds:
    return {which: flown.bound(key, which) for which in BOUNDS}
