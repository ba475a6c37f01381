"""Recordings: three agents with ranges (MURP), one flight by IMU and landmarks (EuRoC)."""

from collections.abc import Iterator, Mapping
from itertools import product

import numpy as np

from training.evaluation.metrics import Floats, rmse_per_run
from training.evaluation.results import short
from training.reproduce.cspf.measures import Runs
from training.reproduce.study import WORLD, Variant
from training.reproduce.verdicts import Claim, Verdict, decide, gain, interval

_FAST = "cspf:anneal=0.85"  # a step lasts a second and tells every pair: it need not wait as long
TEAM = (
    *(_FAST, f"{_FAST}:consensus=false", f"{_FAST}:particles=1"),
    *("pose_graph:every=10", "pose_graph:every=10:robust=gnc"),
)
ALONE = (
    *("stein_vi", "stein_vi:particles=1", "ekf", "ekf:robust=huber", "ekf:robust=gate"),
    "pf:particles=20",
)
SEQUENCES = ("V1_01_easy", "V1_03_difficult", "MH_04_difficult")
TRIALS = ("09", "14", "16")
WRONG = (0.0, 0.2, 0.4)  # of MURP's poses
MISTAKEN = (0.0, 0.1)  # of EuRoC's landmarks
LATE = 1 / 3  # of a run: what counts as its end

Found = Mapping[str, Mapping[str, Runs]]  # by variant's key and agent
Table = tuple[list[str], list[list[str]]]


def murp(trial: str, outliers: float, steps: int | None) -> Variant:
    """A recording's later part, with so many poses replaced."""
    return Variant(
        f"murp-{trial}-outliers={outliers}",
        f"MURP {trial}, outliers {outliers:g}",
        (("sequence", trial), ("outliers", outliers)),
        "replay-murp-v0",
        steps,
        bounded=False,
    )


def euroc(sequence: str, mistaken: float, steps: int | None) -> Variant:
    """A flight with so many landmarks mistaken for others."""
    return Variant(
        f"{sequence}-false={mistaken}",
        f"{sequence}, false matches {mistaken:g}",
        (("sequence", sequence), ("false_matches", mistaken)),
        "replay-stein-euroc-v0",
        steps,
        bounded=False,
    )


def planned(steps: int | None) -> list[tuple[Variant, tuple[str, ...]]]:
    """Who flies where."""
    return [(murp(trial, share, steps), TEAM) for trial in TRIALS for share in WRONG] + [
        (euroc(name, share, steps), ALONE) for name in SEQUENCES for share in MISTAKEN
    ]


def verdicts(found: Found, steps: int | None) -> list[Verdict]:
    """Section 6's claim that a filter stays bounded where dead reckoning drifts, and whether what
    the paper says of particles and of consensus holds on recordings, where agents were flown."""
    judged = []
    for claim, key, agents in _claims(steps):
        there = found.get(key, {})
        absent = [agent for agent in agents if agent not in there]
        if absent:
            judged.append(decide(claim, None, f"not flown: {', '.join(absent)}"))
            continue
        ours, other = (late(there[agent]) for agent in agents)
        if len(ours) < 2:
            judged.append(decide(claim, None, "one run only"))
        elif claim.unit == "%":
            judged.append(decide(claim, gain(ours, other)))
        else:
            judged.append(decide(claim, interval(other - ours)))
    return judged


def _claims(steps: int | None) -> Iterator[tuple[Claim, str, tuple[str, str]]]:
    """A claim, its variant, and the agents compared: the first is said to be better."""
    for name in SEQUENCES:
        key = euroc(name, MISTAKEN[-1], steps).key
        words = f"{name}: with a tenth of false matches the filter's error stays bounded"
        claim = Claim(f"{words}, dead reckoning drifts", "bounded", "%", "above")
        yield claim, key, ("stein_vi", WORLD)
        claim = Claim(
            f"{name}: 20 particles end nearer to the truth than one",
            "multi-modal distributions are needed",
            "m",
            "above",
        )
        yield claim, key, ("stein_vi", "stein_vi:particles=1")
    for trial, share in product(TRIALS, WRONG[1:]):
        key, words = murp(trial, share, steps).key, f"MURP {trial}, outliers {share:g}"
        claim = Claim(f"{words}: consensus lowers the error", "consensus needed", "m", "above")
        yield claim, key, (_FAST, f"{_FAST}:consensus=false")
        claim = Claim(
            f"{words}: particles end nearer to the truth than one",
            "multi-modal distributions are needed",
            "m",
            "above",
        )
        yield claim, key, (_FAST, f"{_FAST}:particles=1")


def late(runs: Runs) -> Floats:
    """[R]: RMSE over the last third of each run, m."""
    start = int((1 - LATE) * runs.steps)
    return rmse_per_run(runs.one.error[:, start:], runs.results.worlds.scored[:, start:])


def table(found: Mapping[str, Mapping[str, Runs]]) -> Table:
    """By variant's title and agent: errors of whole runs and of their ends, convergence, NEES."""
    header = ["recording", "agent", "runs", "RMSE (m)", "last third (m)", "worst run's (m)"]
    header += ["converged at the end (%)", "NEES", "ms a step"]
    lines = []
    for title, there in found.items():
        for agent, one in there.items():
            whole, end = rmse_per_run(one.one.error, one.results.worlds.scored), late(one)
            known, cost = "converged" in one.one.series, one.one.ms_per_step
            lines.append(
                [
                    title,
                    f"`{agent}`",
                    str(one.results.runs),
                    short(float(np.mean(whole))),
                    short(float(np.mean(end))),
                    short(float(np.max(end))),
                    f"{100 * one.converged(one.steps).mean():.0f}" if known else "",
                    short(one.nees()),
                    "" if cost is None else f"{cost:.2f}",
                ]
            )
    return header, lines
