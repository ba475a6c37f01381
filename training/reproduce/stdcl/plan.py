"""Who flies where: the paper's simulations, stress, the learned part, the campus, recordings."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from training.reproduce.study import BOUNDS, WORLD, Piece, Study, Variant

TITLE = "Spatio-temporally decoupled cooperative localization, *Drones* 2026, 10(1), 69"
PARTS = ("paper", "stress", "learned", "campus", "real")
WHOLE, OPTIMIZER, HUBER = "stdcl", "dwmds_st", "dwmds_st:confidence=huber"
RIVALS = ("mds", "fcmds", "dwmds", "vmds")  # the paper's, in its order
LEARNED = "stgat"
METHODS = (*RIVALS, LEARNED, HUBER, OPTIMIZER, WHOLE)
REFERENCES = ("gn", "map")  # dear: they fly in fewer worlds
POSTERIOR, SNAPSHOT = BOUNDS
# Step by step from the optimizer to the whole, each with weights trained as it is flown.
ABLATION = {
    OPTIMIZER: "DW-MDS alone",
    "stdcl:weights=stdcl_attention": "+ attention, fed back",
    WHOLE: "+ convolutions: whole",
}
OPEN = "stdcl:weights=stdcl_open:feedback=none"  # trained with the loop open, flown so
UNFED = "stdcl:feedback=none"  # the whole's own weights, with the loop cut
PAPERS_FEEDBACK = "stdcl:feedback=paper"
CLOSED_AFTERWARDS = "stdcl:weights=stdcl_open:feedback=positions"
LOOPS = {
    OPEN: "trained without feedback",
    UNFED: "whole, loop cut",
    PAPERS_FEEDBACK: "whole, feedback of eq. 36",
    CLOSED_AFTERWARDS: "trained without, positions fed back",
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
FLIGHTS = {"s1": "S1: formation over the court", "s2": "S2: split", "s3": "S3: patrol"}
LONG = 1000  # steps of the loop's long run


@dataclass(frozen=True)
class Scene:
    """A variant and who flies in it: ``agents`` in ``runs`` worlds, ``few`` in the first ``some``
    of them; ``bounds`` over the first ``bounded``."""

    variant: Variant
    agents: tuple[str, ...]
    runs: int
    few: tuple[str, ...] = ()
    some: int = 0
    bounds: tuple[str, ...] = ()
    bounded: int = 1

    @property
    def blocks(self) -> tuple[int, ...]:
        """Runs of each piece; the first one is what ``few`` fly."""
        first = self.some or self.runs
        return (first, self.runs - first) if first < self.runs else (self.runs,)

    def pieces(self, study: Study) -> Iterator[Piece]:
        """All that is to be computed."""
        for agent in (WORLD, *self.agents):
            yield from study.pieces(self.variant, agent, *self.blocks)
        for agent in self.few:
            yield from study.pieces(self.variant, agent, self.blocks[0])
        for which in self.bounds:
            yield from study.pieces(self.variant, which, self.bounded)


def merged(scenes: Iterable[Scene]) -> dict[str, Scene]:
    """Scenes by their variant's key; several of one variant become one, in which those who fly in
    fewer worlds are ``few``."""
    found: dict[str, Scene] = {}
    for scene in scenes:
        key = scene.variant.key
        found[key] = _together(found[key], scene) if key in found else scene
    return found


def _together(a: Scene, b: Scene) -> Scene:
    many, other = (a, b) if a.runs >= b.runs else (b, a)
    alike = many.runs == other.runs
    agents = tuple(dict.fromkeys((*many.agents, *(other.agents if alike else ()))))
    few = (*many.few, *other.few, *(() if alike else other.agents))
    return replace(
        many,
        agents=agents,
        few=tuple(agent for agent in dict.fromkeys(few) if agent not in agents),
        some=min(many.blocks[0], other.blocks[0]),
        bounds=tuple(dict.fromkeys((*many.bounds, *other.bounds))),
        bounded=max(s.bounded for s in (many, other)),
    )


@dataclass(frozen=True)
class Plan:
    """All scenes of a study of ``runs`` worlds, at most ``steps`` long, of swarms of ``n_uavs``."""

    runs: int
    steps: int | None = None
    n_uavs: int = 200

    @property
    def some(self) -> int:
        """Runs of what is dear, and beyond the main table: five of fifty."""
        return max(1, self.runs // 10)

    @property
    def bounded(self) -> int:
        """Runs of the bounds of swarms, which differ little between worlds."""
        return max(1, self.runs // 25)

    def scenes(self, part: str) -> list[Scene]:
        """Of one of ``PARTS``."""
        return {
            "paper": self.paper,
            "stress": self.stress,
            "learned": self.learned,
            "campus": self.campus,
            "real": self.real,
        }[part]()

    # ---------------------------------------------------------------- variants

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

    # ---------------------------------------------------------------- scenes

    def paper(self) -> list[Scene]:
        """Figures 4 to 9."""
        found = [
            self._swarm(self.speed(v_max), METHODS, self.runs, bounded=self.some)
            for v_max in (FAST, MODERATE)
        ]
        found += [self._swarm(self.layout(name), METHODS) for name in ("u", "o")]
        return found + [self._swarm(self.radius(metres), METHODS) for metres in RADII]

    def stress(self) -> list[Scene]:
        """Figures 10 and 11, and more of the kind."""
        confidences = tuple(f"{OPTIMIZER}:confidence={c}" for c in CONFIDENCES)
        nlos = [self._stressed(self.share(x), confidences) for x in SHARES]
        others = [
            *(self.tail(x) for x in TAILS),
            *(self.lasting(x) for x in (0.15, 0.5)),
            *(self.sparse(x) for x in SPARSE),
            *(self.failing(x) for x in FAILURES),
            self.stressed("nodes-0.3", "nodes failing 30 % a run", failure_rate=0.3),
            *(self.drifting(x) for x in (0.3, 1.0)),
        ]
        return nlos + [self._stressed(variant) for variant in others]

    def learned(self) -> list[Scene]:
        """What each part of the network adds, what the loop does, and whether it is stable."""
        agents = (HUBER, *ABLATION, *LOOPS)
        where = [self.speed(MODERATE), *self.held_out().values()]
        found = [Scene(v, agents, self.some) for v in where]
        return [*found, Scene(self.long(), (OPTIMIZER, WHOLE, UNFED), self.some)]

    def campus(self) -> list[Scene]:
        """Section 6's flights, simulated."""
        agents = (*METHODS, *REFERENCES)
        count = {"s1": 2 * self.some, "s2": 2 * self.some, "s3": self.some}
        return [Scene(self.flight(name), agents, count[name]) for name in FLIGHTS]

    def real(self) -> list[Scene]:
        """Recordings; runs differ in what is drawn at their start."""
        agents = (*METHODS, *REFERENCES, "ekf")
        later = ("span", (60.0, 208.0))  # on the first minute noise settings were chosen
        return [
            Scene(
                Variant(key, title, overrides, scenario, self.steps, bounded=False),
                agents,
                self.some,
            )
            for key, title, scenario, overrides in (
                ("tiers", "TIERS: four ground robots", "replay-tiers-v0", (later,)),
                (
                    "tiers-cv",
                    "TIERS without velocities",
                    "replay-tiers-v0",
                    (later, ("process", "constant_velocity"), ("anchor_robots", (5, 4))),
                ),
                ("miluv", "MILUV: three UAVs", "replay-miluv-v0", ()),
            )
        ]

    def _swarm(
        self, variant: Variant, agents: tuple[str, ...], runs: int = 0, bounded: int = 0
    ) -> Scene:
        """With the references in a few worlds, and the bounds."""
        return Scene(
            variant,
            agents,
            runs or self.some,
            REFERENCES,
            self.some,
            (POSTERIOR, SNAPSHOT),
            bounded or self.bounded,
        )

    def _stressed(self, variant: Variant, beside: tuple[str, ...] = ()) -> Scene:
        agents = tuple(dict.fromkeys((*METHODS, *beside)))
        return Scene(
            variant,
            agents,
            self.some,
            ("map",),
            self.some,
            (POSTERIOR, SNAPSHOT),
            self.bounded,
        )
