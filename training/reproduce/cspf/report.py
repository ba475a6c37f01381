"""The report: verdicts, tables and figures."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from training.evaluation.tables import table
from training.reproduce import drawing, reporting, verdicts
from training.reproduce.cspf import figures, plan, real, tables
from training.reproduce.cspf.claims import verdicts as judge
from training.reproduce.cspf.measures import Runs
from training.reproduce.reporting import Text
from training.reproduce.study import WORLD, Study, Variant

FILES = ("convergence.png", "outliers.png", "paper.json")


def runs_of(study: Study, variant: Variant, agents: Sequence[str], count: int) -> dict[str, Runs]:
    """Those that were flown, by agent; none where the worlds are not there."""
    if not study.can(variant):
        return {}
    results = study.results(variant, list(dict.fromkeys((WORLD, *agents))), count)
    return {a: Runs(results, a) for a in agents if a in results.agents}


def paper_part(study: Study, runs: int, steps: int | None, folder: Path) -> Text:
    """Write the figures and ``paper.json``; the part's lines for the report."""
    own = {}
    for dim in plan.DIMS:
        variant = plan.published(dim, steps)
        agents = (*plan.METHODS, *plan.BESIDE, *plan.LITERAL)
        own[dim] = runs_of(study, variant, agents, runs)
    swept = {
        (dim, share): runs_of(study, plan.world(dim, steps, outliers=share), plan.METHODS, runs)
        for dim in plan.DIMS
        for share in plan.SHARES
    }
    known = {
        (plan.published(dim, steps).key, a): r
        for dim, there in own.items()
        for a, r in there.items()
    }
    known |= {
        (plan.world(dim, steps, outliers=share).key, a): r
        for (dim, share), there in swept.items()
        for a, r in there.items()
    }
    judged = judge(known, steps)
    text = ["## The paper's claims, and the goals", "", verdicts.RULE, "", reporting.counts(judged)]
    text += ["", *reporting.claims(judged), ""]
    text += [
        f"Three UAVs, {runs} runs. *Converged*: every holder's pose of every UAV, relative to "
        "UAV 0, is within 0.3 m and 10°. *Worst error*: the largest over holders and UAVs, after "
        f"{plan.EARLY} steps. Pose graphs are solved at every 50th step; their time is that of a "
        "step without a solution.",
        "",
    ]
    titled = {plan.published(dim, steps).title: there for dim, there in own.items() if there}
    text += titled_table("A fifth of outliers", tables.figures(titled))
    spread = {
        plan.world(dim, steps, outliers=share).title: there
        for (dim, share), there in swept.items()
        if there
    }
    text += titled_table("None to half", tables.figures(spread))
    drawings: dict[str, Callable[[], Figure]] = {}
    if titled:
        lines = {
            title: {a: r for a, r in there.items() if a in plan.METHODS}
            for title, there in titled.items()
        }
        drawings[FILES[0]] = partial(figures.over_time, lines)
    if any(swept.values()):
        drawings[FILES[1]] = partial(figures.over_shares, {k: v for k, v in swept.items() if v})
    text += _draw(drawings, folder)
    content = {"runs": runs, "claims": [reporting.as_json(each) for each in judged]}
    reporting.write_json(folder / FILES[-1], content)
    return text


def beyond_part(study: Study, runs: int, steps: int | None) -> Text:
    """The study beyond the paper; its lines for the report."""
    text = ["## Beyond the paper", ""]
    variant, agents = plan.clouds(steps)
    there = runs_of(study, variant, agents, plan.few(runs))
    if there:
        text += titled_table("Particles, and eq. 16", tables.figures({variant.title: there}))
    for title, planned in (
        ("Larger teams", plan.teams(steps)),
        ("Where many modes persist", plan.hard(steps)),
    ):
        found = {v.title: runs_of(study, v, a, plan.runs_in(v, runs)) for v, a in planned}
        text += titled_table(title, tables.figures({k: t for k, t in found.items() if t}))
    return text


def real_part(study: Study, runs: int, steps: int | None) -> Text:
    """Recordings; the part's lines for the report."""
    count = plan.few(runs)
    found = {v: runs_of(study, v, (WORLD, *a), count) for v, a in real.planned(steps)}
    judged = real.verdicts({v.key: there for v, there in found.items()}, steps)
    text = ["## Recordings", "", reporting.counts(judged), "", *reporting.claims(judged), ""]
    return text + titled_table("Errors", real.table({v.title: t for v, t in found.items() if t}))


def titled_table(title: str, content: tables.Table) -> Text:
    """A table under its title; nothing where there are no lines."""
    header, lines = content
    return [f"### {title}", "", *table(header, lines, left=2), ""] if lines else []


def _draw(drawings: Mapping[str, Callable[[], Figure]], folder: Path) -> Text:
    text: Text = []
    for name, drawn in drawings.items():
        drawing.save(drawn, folder / name)
        words = drawing.caption(getattr(drawn, "func", drawn))
        text += [f"![{words}]({name})", "", f"*{words}*", ""]
    return text
