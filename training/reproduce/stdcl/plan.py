"""Who runs where: the paper's simulations, stress, the learned part, the campus, recordings."""

from collections.abc import Iterator
from dataclasses import dataclass

from training.reproduce.cost import COST
from training.reproduce.settings import Settings
from training.reproduce.work import POSTERIOR, SNAPSHOT, Cell, Kind, Variant

TITLE = "Spatio-temporally decoupled cooperative localization, *Drones* 2026, 10(1), 69"
WHOLE, OPTIMIZER, HUBER = "stdcl:variant=calibrated", "dwmds_st", "dwmds_st:confidence=huber"
RIVALS = ("mds", "fcmds", "dwmds", "vmds")  # the paper's, in its order
LEARNED = "stgat"
# The paper's own: Huber's loss times equation 17, corrections, the feedback of equation 36.
PAPERS_OPTIMIZER, PAPERS_LOOP = "dwmds_st:confidence=paper", "stdcl:variant=paper"
METHODS = (*RIVALS, LEARNED, HUBER, OPTIMIZER, WHOLE, PAPERS_LOOP)
REFERENCES = ("gn", "map")  # expensive: they run in fewer worlds
# Step by step from the optimizer to the whole, each with weights trained as it is used.
ABLATION = {
    OPTIMIZER: "DW-MDS alone",
    f"{WHOLE}:weights=stdcl_attention": "+ attention, fed back",
    WHOLE: "+ convolutions: whole",
}
OPEN = f"{WHOLE}:weights=stdcl_open:feedback=none"  # trained with the loop open, used so
UNFED = f"{WHOLE}:feedback=none"  # the whole's own weights, with the loop cut
# Of the paper's own, each with weights trained in its own loop.
PAPERS_UNFED = "stdcl:variant=paper:feedback=none"
PAPERS_FEEDBACK = "stdcl:variant=paper:weights=none"  # equation 36 alone, without a network
PAPERS_LEARNED = "stdcl:variant=paper:feedback=learned:weights=stdcl_paper_learned"
CLOSED_AFTERWARDS = f"{WHOLE}:weights=stdcl_open:feedback=positions"
LOOPS = {
    OPEN: "trained without feedback",
    UNFED: "whole, loop cut",
    CLOSED_AFTERWARDS: "trained without, positions fed back",
}
PAPERS = {
    PAPERS_OPTIMIZER: "the paper's optimizer alone",
    PAPERS_FEEDBACK: "+ feedback of eq. 36, no network",
    PAPERS_LOOP: "+ network trained in that loop: the paper's whole",
    PAPERS_UNFED: "the same, loop cut",
    PAPERS_LEARNED: "network trained with learned feedback",
}
CONFIDENCES = ("none", "paper", "huber")  # beside the optimizer's own, calibrated

FAST, MODERATE, SLOW = 100.0, 50.0, 10.0  # v_max in m/s
RADII = (1500.0, 2000.0, 2500.0, 3000.0, 3500.0, 4000.0, 5000.0)  # m
SHARES = (0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5)  # of NLOS ranges
TAILS = (0.1, 0.2, 0.3, 0.5)  # of ranges with 50 m of noise
SPARSE = (1230.0, 1500.0, 1750.0, 2000.0, 2500.0, 3500.0)  # m: degree 2.5 to 35
FAILURES = (0.25, 0.4)
GROWTH = (20, 50, 100, 200, 500, 1000)
JOINT_UP_TO = 200  # UAVs: beyond, full covariances are not timed
CONFIDENCES_OF = tuple(f"{OPTIMIZER}:confidence={c}" for c in CONFIDENCES)
# Whose links are recorded.
WATCHED = (WHOLE, PAPERS_LOOP, OPTIMIZER, f"{OPTIMIZER}:confidence=none")
FLIGHTS = {"s1": "S1: formation over the court", "s2": "S2: split", "s3": "S3: patrol"}
LONG = 1000  # steps of the loop's long run


_LINKS = "training.reproduce.stdcl.links"
LINKS = Kind("links", f"{_LINKS}:record_links", f"{_LINKS}:load_links", (_LINKS,))
LOOP = Kind("loop", f"{_LINKS}:record_loop", f"{_LINKS}:load_loop", (_LINKS,))


