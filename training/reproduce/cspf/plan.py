"""Who runs where: the paper's two worlds, shares of outliers, teams, particles, hard worlds,
recordings; and the measures of a team that agrees."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from training.evaluation.metrics import Flags, Floats, rmse_per_run
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.work import Cell, Kind, Variant

TITLE = (
    "Arita & Namerikawa, Collaborative Stein Particle Filter for Cooperative Localization in "
    "Monotone Environments"
)
DIMS = (2, 3)
METHODS = (
    *("cspf", "cspf:consensus=false", "cspf:particles=1", "pf_joint:anneal=0.96"),
    "pose_graph:every=50",
)
BESIDE = (
    *("cspf:broadcast=true", "cspf:outliers=0.4", "pf_joint", "pf_joint:particles=5000"),
    *("pf_joint:anneal=0.96:particles=50", "pose_graph:every=50:robust=gnc"),
)
CENTRAL = ("pf_joint:anneal=0.97:particles=500", "pose_graph:every=50:robust=gnc")  # hard worlds
LITERAL = ("cspf:variant=paper", "cspf:variant=paper_corrected")
ACROSS = ("cspf", "cspf:variant=neighbourhood")  # eq. 16 in this filter: thirty times the cost
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
PUBLISHED = 0.2
EARLY, LATE = 150, 250  # steps after which convergence is measured
TEAMS = (2, 5, 10, 20)
PARTICLES = (20, 100, 200, 1000)
CLOUDS = "clouds"  # a cell
DRAWN = Kind(  # one run, whose particles the paper's figures show
    "drawn",
    "training.reproduce.cspf.clouds:compute",
    "training.reproduce.cspf.clouds:load",
    ("training.reproduce.cspf.clouds",),
)
ERRORS = Kind(  # one run, whose particles' errors the paper's figure 7 shows
    "errors",
    "training.reproduce.cspf.particle_errors:compute",
    "training.reproduce.cspf.particle_errors:load",
    ("training.reproduce.cspf.particle_errors",),
)
NAMES = {
    "cspf": "CSPF",
    "cspf:consensus=false": "no consensus",
    "cspf:particles=1": "one particle",
    "pf_joint:anneal=0.96": "annealed PF",
    "pose_graph:every=50": "Huber graph",
}
FAST = "cspf:anneal=0.85"  # a step lasts a second and measures every pair: it need not wait as long
TEAM = (
    *(FAST, f"{FAST}:consensus=false", f"{FAST}:particles=1"),
    *("pose_graph:every=10", "pose_graph:every=10:robust=gnc"),
)
SMOOTHER = "dfgo"  # fixed-lag, with IMU and landmark factors and Huber's loss, as D²SLAM
ALONE = (
    *("stein_vi", "stein_vi:particles=1", "ekf", "ekf:robust=huber", "ekf:robust=gate"),
    *("pf:particles=20", SMOOTHER, f"{SMOOTHER}:robust=student", f"{SMOOTHER}:robust=mixture"),
)
QUICK = "cspf:pace=0.8:restart=0.3"  # for teams with IMUs, whose predictions soon lead astray
INERTIAL = (
    *(QUICK, f"{QUICK}:consensus=false", f"{QUICK}:particles=1"),
    "pose_graph:every=10",
)
SEQUENCES = ("V1_01_easy", "V1_03_difficult", "MH_04_difficult")
TRIALS = ("09", "14", "16")
WRONG = (0.0, 0.2, 0.4)  # of MURP's poses, and of those between EuRoC's flights
MISTAKEN = (0.0, 0.1)  # of EuRoC's landmarks
SHOWN = ("V1_03_difficult", 0.1)  # figure 7


def drawn(dim: int) -> str:
    """The name of the cell whose particles are drawn."""
    return f"drawn in {dim}-D"


def world(dim: int, steps: int | None = None, **overrides: Any) -> Variant:
    """A world of the paper's kind, with overrides."""
    key = "-".join((f"stein{dim}d", *(f"{k}={v}" for k, v in overrides.items())))
    words = ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in overrides.items())
    return Variant(key, f"{dim}-D, {words}", tuple(overrides.items()), f"stein{dim}d-v0", steps)


def paper(settings: Settings) -> Iterator[Cell]:
    """The paper's share of outliers with all agents, and outliers from none to half."""
    for dim in DIMS:
        published = world(dim, settings.steps, outliers=PUBLISHED)
        yield Cell(published, (*METHODS, *BESIDE, *LITERAL), settings.runs)
        steps = min(EARLY + 1, settings.steps or EARLY + 1)
        early = replace(published, key=f"{published.key}-early", steps=steps)
        yield Cell(early, ("cspf",), kind=DRAWN, key=drawn(dim))
        for share in SHARES:
            yield Cell(world(dim, settings.steps, outliers=share), METHODS, settings.runs)


