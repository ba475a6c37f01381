"""Who runs where: the paper's cases, the detector's scenarios, and the study beyond; and the
measures of restarted filters."""

from collections.abc import Iterable, Iterator
from itertools import product

import numpy as np

from coloc_env.scenarios import parse_overrides
from training.evaluation import metrics
from training.evaluation.metrics import Flags, Floats
from training.learning.nnhpff import FAILED, MAINS, VARIANTS
from training.reproduce.cost import COST
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.work import Cell, Training, Variant

TITLE = "Neural-network-aided hybrid particle/FIR filter, *Electronics* 2025, 14(21), 4346"
RESIDUALS = "hpff:bank=false:detector=residuals"
METHODS = ("pf", "hpff:bank=false", "nnhpff:bank=false", RESIDUALS)
BESIDE = (
    "emvf",
    "ekf",
    "pf:tempering=true",
    "hpff:bank=false:main=ekf",
    "nnhpff:bank=false:main=ekf",
    f"{RESIDUALS}:main=ekf",
)
CASES = {
    1: "case 1: noise known",
    2: "case 2: R underestimated",
    3: "case 3: R overestimated",
}
MEMORIES, QUANTILES = (2, 5, 10), (0.95, 0.99)
KIDNAPPED_AT, INDOOR_KIDNAPPED_AT = 18.0, 30.0  # s
_INDOOR = (("anchors", 8), ("horizon", 600))  # four would lie in one plane through the room
INDOOR_METHODS = ("pfnn", *(f"{agent}:main=pfnn" for agent in METHODS[1:]))
INDOOR_BESIDE = ("ekf", "ekf:robust=huber", "nnhpff:bank=false:main=ekf", f"{RESIDUALS}:main=ekf")
PATIENT = "patience=4"  # steps: longer than an outlier stays in the FIR filter's window
FIRST_CORNER = 100  # step
SETTLED = 20  # step from which a filter's start is over
HELD = 10  # steps that an error must stay small to count as recovered
WITHIN = 100  # steps in which a recovery counts
LEARNING = Training(  # figure 4's: the paper's 27 scenarios once an epoch
    "nnhpff", "nnhpff", (("worlds", 1), ("epochs", 10), ("score_runs", 0))
)
Planned = tuple[Variant, tuple[str, ...]]


def paper(settings: Settings) -> Iterator[Cell]:
    """The three cases, and what a step costs."""
    for number in CASES:
        yield Cell(case(number, settings.steps), (*METHODS, *BESIDE), settings.runs)
    yield Cell(case(1, settings.steps), (*METHODS, "ekf"), 1, COST)


def detector(settings: Settings) -> Iterator[Cell]:
    """The detector watching, never restarting anything: worlds of its training's scenarios, and of
    others."""
    for variant, agents in (*trained_on(settings.steps), *never_seen(settings.steps)):
        yield Cell(variant, agents, settings.fraction(10))


def beyond(settings: Settings) -> Iterator[Cell]:
    """Sensitivity, kidnapping, NLOS, recordings."""
    steps = settings.steps
    planned: Iterable[Planned] = (
        *(*sensitivity(steps), *kidnapping(steps)),
        *(*blocked(steps), *recordings(steps)),
    )
    for variant, agents in planned:
        yield Cell(variant, agents, settings.fraction(_divisor(variant)))


def _divisor(variant: Variant) -> int:
    """Half the runs in the study beyond; a tenth indoors, with six UAVs; a twentieth of recordings,
    whose runs differ in their start alone."""
    if variant.key in {case(number).key for number in CASES}:
        return 1
    return {"indoor-v0": 10, "wsn-v0": 2}.get(variant.scenario, 20)


def trainings(settings: Settings) -> Iterator[Training]:
    """Figure 4's, with the whole study only."""
    if settings.variants is None and settings.steps is None:
        yield LEARNING


