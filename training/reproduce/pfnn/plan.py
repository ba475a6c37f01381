"""Which agents run in which variants, for the paper's tables and for the study of robustness."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from agents.particle.printed import PERTURB_STD as DEFAULT_STD
from coloc_env.motion import MOTIONS
from training.evaluation import metrics
from training.evaluation.evaluate import Progress
from training.evaluation.metrics import Floats
from training.learning.pfnn_online import learn_online
from training.reproduce.cost import COST
from training.reproduce.pfnn.paper import PROPOSED, RANGES
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.store import Arrays, Facts
from training.reproduce.work import Cell, Kind, Piece, Variant

TABLE_AGENTS = ("pf500", "pf800", "apf", "ekf", "dfgo", "dlspf", "pfnn")
PRINTED = {name: f"{name}:variant=paper" for name in ("pf500", "pf800", "apf", "pfnn")}
PERTURB_STD = (0.03, 0.05, 0.1, 0.2, 0.3, 1.0, 1.2)  # m, of the position; the paper gives none
SWEEP = {  # agents as printed with their perturbation; that of the default is as it comes
    PRINTED["pfnn"] + ("" if std == DEFAULT_STD else f":perturb_std={std:g}"): std
    for std in PERTURB_STD
}
ROBUST_AGENTS = (
    *("ekf", "ekf:robust=gate", "ekf:robust=huber", "ekf_joint", "pf500", "pf800", "apf", "pfnn"),
    *("ekf_trust", "pf_trust"),
)
ABLATION = {  # agents of figure 2 with their ranges; the proposed range is ``pfnn`` as it comes
    "pfnn" if span == PROPOSED else f"pfnn:correction={span[0]:g},{span[1]:g}": span
    for span in RANGES
}
PRINTED_ABLATION = {  # the same of the filter as printed
    agent.replace("pfnn", PRINTED["pfnn"], 1): span for agent, span in ABLATION.items()
}
DEFAULT, FIGURE_9 = "default", "figure 9"  # cells
STEADY = 10.0  # s: from here on a filter has settled
ONLINE = Kind(
    "online",
    f"{__name__}:compute_online",
    f"{__name__}:load_online",
    ("training.learning.pfnn_online",),
)
ORACLE = Kind(
    "oracle",
    "training.reproduce.pfnn.oracle:compute",
    "training.reproduce.pfnn.oracle:load",
    ("training.reproduce.pfnn.oracle",),
)
# Inside the paper's circle a pillar, about it two walls with gaps (m).
WALLS = (
    14.0,
    9.0,
    0.0,
    16.0,
    11.0,
    5.0,
    10.0,
    0.0,
    0.0,
    10.2,
    14.0,
    5.0,
    20.0,
    6.0,
    0.0,
    20.2,
    20.0,
    5.0,
)
INTERMITTENT = {"uwb_outage": 0.5, "uwb_outage_time": 5.0}
PROGRAMMES = {  # of the paper's last section; the third is ``INTERMITTENT``
    "aggressive": "aggressive (jerk-limited)",
    "multi_scale": "multi-scale",
    "formation": "formation change",
}
_FULL = (
    *("default", "uniform", "nlos", "false", "few", "dropout", "blind6", "blind20"),
    *("few-nlos", "few-nlos-false", "hard", "away-nlos-false"),
)


def paper(settings: Settings) -> Iterator[Cell]:
    """The paper's experiment: tables over the runs, figure 9 over half as many more, the corrector
    learning in flight, and one that knows the truth, costs."""
    (default, *_), runs = variants(settings.steps), settings.runs
    methods = (*TABLE_AGENTS, *PRINTED.values())
    agents = (*methods, *SWEEP, *ABLATION, *PRINTED_ABLATION)
    yield Cell(default, tuple(dict.fromkeys(agents)), runs)
    yield Cell(default, methods, max(1, runs + runs // 2), key=FIGURE_9)
    yield Cell(default, ("pfnn", PRINTED["pfnn"]), runs, ONLINE)
    yield Cell(default, ("pfnn", PRINTED["pfnn"]), runs, ORACLE)
    yield Cell(default, methods, 1, COST)


def robustness(settings: Settings) -> Iterator[Cell]:
    """Agents that are asked for, or the usual ones, in every variant."""
    agents = robust_agents(settings)
    for variant in variants(settings.steps):
        yield Cell(variant, agents, settings.fraction(_divisor(variant)))


def robust_agents(settings: Settings) -> tuple[str, ...]:
    """Of the study of robustness: any that are asked for."""
    return ROBUST_AGENTS if settings.agents is None else tuple(settings.agents)


def variants(steps: int | None = None) -> list[Variant]:
    """The paper's own experiment, one difficulty at a time, several, and worlds unlike those that
    learned parts were trained on; the paper's four programmes are among them."""

    def indoor(key: str, title: str, **overrides: Any) -> Variant:
        return Variant(key, title, tuple(overrides.items()), steps=steps)

    few = {"landmarks": 5}
    hard = few | {"nlos": 0.3, "false_matches": 0.1}
    away = {"n_uavs": 8, "room": (20.0, 30.0, 4.0), "landmarks": 12}
    return [
        indoor(DEFAULT, "default"),
        indoor("uniform", "uniform prior", prior="uniform"),
        indoor("nlos", "NLOS 30 %", nlos=0.3),
        indoor("false", "false 10 %", false_matches=0.1),
        indoor("few", "5 landmarks", **few),
        indoor("dropout", "drop-out 50 %", landmark_dropout=0.5),
        indoor("blind6", "6 s blind", range_only=(40.0, 46.0)),
        indoor("blind20", "20 s blind", range_only=(40.0, 60.0)),
        indoor("few-nlos", "5 landmarks + NLOS", **few, nlos=0.3),
        indoor("few-nlos-false", "5 landmarks + NLOS + false", **hard),
        indoor("hard", "all hard", **hard, prior="uniform", landmark_dropout=0.5),
        *(
            indoor(motion, PROGRAMMES.get(motion, motion.replace("_", " ")), motion=motion)
            for motion in MOTIONS
            if motion != "circle"
        ),
        indoor("intermittent", "intermittent UWB", **INTERMITTENT),
        indoor("few-intermittent", "5 landmarks + intermittent UWB", **few, **INTERMITTENT),
        indoor("walls", "walls", walls=WALLS),
        indoor("walls-obstacles", "walls + 6 obstacles", walls=WALLS, obstacles=6),
        indoor("field", "field of view 90°", landmark_field=1.57),
        indoor("gusts", "gusts 0.3 m/s²", gust_std=0.3),
        indoor("uavs8", "8 UAVs", n_uavs=8),
        indoor("room", "room 20×30×4 m", room=away["room"]),
        indoor("landmarks12", "12 landmarks", landmarks=12),
        indoor("away", "8 UAVs, room, 12 landmarks", **away),
        indoor(
            "away-nlos-false", "the same + NLOS + false", **away, nlos=0.3, false_matches=0.1
        ),
        Variant("mrclam", "MRCLAM (real)", (), "replay-mrclam-v0", steps),
        Variant("euroc", "EuRoC (real)", (), "replay-euroc-v0", steps),
    ]  # fmt: skip


