"""Time of a team's step of every localizer, each in worlds that it serves."""

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, cast

from agents import LOCALIZERS, make
from agents.factor_graph.pose_graph import PoseGraph
from agents.particle.hybrid import HybridFilter
from agents.slam.slam import Slam
from agents.stdcl.loop import NetworkLoop
from agents.stein.stein_vi import SteinViFilter
from agents.stein.team import RelativeTeam
from agents.swarm.filter import SwarmFilter
from coloc_env.scenarios import make_scenario
from training.bench.parts import PROFILED, step_parts
from training.evaluation.evaluate import ms_per_step

PARTICLES = (100, 300, 1000, 3000)
TEAMS = (2, 6, 12, 24)
COMPILED = ("pf800:compile=true", "pfnn:compile=true")
TITLES = {
    "agents": "agent, indoor-v0",
    "swarms": "agent, swarms",
    "relative": "agent, relative poses",
    "particles": "particles",
    "teams": "UAVs",
}
_EXTRA = {"pose_graph": "gtsam"}
_SWARMS = {"200 UAVs": "swarm-v0", "10 UAVs": "campus-v0"}
_RELATIVE = {"2-D": "stein2d-v0", "3-D": "stein3d-v0"}


@dataclass(frozen=True)
class Task:
    """An agent in a scenario, and the ``key`` of its time within the ``group``."""

    group: str
    key: str
    agent: str
    scenario: str
    overrides: tuple[tuple[str, Any], ...] = ()

    def ms(self) -> float | None:
        """Median time of a step; None if it raises a numerical error."""
        scenario = make_scenario(self.scenario, **dict(self.overrides))
        return ms_per_step(make(self.agent, scenario), scenario, 0)


def tasks() -> Iterator[Task]:
    """Every localizer where it belongs, and a particle filter by particles and team size."""
    for name in LOCALIZERS:
        if name not in _EXTRA or find_spec(_EXTRA[name]) is not None:
            yield from _at_home(name)
    if shutil.which("c++") or shutil.which("g++"):
        yield from (Task("agents", name, name, "indoor-v0") for name in COMPILED)
    yield from (Task("particles", str(m), f"pf800:particles={m}", "indoor-v0") for m in PARTICLES)
    yield from (Task("teams", str(n), "pf800", "indoor-v0", (("n_uavs", n),)) for n in TEAMS)


def time_agents(
    quick: bool, tracked: Callable[[Sequence[Task], str], Iterable[Task]]
) -> dict[str, dict[str, Any]]:
    """Milliseconds by group and key, None where there is no time, and ``parts``: where the time of
    a step goes. ``quick``: of one agent only."""
    every = list(tasks())
    found: dict[str, dict[str, Any]] = {group: {} for group in TITLES}
    for task in tracked(every[:1] if quick else every, "agents"):
        found[task.group][task.key] = task.ms()
    scenario = make_scenario("indoor-v0")
    profiled = PROFILED[:1] if quick else PROFILED
    return found | {
        "parts": {name: step_parts(make(name, scenario), scenario) for name in profiled}
    }


def _at_home(name: str) -> Iterator[Task]:
    kind = cast(type, LOCALIZERS[name])
    if issubclass(kind, SwarmFilter | NetworkLoop):
        for words, scenario in _SWARMS.items():
            yield Task("swarms", f"{name}, {words}", name, scenario)
    elif issubclass(kind, RelativeTeam):
        # A graph is timed where it is solved, not in between.
        agent = f"{name}:every=1" if issubclass(kind, PoseGraph) else name
        for words, scenario in _RELATIVE.items():
            yield Task("relative", f"{agent}, {words}", agent, scenario)
    else:
        anchors = 4 if issubclass(kind, HybridFilter) else 0  # it refuses a team without
        overrides: tuple[tuple[str, Any], ...] = (("anchors", anchors),)
        if issubclass(kind, SteinViFilter):  # it refuses a team with ranges
            overrides = (*overrides, ("uwb", False))
        if issubclass(kind, Slam):  # it refuses a team with a map
            overrides = (*overrides, ("landmarks_known", False))
        yield Task("agents", name, name, "indoor-v0", overrides)