def case(number: int, steps: int | None = None, **overrides: float) -> Variant:
    """A case of the paper, with overrides."""
    key = "-".join((f"case{number}", *(f"{k}={v:g}" for k, v in overrides.items())))
    words = "".join(f", {k} = {v:g}" for k, v in overrides.items())
    return Variant(
        key, CASES[number] + words, (("case", number), *overrides.items()), "wsn-v0", steps
    )


def trained_on(steps: int | None = None) -> list[Planned]:
    """The detector's training scenarios, each with its main filter; in worlds of other seeds."""
    return [
        (variant_of("trained", text, steps), (open_loop(main),))
        for text, main in product(VARIANTS.split("/"), MAINS.split("/"))
    ]


def never_seen(steps: int | None = None) -> list[Planned]:
    """Scenarios that differ from all of those: in what is believed, in the true noise, in what goes
    wrong."""
    texts = (
        "q=0.015:believed_uwb_std=0.3162",
        "q=0.3:believed_uwb_std=0.08944",
        "case=3:uwb_std=0.1",
        "case=3:uwb_std=0.4",
        f"case=1:kidnap_at={KIDNAPPED_AT:g}",
        "case=3:nlos_anchor=1",
        "case=1:nlos=0.2",
    )
    mains = ("pf:particles=1000", "pf:particles=5000")
    return [
        (variant_of("unseen", text, steps), (open_loop(main),))
        for text, main in product(texts, mains)
    ]


def sensitivity(steps: int | None = None) -> list[Planned]:
    """How the verdicts move with σ, M, Q and the χ² quantile."""
    found: list[Planned] = []
    for number in CASES:
        own = (f"hpff:bank=false:quantile={q:g}" for q in QUANTILES)
        longer = (f"{a}:auxiliary=emvf@memory={m}" for a in METHODS[1:] for m in MEMORIES)
        found.append((case(number, steps), (*own, *longer)))
        for std in (0.1, 0.4):
            share = {1: 1.0, 2: 1 / 25, 3: 9.0}[number]
            believed = {"uwb_std": std, "believed_uwb_std": share**0.5 * std}
            found.append((case(number, steps, **believed), METHODS))
    for q in (0.001, 0.01, 0.03):
        found.append((case(3, steps, q=q), METHODS))
    for q in (0.01, 0.1):
        found.append((case(2, steps, q=q), METHODS))
    return found


def kidnapping(steps: int | None = None) -> list[Planned]:
    """The robot, and half a team, are put somewhere else."""
    half = (("kidnap_at", INDOOR_KIDNAPPED_AT), ("kidnapped", (0, 1, 2)), *_INDOOR)
    beside = ("ekf", "pf:tempering=true", "nnhpff:bank=false:main=ekf", f"{RESIDUALS}:main=ekf")
    return [
        (case(1, steps, kidnap_at=KIDNAPPED_AT), (*METHODS, *beside)),
        (case(3, steps, kidnap_at=KIDNAPPED_AT), (*METHODS, *beside)),
        (
            Variant("indoor-kidnapped", "three of six UAVs, indoors", half, steps=steps),
            (*INDOOR_METHODS, *INDOOR_BESIDE),
        ),
        (
            Variant(
                "indoor-kidnapped-blind",
                "the same without landmarks",
                (*half, ("landmarks", 0)),
                steps=steps,
            ),
            (*INDOOR_METHODS, *INDOOR_BESIDE),
        ),
    ]


def blocked(steps: int | None = None) -> list[Planned]:
    """An anchor all of whose ranges are NLOS, 1 m too long on average."""
    indoors = (("nlos_anchor", 1), *_INDOOR)
    return [
        (case(1, steps, nlos_anchor=1), (*METHODS, "ekf", "ekf:robust=huber")),
        (case(3, steps, nlos_anchor=1), (*METHODS, "ekf", "ekf:robust=huber")),
        (
            Variant("indoor-blocked", "indoors", indoors, steps=steps),
            (*INDOOR_METHODS, *INDOOR_BESIDE),
        ),
    ]


