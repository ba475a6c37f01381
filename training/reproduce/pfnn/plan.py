"""Which agents fly in which variants, for the paper's tables and for the study of robustness."""

from collections.abc import Sequence
from typing import Any

from coloc_env.motion import MOTIONS
from training.reproduce.pfnn.paper import PROPOSED, RANGES
from training.reproduce.study import Variant

TABLE_AGENTS = ("pf500", "pf800", "apf", "ekf", "pfnn")
ROBUST_AGENTS = (
    "ekf",
    "ekf:robust=gate",
    "ekf:robust=huber",
    "ekf_joint",
    "pf500",
    "pf800",
    "apf",
    "pfnn",
    "ekf_trust",
    "pf_trust",
)
_FULL = (
    *("default", "uniform", "nlos", "false", "few", "dropout", "blind6", "blind20"),
    *("few-nlos", "few-nlos-false", "hard", "away-nlos-false"),
)


def ablation_agents() -> dict[str, tuple[float, float]]:
    """Agents of figure 2 with their ranges; the proposed range is ``pfnn`` as it comes."""
    return {
        "pfnn" if span == PROPOSED else f"pfnn:correction={span[0]:g},{span[1]:g}": span
        for span in RANGES
    }


def default(steps: int | None = None) -> Variant:
    """The paper's own experiment."""
    return _variant("default", "default", steps)


def variants(steps: int | None = None) -> list[Variant]:
    """The study of robustness: one difficulty at a time, several, and worlds unlike those that
    learned parts were trained on."""
    few = {"landmarks": 5}
    hard = few | {"nlos": 0.3, "false_matches": 0.1}
    away = {"n_uavs": 8, "room": (20.0, 30.0, 4.0), "landmarks": 12}
    found = [
        default(steps),
        _variant("uniform", "uniform prior", steps, prior="uniform"),
        _variant("nlos", "NLOS 30 %", steps, nlos=0.3),
        _variant("false", "false 10 %", steps, false_matches=0.1),
        _variant("few", "5 landmarks", steps, **few),
        _variant("dropout", "drop-out 50 %", steps, landmark_dropout=0.5),
        _variant("blind6", "6 s blind", steps, range_only=(40.0, 46.0)),
        _variant("blind20", "20 s blind", steps, range_only=(40.0, 60.0)),
        _variant("few-nlos", "5 landmarks + NLOS", steps, **few, nlos=0.3),
        _variant("few-nlos-false", "5 landmarks + NLOS + false", steps, **hard),
        _variant("hard", "all hard", steps, **hard, prior="uniform", landmark_dropout=0.5),
    ]
    for motion in MOTIONS:
        if motion != "circle":
            found.append(_variant(motion, motion.replace("_", " "), steps, motion=motion))
    found += [
        _variant("uavs8", "8 UAVs", steps, n_uavs=8),
        _variant("room", "room 20×30×4 m", steps, room=away["room"]),
        _variant("landmarks12", "12 landmarks", steps, landmarks=12),
        _variant("away", "8 UAVs, room, 12 landmarks", steps, **away),
        _variant(
            "away-nlos-false", "the same + NLOS + false", steps, **away, nlos=0.3, false_matches=0.1
        ),
        Variant("mrclam", "MRCLAM (real)", (), "replay-mrclam-v0", steps),
        Variant("euroc", "EuRoC (real)", (), "replay-euroc-v0", steps),
    ]
    return found


def runs_in(variant: Variant, runs: int) -> int:
    """Half the runs for motions and places that bring no difficulty of their own; a quarter for
    recordings, which differ in the prior's draw alone."""
    if variant.scenario.startswith("replay"):
        return max(1, runs // 4)
    return runs if variant.key in _FULL else max(1, runs // 2)


def chosen(agents: Sequence[str], wanted: Sequence[str] | None) -> list[str]:
    """Those of a part's agents that are wanted; all, if nothing is said."""
    return [agent for agent in agents if wanted is None or agent in wanted]


def _variant(key: str, title: str, steps: int | None, **overrides: Any) -> Variant:
    return Variant(key, title, tuple(overrides.items()), steps=steps)