def beyond(settings: Settings) -> Iterator[Cell]:
    """More and fewer particles, and the paper's own target; larger teams; hard worlds."""
    agents = (*(f"cspf:particles={m}" for m in PARTICLES), *ACROSS)
    published = world(2, settings.steps, outliers=PUBLISHED)
    yield Cell(published, agents, settings.fraction(10), key=CLOUDS)
    for variant in teams(settings.steps):
        yield Cell(variant, METHODS, settings.fraction(_divisor(variant)))
    yield Cell(moving(settings.steps), METHODS, settings.fraction(5))
    for variant in hard(settings.steps):
        yield Cell(variant, (*METHODS, *CENTRAL), settings.fraction(_divisor(variant)))


def teams(steps: int | None) -> list[Variant]:
    """More UAVs, one match a step for every two pairs of three."""
    return [world(2, steps, n_uavs=n, matches_per_step=max(1, n // 3)) for n in TEAMS]


def hard(steps: int | None) -> list[Variant]:
    """Where many modes persist, and particles might pay: most matches wrong, half of them among
    many, a ring of equals, blurred matches, a sparse network."""
    worlds: tuple[dict[str, Any], ...] = (
        {"outliers": 0.6},
        {"outliers": 0.75},
        {"outliers": 0.5, "n_uavs": 10, "matches_per_step": 2},
        {"outliers": 0.5, "motion": "circle"},
        {"outliers": 0.4, "relative_pose_noise": (0.3, 15.0)},
        {"outliers": 0.4, "n_uavs": 6, "comm_radius": 5.0, "matches_per_step": 3},
        {"outliers": 0.4, "message_loss": 0.5},
    )
    return [world(2, steps, **each) for each in worlds]


def moving(steps: int | None) -> Variant:
    """UAVs that move in space, with the odometry of those in the plane."""
    return world(3, steps, motion="random", odometry_noise=(0.005, 0.2))


def _divisor(variant: Variant) -> int:
    """Half of the runs in worlds beyond the paper's; a fifth in teams of more than five, a
    twentieth in those of more than ten, where a step costs twenty times as much."""
    uavs = dict(variant.overrides).get("n_uavs", 3)
    return 20 if uavs > 10 else 5 if uavs > 5 else 2


def murp(trial: str, outliers: float, steps: int | None = None) -> Variant:
    """A recording's later part, with so many poses replaced."""
    return Variant(
        f"murp-{trial}-outliers={outliers}",
        f"MURP {trial}, outliers {outliers:g}",
        (("sequence", trial), ("outliers", outliers)),
        "replay-murp-v0",
        steps,
        bounded=False,
    )


def euroc(sequence: str, mistaken: float, steps: int | None = None) -> Variant:
    """A recording with so many landmarks mistaken for others."""
    return Variant(
        f"{sequence}-false={mistaken}",
        f"{sequence}, false matches {mistaken:g}",
        (("sequence", sequence), ("false_matches", mistaken)),
        "replay-stein-euroc-v0",
        steps,
        bounded=False,
    )


def flights(outliers: float, steps: int | None = None) -> Variant:
    """EuRoC's flights in one room together, by IMUs and relative poses, so many of them wrong."""
    return Variant(
        f"euroc-team-outliers={outliers}",
        f"EuRoC together, outliers {outliers:g}",
        (("outliers", outliers),),
        "replay-stein-euroc-team-v0",
        steps,
        bounded=False,
    )


def real(settings: Settings) -> Iterator[Cell]:
    """Three agents with ranges (MURP), three with IMUs (EuRoC), and one with an IMU and landmarks
    (EuRoC)."""
    for trial in TRIALS:
        for share in WRONG:
            yield Cell(murp(trial, share, settings.steps), TEAM, settings.fraction(10))
    for share in WRONG:
        yield Cell(flights(share, settings.steps), INERTIAL, settings.fraction(10))
    for name in SEQUENCES:
        for share in MISTAKEN:
            yield Cell(euroc(name, share, settings.steps), ALONE, settings.fraction(10))
    yield Cell(euroc(*SHOWN, settings.steps), ("stein_vi",), kind=ERRORS)


# ------------------------------------------------------------------ measures


def converged(one: Runs, steps: int) -> Flags:
    """[R]: whether, after so many steps (the last, if there are fewer), every holder's pose of
    every UAV is within 0.3 m and 10°; never in a run with NaN or a numerical error."""
    close = one.record.series["converged"][:, min(steps, one.steps) - 1, 0] > 0
    return close & ~one.record.broken


def worst(one: Runs, steps: int) -> Floats:
    """[R]: the largest position error over holders and UAVs after so many steps, m."""
    error = one.record.series["team_error"][:, min(steps, one.steps) - 1]
    return np.where(np.isfinite(error), error, np.inf).max(-1)


def converged_over_time(one: Runs) -> Floats:
    """[K]: share of the runs that have converged."""
    close = one.record.series["converged"][:, :, 0] > 0
    return (close & ~one.record.broken[:, None]).mean(0)


def late_nees(one: Runs) -> float:
    """Mean over the second half of the runs' steps."""
    half = one.steps // 2
    values = one.record.nees[:, half:][one.scored[:, half:]]
    return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")


def late(one: Runs) -> Floats:
    """[R]: RMSE over the last third of each run, m."""
    start = int((1 - 1 / 3) * one.steps)
    return rmse_per_run(one.error[:, start:], one.scored[:, start:])
