"""Who flies where: the paper's cases, the detector's scenarios, and the study beyond."""

from itertools import product

from coloc_env.scenarios import parse_override
from training.learning.nnhpff import MAINS, VARIANTS
from training.reproduce.study import Variant

TITLE = "Neural-network-aided hybrid particle/FIR filter, *Electronics* 2025, 14(21), 4346"
METHODS = ("pf", "hpff", "nnhpff")
BESIDE = ("emvf", "ekf", "pf:tempering=true", "hpff:main=ekf", "nnhpff:main=ekf")
CASES = {
    1: "case 1: noise known",
    2: "case 2: R underestimated",
    3: "case 3: R overestimated",
}
MEMORIES, QUANTILES = (2, 5, 10), (0.95, 0.99)
KIDNAPPED_AT, INDOOR_KIDNAPPED_AT = 18.0, 30.0  # s
_INDOOR = (("anchors", 4), ("horizon", 600))
INDOOR_METHODS = ("pfnn", "hpff:main=pfnn", "nnhpff:main=pfnn")
INDOOR_BESIDE = ("ekf", "ekf:robust=huber", "nnhpff:main=ekf")
PATIENT = "patience=4"  # steps: longer than an outlier stays in the FIR filter's window


def case(number: int, steps: int | None, **overrides: float) -> Variant:
    """A case of the paper, with overrides."""
    key = "-".join((f"case{number}", *(f"{k}={v:g}" for k, v in overrides.items())))
    words = "".join(f", {k} = {v:g}" for k, v in overrides.items())
    return Variant(
        key, CASES[number] + words, (("case", number), *overrides.items()), "wsn-v0", steps
    )


def trained_on(steps: int | None) -> list[tuple[Variant, str]]:
    """The detector's training scenarios, each with its main filter; in worlds of other seeds."""
    return [
        (_variant("trained", text, steps), _open_loop(main))
        for text, main in product(VARIANTS.split("/"), MAINS.split("/"))
    ]


def never_seen(steps: int | None) -> list[tuple[Variant, str]]:
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
        (_variant("unseen", text, steps), _open_loop(main)) for text, main in product(texts, mains)
    ]


def sensitivity(steps: int | None) -> list[tuple[Variant, tuple[str, ...]]]:
    """How the verdicts move with σ, M, Q and the χ² quantile."""
    found: list[tuple[Variant, tuple[str, ...]]] = []
    for number in CASES:
        own = (f"hpff:quantile={q:g}" for q in QUANTILES)
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


def kidnapping(steps: int | None) -> list[tuple[Variant, tuple[str, ...]]]:
    """The robot, and half a team, are put somewhere else."""
    half = (("kidnap_at", INDOOR_KIDNAPPED_AT), ("kidnapped", (0, 1, 2)), *_INDOOR)
    beside = ("ekf", "pf:tempering=true", "nnhpff:main=ekf")
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


def blocked(steps: int | None) -> list[tuple[Variant, tuple[str, ...]]]:
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


def recordings(steps: int | None) -> list[tuple[Variant, tuple[str, ...]]]:
    """Real ranges to fixed anchors, believed to come from constant velocity."""

    def replay(
        key: str, title: str, name: str, memory: int, *overrides: tuple[str, str]
    ) -> tuple[Variant, tuple[str, ...]]:
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


def runs_in(variant: Variant, runs: int) -> int:
    """Half the runs in the study beyond; a tenth indoors, where six UAVs fly; a twentieth of
    recordings, whose runs differ in their start alone."""
    if variant.key in {case(number, None).key for number in CASES}:
        return runs
    shares = {"indoor-v0": 10, "wsn-v0": 2}
    return max(1, runs // shares.get(variant.scenario, 20))


def scenario_runs(runs: int) -> int:
    """Runs of each of the detector's scenarios."""
    return max(1, runs // 10)


def kidnapped_step(variant: Variant) -> int:
    """The step at which a variant's UAVs are carried."""
    return round(float(dict(variant.overrides)["kidnap_at"]) / variant.build().arena.dt)


def kidnapped_uavs(variant: Variant) -> slice:
    """Those UAVs: the first ones."""
    return slice(0, len(dict(variant.overrides).get("kidnapped", (0,))))


def _open_loop(main: str) -> str:
    """A filter that is watched by the network and never restarted."""
    return f"nnhpff:main={main.replace(':', '@')}:threshold=1"


def _variant(kind: str, text: str, steps: int | None) -> Variant:
    """A variant of wsn-v0 from overrides as on a command line."""
    overrides = tuple(parse_override("wsn-v0", one) for one in text.split(":"))
    return Variant(
        f"{kind}-{text.replace(':', '-')}", text.replace(":", ", "), overrides, "wsn-v0", steps
    )