def _divisor(variant: Variant) -> int:
    """Half the runs for motions and places that bring no difficulty of their own; a quarter for
    recordings, which differ in the prior's draw alone."""
    if variant.scenario.startswith("replay"):
        return 4
    return 1 if variant.key in _FULL else 2


# ------------------------------------------------------------------ learning in flight


@dataclass(frozen=True, eq=False)
class Online:
    """The corrector learning while it is used: ``error`` (m) and ``count`` of particles [R, K, N],
    ``loss`` [R, L] before each training."""

    error: Floats
    count: Floats
    loss: Floats


def compute_online(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """The paper's own experiment: the corrector learns from the truth in flight."""
    (agent,), scenario = piece.agents, piece.variant.build()
    found = learn_online(scenario, piece.runs, piece.seed, progress, agent)
    return {key: getattr(found, key).numpy() for key in ("error", "count", "loss")}, {}


def load_online(variant: Variant, arrays: Arrays, facts: Facts) -> Online:
    """What ``compute_online`` made."""
    return Online(**arrays)


# ------------------------------------------------------------------ measures


def particles(one: Runs) -> Floats:
    """[R]: mean count; NaN for what has no particles."""
    values = one.record.series.get("particles")
    return np.array([np.nan]) if values is None else metrics.mean_per_run(values, one.scored)


def redrawn(one: Runs) -> float | None:
    """Per cent of UAV-steps in which a cloud was redrawn from an EKF's posterior."""
    values = one.record.series.get("renewed")
    return None if values is None else 100 * metrics.mean(metrics.mean_per_run(values, one.scored))


def steady(one: Runs) -> slice:
    """The steps after the first 10 s; all of a run that is shorter."""
    first = round(STEADY / one.dt)
    return slice(first if first < one.steps else 0, None)