@dataclass(frozen=True)
class Worlds:
    """The variants, at most ``steps`` long, with swarms of ``n_uavs`` where that is not varied."""

    n_uavs: int = 200
    steps: int | None = None

    def swarm(self, key: str, title: str, **overrides: float | str) -> Variant:
        """``swarm-v0`` with overrides."""
        sized = {} if self.n_uavs == 200 else {"n_uavs": self.n_uavs}
        return Variant(
            key, title, tuple((overrides | sized).items()), "swarm-v0", self.steps, bounded=False
        )

    def speed(self, v_max: float) -> Variant:
        """The main table's worlds."""
        return self.swarm(f"v{v_max:g}", f"v_max {v_max:g} m/s", v_max=v_max)

    def layout(self, name: str) -> Variant:
        """Random worlds are those of the main table."""
        if name == "random":
            return self.speed(MODERATE)
        return self.swarm(f"layout-{name}", f"{name.upper()}-shaped", layout=name)

    def radius(self, metres: float) -> Variant:
        """Figure 8's worlds, at 10 m/s; with the usual reach they are those of figure 7."""
        if metres == RADII[-1]:
            return self.speed(SLOW)
        words = f"R = {metres:g} m"
        return self.swarm(f"radius-{metres:g}", words, v_max=SLOW, comm_radius=metres)

    def stressed(self, key: str, title: str, **overrides: float | str) -> Variant:
        """Worlds at 50 m/s whose INS has no bias."""
        return self.swarm(key, title, ins_bias=0.0, **overrides)

    def share(self, nlos: float) -> Variant:
        """So many NLOS ranges, 25 m too long."""
        return self.stressed(f"nlos-{nlos:g}", f"NLOS {100 * nlos:g} %", nlos=nlos)

    def tail(self, share: float) -> Variant:
        """So many ranges with 50 m of noise instead."""
        if share == 0:
            return self.share(0.0)
        words = f"mixture {100 * share:g} %"
        return self.stressed(f"mixture-{share:g}", words, nlos=0.0, uwb_tail=share)

    def sparse(self, metres: float) -> Variant:
        """A shorter reach."""
        return self.stressed(f"sparse-{metres:g}", f"R = {metres:g} m", comm_radius=metres)

    def failing(self, share: float) -> Variant:
        """Links that break."""
        words = f"links failing {100 * share:g} %"
        return self.stressed(f"links-{share:g}", words, link_failure=share)

    def lasting(self, share: float) -> Variant:
        """NLOS that stays for 10 s."""
        words = f"persistent NLOS {100 * share:g} %"
        return self.stressed(f"persistent-{share:g}", words, nlos=share, nlos_time=10.0)

    def drifting(self, bias: float) -> Variant:
        """An INS with a bias; 0.3 m/s is the main table's."""
        if bias == 0.3:
            return self.speed(MODERATE)
        return self.swarm(f"ins-{bias:g}", f"INS bias {bias:g} m/s", ins_bias=bias)

    def held_out(self) -> dict[str, Variant]:
        """What no training has seen, by name: manoeuvre, layouts, sparse networks with INS bias."""
        sparse = self.swarm("sparse-biased", "R = 1500 m, INS bias 0.3 m/s", comm_radius=1500.0)
        weave = self.swarm("weave", "interweaving, random layout", motion="weave")
        both = self.swarm("weave-o", "interweaving, O-shaped", motion="weave", layout="o")
        return {
            "weave": weave,
            "u": self.layout("u"),
            "o": self.layout("o"),
            "weave-o": both,
            "sparse": sparse,
        }

    def long(self) -> Variant:
        """A run that is ten times as long."""
        return self.swarm("long", f"{LONG} steps", horizon=LONG)

    def timed(self, n_uavs: int) -> Variant:
        """Where steps are timed: fewer of them in large swarms."""
        steps = {500: 10, 1000: 5}.get(n_uavs, 50)
        overrides = (("n_uavs", n_uavs), ("v_max", SLOW), ("horizon", steps))
        return Variant(f"time-{n_uavs}", f"N = {n_uavs}", overrides, "swarm-v0", self.steps)

    def flight(self, name: str) -> Variant:
        """One of the paper's three flights over a campus."""
        return Variant(
            f"campus-{name}",
            FLIGHTS[name],
            (("flight", name),),
            "campus-v0",
            self.steps,
            bounded=False,
        )

    def lighter(self) -> Variant:
        """The second flight about a building that ranges get through for longer: 1 dB a metre."""
        overrides = (("flight", "s2"), ("wall_loss", 1.0))
        return Variant(
            "campus-s2-light", "S2, a light building", overrides, "campus-v0", self.steps
        )

    def timed_flight(self) -> Variant:
        """Where steps of ten UAVs are timed."""
        overrides = (("flight", "s2"), ("horizon", 100))
        return Variant("time-campus", "ten UAVs", overrides, "campus-v0", self.steps)

    def recordings(self) -> list[Variant]:
        """Four ground robots, with and without velocities, and three UAVs."""
        later = ("span", (60.0, 208.0))  # on the first minute noise settings were chosen
        slow = (("process", "constant_velocity"), ("anchor_robots", (5, 4)))
        return [
            Variant(key, title, overrides, f"replay-{name}-v0", self.steps, bounded=False)
            for key, title, name, overrides in (
                ("tiers", "TIERS: four ground robots", "tiers", (later,)),
                ("tiers-cv", "TIERS without velocities", "tiers", (later, *slow)),
                ("miluv", "MILUV: three UAVs", "miluv", ()),
            )
        ]


