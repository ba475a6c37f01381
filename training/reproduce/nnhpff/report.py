"""The report: verdicts, tables and figures with the paper's numbers beside ours."""

import platform
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from training.reproduce import drawing, reporting, verdicts
from training.reproduce.nnhpff import figures, plan, tables
from training.reproduce.nnhpff.claims import verdicts as judge
from training.reproduce.nnhpff.flown import Flown
from training.reproduce.nnhpff.measures import WITHIN, Runs
from training.reproduce.reporting import Text, section
from training.reproduce.study import Variant

FILES = (
    "figure_4_learning.png",
    "figure_5_case_1.png",
    "figure_6_case_2.png",
    "figure_7_case_3.png",
    "figure_8_ale.png",
    "detector.png",
    "kidnapped.png",
    "paper.json",
)
THRESHOLD = 0.5
Kidnapped = Mapping[str, tuple[Mapping[str, Runs], int, slice]]


def paper_part(flown: Flown, runs: int, steps: int | None, folder: Path) -> Text:
    """Write figures 4 to 8 and ``paper.json``; the part's lines for the report."""
    agents = (*plan.METHODS, *plan.BESIDE)
    cases = {number: flown.runs(plan.case(number, steps), agents, runs) for number in plan.CASES}
    by_case = {(n, agent): one for n, there in cases.items() for agent, one in there.items()}
    judged = judge(by_case)
    titled = {plan.CASES[number]: there for number, there in cases.items()}
    own = {title: _methods(there) for title, there in titled.items()}
    text = ["## The paper's claims", "", verdicts.RULE, "", reporting.counts(judged), ""]
    text += reporting.claims(judged)
    text += ["", f"`wsn-v0`, {runs} runs; means with 95 % intervals over runs.", ""]
    text += section("Errors and resets (figures 5 to 8)", tables.errors(titled), 2)
    text += section("Table 1: time of a localization, 5000 particles", tables.costs(flown), 1)
    machine = platform.processor() or platform.machine()
    text += [
        f"Case 1, one world, one thread ({machine}), all filters step by step in turn. The paper's "
        "are MATLAB's on an i5-12500.",
        "",
    ]
    drawings: dict[str, Callable[[], Figure]] = {}
    if flown.learning is not None:
        drawings[FILES[0]] = partial(figures.learning, flown.learning)
    for name, (title, there) in zip(FILES[1:4], own.items(), strict=True):
        if there:
            drawings[name] = partial(figures.case, title[0].upper() + title[1:], there)
    if any(titled.values()):
        drawings[FILES[4]] = partial(figures.ales, titled)
    text += drawing.draw(drawings, folder)
    content = {
        "runs": runs,
        "claims": [reporting.as_json(each) for each in judged],
        "cases": {
            f"{number}/{agent}": {
                "ale": float(one.ale().mean()),
                "resets_per_run": float(one.resets_per_run().mean()),
                "corner_peak": float(one.corner_peak().mean()),
            }
            for (number, agent), one in by_case.items()
        },
        "ms": {agent: float(one.ms.mean()) for agent, one in flown.cost.items()},
    }
    reporting.write_json(folder / FILES[-1], content)
    return text


def detector_part(flown: Flown, runs: int, steps: int | None, folder: Path) -> Text:
    """Write the detector's figure; the part's lines for the report."""
    samples = {
        "the 27 scenarios, other worlds": flown.detections(plan.trained_on(steps), runs),
        "scenarios never seen": flown.detections(plan.never_seen(steps), runs),
    }
    text = ["## The detector", "", f"{runs} worlds a scenario; nothing is restarted here.", ""]
    text += section("As a classifier", tables.detectors(samples, THRESHOLD), 2)
    text += section(f"Confusion at {THRESHOLD:g}", tables.confusions(samples, THRESHOLD), 2)
    both = {
        title: group
        for title, group in samples.items()
        if group is not None and 0 < group.failed.sum() < group.failed.size
    }
    drawings = {FILES[5]: partial(figures.detector, both)} if both else {}
    return text + drawing.draw(drawings, folder)


def beyond_part(flown: Flown, runs: int, steps: int | None, folder: Path) -> Text:
    """The study beyond the paper; its lines for the report."""
    text = ["## Beyond the paper", ""]
    moved = _all(flown, plan.sensitivity(steps), runs)
    text += section("How σ, M, Q and the quantile move it", tables.errors(moved), 2)
    taken: Kidnapped = {
        variant.title: (there, plan.kidnapped_step(variant), plan.kidnapped_uavs(variant))
        for variant, agents in plan.kidnapping(steps)
        if plan.kidnapped_step(variant) + WITHIN <= variant.build().horizon
        and (there := flown.runs(variant, agents, plan.runs_in(variant, runs)))
    }
    text += section("Recovery from kidnapping", tables.recoveries(taken), 2)
    drawings = {FILES[6]: partial(figures.kidnapping, taken)} if taken else {}
    text += drawing.draw(drawings, folder)
    text += section(
        "An anchor that is always NLOS",
        tables.plain_errors(_all(flown, plan.blocked(steps), runs), "runs lost"),
        2,
    )
    text += section(
        "Recordings (the runs differ in what is drawn at their start)",
        tables.plain_errors(_all(flown, plan.recordings(steps), runs), "runs lost"),
        2,
    )
    return text


def _all(
    flown: Flown, plans: list[tuple[Variant, tuple[str, ...]]], runs: int
) -> dict[str, dict[str, Runs]]:
    found = {v.title: flown.runs(v, agents, plan.runs_in(v, runs)) for v, agents in plans}
    return {title: there for title, there in found.items() if there}


def _methods(there: Mapping[str, Runs]) -> dict[str, Runs]:
    return {agent: there[agent] for agent in plan.METHODS if agent in there}
