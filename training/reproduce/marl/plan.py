"""What is trained, where it is tried, beside whom, and what it was to reach."""

from dataclasses import dataclass
from typing import Any

from training.reproduce.study import Variant

SEEDS = 5
SCENARIO = "indoor-v0:motion=random:horizon=200"
FILTERS = ("ekf", "ekf:robust=huber", "ekf_trust", "pf_trust")
_UWB = (
    *(("uwb_std", 0.3), ("nlos", 1.0), ("nlos_bias", 0.5), ("nlos_kind", "constant")),
    ("believed_uwb_std", 0.05),
)
_ACCEL = (
    *(("imu_bias", True), ("accel_bias", 0.3), ("gyro_bias", 0.0)),
    ("believed_imu_bias", False),
)
_AWAY = (("n_uavs", 8), ("room", (20.0, 30.0, 4.0)), ("landmarks", 12))


@dataclass(frozen=True)
class Trained:
    """One way of training, flown with several seeds: ``coloc train NAME --set …``."""

    key: str
    title: str
    name: str = "mappo"
    options: tuple[tuple[str, Any], ...] = ()

    def agent(self, folder: str) -> str:
        """The trained policy's name, with the weights in a run's folder."""
        return f"{self.name}:weights={folder}/{self.name}.safetensors"


@dataclass(frozen=True)
class Goal:
    """``policy`` has at least ``least`` per cent less mean error than ``rival`` in a variant."""

    policy: str
    variant: str
    rival: str
    least: float
    strict: bool = False  # the interval excludes 0, too


def _scenario(overrides: tuple[tuple[str, Any], ...]) -> str:
    texts = [f"{key}={str(v).lower() if isinstance(v, bool) else v}" for key, v in overrides]
    return ":".join((SCENARIO, *texts))


def _single(key: str, title: str, overrides: tuple[tuple[str, Any], ...]) -> Trained:
    return Trained(key, title, options=(("scenario", _scenario(overrides)), ("epochs", 8)))


def _on_huber(key: str, title: str, overrides: tuple[tuple[str, Any], ...]) -> Trained:
    options = (("scenario", _scenario(overrides)), ("base", "ekf:robust=huber"), ("epochs", 8))
    return Trained(key, title, options=options)


def trainings() -> list[Trained]:
    """All of them; none needs more than 3 M agent-steps."""
    accel = _scenario(_ACCEL).removeprefix(SCENARIO + ":")
    mixture = f"/nlos=0.3/false_matches=0.1/{accel}"
    return [
        Trained(
            "mixed",
            "a mixture of four variants",
            options=(("scenario", SCENARIO), ("variants", mixture), ("epochs", 16)),
        ),
        _single("uwb", "UWB wrongly believed", _UWB),
        _single("nlos", "NLOS 30 %", (("nlos", 0.3),)),
        _single("false", "false matches 10 %", (("false_matches", 0.1),)),
        _single("accel", "accelerometer bias", _ACCEL),
        _on_huber("huber-nlos", "NLOS 30 %, on Huber", (("nlos", 0.3),)),
        _on_huber("huber-uwb", "UWB wrongly believed, on Huber", _UWB),
        Trained(
            "displacement",
            "default, localizing alone",
            name="ippo",
            options=(("scenario", SCENARIO), ("base", "none"), ("epochs", 14)),
        ),
    ]


def variants() -> list[tuple[Variant, tuple[str, ...]]]:
    """Where policies are tried, and which of them; worlds that nothing was trained on."""

    def variant(key: str, title: str, *overrides: tuple[str, Any]) -> Variant:
        return Variant(key, title, (("motion", "random"), ("horizon", 200), *overrides))

    alone = ("nlos", "uwb", "false", "accel")
    return [
        (variant("default", "default"), ("mixed", *alone, "displacement")),
        (variant("nlos", "NLOS 30 %", ("nlos", 0.3)), ("mixed", "nlos", "huber-nlos")),
        (variant("uwb", "UWB wrongly believed", *_UWB), ("mixed", "uwb", "huber-uwb")),
        (variant("accel", "accelerometer bias", *_ACCEL), ("mixed", "accel")),
        (variant("false", "false matches 10 %", ("false_matches", 0.1)), ("mixed", "false")),
        (
            variant("away", "8 UAVs, room 20×30×4 m, 12 landmarks", *_AWAY),
            ("mixed", "displacement"),
        ),
        (
            variant("away-nlos", "the same + NLOS 30 %", *_AWAY, ("nlos", 0.3)),
            ("mixed", "nlos", "huber-nlos"),
        ),
        (
            variant("away-uwb", "the same, UWB wrongly believed", *_AWAY, *_UWB),
            ("mixed", "uwb", "huber-uwb"),
        ),
    ]


def goals() -> list[Goal]:
    """The specification's figures to beat."""
    huber = "ekf:robust=huber"
    return [
        Goal("nlos", "nlos", "ekf", 38),
        Goal("uwb", "uwb", "ekf", 65),
        Goal("uwb", "uwb", huber, 40),
        Goal("accel", "accel", "ekf", 50),
        Goal("false", "false", "ekf", 60),
        Goal("huber-nlos", "nlos", huber, 5, strict=True),
        Goal("huber-uwb", "uwb", huber, 55),
        Goal("mixed", "nlos", "ekf", 30),
        Goal("mixed", "false", "ekf", 60),
        Goal("mixed", "uwb", "ekf", 50),
        Goal("mixed", "default", "ekf", -5),
    ]
