"""What is trained, where it is tried, beside whom, and what it was to reach."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from training.reproduce.work import Training, Variant

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
Options = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Policy:
    """A way of training, done with several seeds."""

    key: str
    title: str
    training: str = "mappo"
    options: Options = ()

    def runs(self, seeds: int) -> list[Training]:
        """Its training runs."""
        return [
            Training(
                f"{self.key}-{seed}",
                self.training,
                (*self.options, ("seed", seed), ("score_runs", 0)),
            )
            for seed in range(seeds)
        ]

    def agents(self, out: Path, seeds: int) -> tuple[str, ...]:
        """The trained policies, with the weights in the runs' folders."""
        return tuple(
            f"{self.training}:weights={run.folder(out)}/{self.training}.safetensors"
            for run in self.runs(seeds)
        )


@dataclass(frozen=True)
class Target:
    """``policy`` has at least ``least`` per cent less mean error than ``rival`` in a variant;
    ``clear``: the interval is above 0, too."""

    policy: str
    variant: str
    rival: str
    least: float
    clear: bool = False


@dataclass(frozen=True)
class Plan:
    """Policies, the worlds that each is tried in, and targets."""

    policies: tuple[Policy, ...]
    worlds: tuple[tuple[Variant, tuple[str, ...]], ...]
    targets: tuple[Target, ...]
    seeds: int = 5


def _text(overrides: Options) -> str:
    texts = (f"{key}={str(v).lower() if isinstance(v, bool) else v}" for key, v in overrides)
    return ":".join((SCENARIO, *texts))


def _policy(key: str, title: str, overrides: Options, *options: tuple[str, Any]) -> Policy:
    options = (("scenario", _text(overrides)), *options, ("epochs", 8))
    return Policy(key, title, options=options)


def _policies() -> tuple[Policy, ...]:
    """All of them; none needs more than 3 M agent-steps."""
    accel = _text(_ACCEL).removeprefix(SCENARIO + ":")
    mixture = f"/nlos=0.3/false_matches=0.1/{accel}"
    huber = ("base", "ekf:robust=huber")
    return (
        Policy(
            "mixed",
            "a mixture of four variants",
            options=(("scenario", SCENARIO), ("variants", mixture), ("epochs", 16)),
        ),
        _policy("uwb", "UWB wrongly believed", _UWB),
        _policy("nlos", "NLOS 30 %", (("nlos", 0.3),)),
        _policy("false", "false matches 10 %", (("false_matches", 0.1),)),
        _policy("accel", "accelerometer bias", _ACCEL),
        _policy("huber-nlos", "NLOS 30 %, on Huber", (("nlos", 0.3),), huber),
        _policy("huber-uwb", "UWB wrongly believed, on Huber", _UWB, huber),
        Policy(
            "displacement",
            "default, localizing alone",
            "ippo",
            (("scenario", SCENARIO), ("base", "none"), ("epochs", 14)),
        ),
    )


def _worlds() -> tuple[tuple[Variant, tuple[str, ...]], ...]:
    """Where policies are tried, and which of them; worlds that nothing was trained on."""

    def variant(key: str, title: str, *overrides: tuple[str, Any]) -> Variant:
        return Variant(key, title, (("motion", "random"), ("horizon", 200), *overrides))

    alone = ("nlos", "uwb", "false", "accel")
    nlos, away = ("nlos", 0.3), "8 UAVs, room 20×30×4 m, 12 landmarks"
    return (
        (variant("default", "default"), ("mixed", *alone, "displacement")),
        (variant("nlos", "NLOS 30 %", nlos), ("mixed", "nlos", "huber-nlos")),
        (variant("uwb", "UWB wrongly believed", *_UWB), ("mixed", "uwb", "huber-uwb")),
        (variant("accel", "accelerometer bias", *_ACCEL), ("mixed", "accel")),
        (variant("false", "false matches 10 %", ("false_matches", 0.1)), ("mixed", "false")),
        (variant("away", away, *_AWAY), ("mixed", "displacement")),
        (
            variant("away-nlos", "the same + NLOS 30 %", *_AWAY, nlos),
            ("mixed", "nlos", "huber-nlos"),
        ),
        (
            variant("away-uwb", "the same, UWB wrongly believed", *_AWAY, *_UWB),
            ("mixed", "uwb", "huber-uwb"),
        ),
    )


def plan() -> Plan:
    """The study's own, with the specification's figures to beat."""
    huber = "ekf:robust=huber"
    targets = (
        Target("nlos", "nlos", "ekf", 38),
        Target("uwb", "uwb", "ekf", 65),
        Target("uwb", "uwb", huber, 40),
        Target("accel", "accel", "ekf", 50),
        Target("false", "false", "ekf", 60),
        Target("huber-nlos", "nlos", huber, 5, clear=True),
        Target("huber-uwb", "uwb", huber, 55),
        Target("mixed", "nlos", "ekf", 30),
        Target("mixed", "false", "ekf", 60),
        Target("mixed", "uwb", "ekf", 50),
        Target("mixed", "default", "ekf", -5),
    )
    return Plan(_policies(), _worlds(), targets)