W = Worlds()  # for the variants' keys and titles


def _worlds(n_uavs: int, settings: Settings) -> Worlds:
    return Worlds(n_uavs, settings.steps)


def paper(n_uavs: int, settings: Settings) -> Iterator[Cell]:
    """Figures 4 to 9, and what steps cost."""
    worlds, some = _worlds(n_uavs, settings), settings.fraction(10)
    for v_max in (FAST, MODERATE):
        yield from _bounded(worlds.speed(v_max), METHODS, settings.runs, settings, some)
    others = [*(worlds.layout(x) for x in ("u", "o")), *(worlds.radius(x) for x in RADII)]
    for variant in others:
        yield from _bounded(variant, METHODS, some, settings)
    for n in GROWTH:
        joint = REFERENCES if n <= JOINT_UP_TO else ()
        yield Cell(worlds.timed(n), (*METHODS, *joint), 1, COST)


def stress(n_uavs: int, settings: Settings) -> Iterator[Cell]:
    """Figures 10 and 11, and more of the kind."""
    for variant in stressed(_worlds(n_uavs, settings)):
        beside = CONFIDENCES_OF if variant.key.startswith("nlos-") else ()
        agents = tuple(dict.fromkeys((*METHODS, *beside)))
        yield from _bounded(variant, agents, settings.fraction(10), settings, few=("map",))


def stressed(worlds: Worlds) -> list[Variant]:
    """The variants under stress."""
    return [
        *(worlds.share(x) for x in SHARES),
        *(worlds.tail(x) for x in TAILS),
        *(worlds.lasting(x) for x in (0.15, 0.5)),
        *(worlds.sparse(x) for x in SPARSE),
        *(worlds.failing(x) for x in FAILURES),
        worlds.stressed("nodes-0.3", "nodes failing 30 % a run", failure_rate=0.3),
        *(worlds.drifting(x) for x in (0.3, 1.0)),
    ]


def learned(n_uavs: int, settings: Settings) -> Iterator[Cell]:
    """What each part of the network adds, what the loop does, and whether it is stable."""
    worlds, some = _worlds(n_uavs, settings), settings.fraction(10)
    for variant in (worlds.speed(MODERATE), *worlds.held_out().values()):
        yield Cell(variant, (HUBER, *ABLATION, *LOOPS, *PAPERS), some)
    yield Cell(worlds.long(), (OPTIMIZER, WHOLE, UNFED), some)
    for variant in (worlds.speed(MODERATE), worlds.lasting(0.15), worlds.lasting(0.5)):
        yield Cell(variant, tuple(PAPERS), some)
    yield Cell(worlds.long(), (WHOLE, PAPERS_LOOP), 1, LOOP)


def campus(n_uavs: int, settings: Settings) -> Iterator[Cell]:
    """Section 6's flights, simulated; single runs whose links are recorded."""
    worlds, some = _worlds(n_uavs, settings), settings.fraction(10)
    for name in FLIGHTS:
        count = some if name == "s3" else 2 * some
        yield Cell(worlds.flight(name), (*METHODS, *REFERENCES), count)
    yield Cell(worlds.timed_flight(), (*METHODS, *REFERENCES), 1, COST)
    yield Cell(worlds.lighter(), WATCHED, 1, LINKS)
    yield Cell(worlds.flight("s2"), (OPTIMIZER,), 1, LINKS)


def real(n_uavs: int, settings: Settings) -> Iterator[Cell]:
    """Recordings; runs differ in what is drawn at their start."""
    for variant in _worlds(n_uavs, settings).recordings():
        yield Cell(variant, (*METHODS, *REFERENCES, "ekf"), settings.fraction(10))


def _bounded(
    variant: Variant,
    agents: tuple[str, ...],
    runs: int,
    settings: Settings,
    bounded: int = 0,
    few: tuple[str, ...] = REFERENCES,
) -> Iterator[Cell]:
    """With expensive agents in a ``few`` worlds, and the bounds, which differ little between
    worlds."""
    yield Cell(variant, agents, runs)
    yield Cell(variant, few, settings.fraction(10))
    for kind in (POSTERIOR, SNAPSHOT):
        yield Cell(variant, (), bounded or settings.fraction(25), kind)