def recordings(steps: int | None = None) -> list[Planned]:
    """Real ranges to fixed anchors, believed to come from constant velocity."""

    def replay(
        key: str, title: str, name: str, memory: int, *overrides: tuple[str, str]
    ) -> Planned:
        emvf = f"emvf:memory={memory}"
        patient = tuple(
            f"{agent}:{PATIENT}:auxiliary={emvf.replace(':', '@')}" for agent in METHODS[1:]
        )
        agents = (*METHODS, *patient, emvf, "ekf", "ekf:robust=huber")
        return Variant(key, title, overrides, f"replay-{name}-v0", steps), agents

    courses = (
        *("LOS/Trajectory_A/Case_1", "LOS/Trajectory_B/Case_3"),
        *("NLOS/Trajectory_A/Case_1", "NLOS/Trajectory_B/Case_4"),
    )
    velocity = ("process", "constant_velocity")
    return [
        replay("tuc", "Chemnitz, labyrinth", "tuc", 12, velocity),
        *(
            replay(
                f"hanyang-{i}", f"Hanyang, {one.replace('_', ' ')}", "hanyang", 3, ("sequence", one)
            )
            for i, one in enumerate(courses, 1)
        ),
        replay(
            "miluv-1",
            "MILUV, one UAV",
            "miluv",
            30,
            ("sequence", "cirObstacles_1_random3_0"),
            velocity,
        ),
    ]


def kidnapped_step(variant: Variant) -> int:
    """The step at which a variant's UAVs are carried."""
    return round(float(dict(variant.overrides)["kidnap_at"]) / variant.build().arena.dt)


def kidnapped_uavs(variant: Variant) -> slice:
    """Those UAVs: the first ones."""
    return slice(0, len(dict(variant.overrides).get("kidnapped", (0,))))


def open_loop(main: str) -> str:
    """A filter that is watched by the network and never restarted."""
    return f"nnhpff:bank=false:main={main.replace(':', '@')}:threshold=1"


def variant_of(kind: str, text: str, steps: int | None) -> Variant:
    """A variant of wsn-v0 from overrides as on a command line."""
    overrides = tuple(parse_overrides("wsn-v0", text.split(":")).items())
    return Variant(
        f"{kind}-{text.replace(':', '-')}", text.replace(":", ", "), overrides, "wsn-v0", steps
    )


# ------------------------------------------------------------------ measures


def resets(one: Runs) -> Floats:
    """[R, K, N]: 1 where the main filter was restarted."""
    series = one.record.series.get("resets_per_run")
    return np.zeros_like(one.error) if series is None else series


def settled_error(one: Runs) -> Floats:
    """[R]: mean error after the first 2 s, m."""
    return metrics.mean_per_run(one.error[:, SETTLED:], one.scored[:, SETTLED:])


def resets_per_run(one: Runs) -> Floats:
    """[R], mean over UAVs."""
    return resets(one).sum(1).mean(-1)


def corner_peak(one: Runs) -> Floats:
    """[R]: largest error on the side after the first corner, m; NaN for runs cut before it."""
    side = one.error[:, FIRST_CORNER : 2 * FIRST_CORNER]
    return side.max(1).mean(-1) if side.size else np.full(len(side), np.nan)


def first_reset(one: Runs, after: int = FIRST_CORNER) -> Floats:
    """[R]: step of the first reset from step ``after`` on; infinity if there is none."""
    late = resets(one)[:, after:, 0] > 0
    if not late.size:
        return np.full(len(late), np.inf)
    return np.where(late.any(1), after + late.argmax(1), np.inf)


def recovery(one: Runs, step: int, uavs: slice) -> Floats:
    """[R, n]: seconds from ``step`` until the errors of some UAVs stay small for a second;
    infinity if that takes more than 10 s."""
    late = one.error[:, step : step + WITHIN + HELD, uavs] < FAILED
    windows = np.lib.stride_tricks.sliding_window_view(late, HELD, 1)
    held: Flags = np.asarray(windows.all(axis=-1))
    return one.dt * np.where(held.any(1), held.argmax(1).astype(float), np.inf)
