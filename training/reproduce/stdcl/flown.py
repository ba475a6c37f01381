"""All that the report is made from: what was flown, by variant and agent."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from coloc_env.bounds import Bound
from training.reproduce.cost import Cost
from training.reproduce.stdcl.links import Loop, Watched
from training.reproduce.stdcl.measures import Runs
from training.reproduce.stdcl.plan import Scene
from training.reproduce.study import BOUNDS, WORLD, Study

Teams = Mapping[str, Runs]  # by agent


@dataclass(frozen=True, eq=False)
class Flown:
    """What a study holds: ``cost`` of steps by variant's key and agent; links of single runs
    ``watched`` about a light building, by agent, and of one that is ``parted``; confidences of a
    long ``loop``."""

    study: Study
    scenes: Mapping[str, Scene]
    cost: Mapping[str, Mapping[str, Cost]]
    watched: Mapping[str, Watched]
    parted: Watched | None
    loop: Loop | None
    _kept: dict[str, dict[str, Runs]] = field(default_factory=dict)

    def runs(self, key: str) -> Teams:
        """Agents that were flown in a variant; none where its worlds are not there."""
        if key not in self._kept:
            self._kept[key] = self._loaded(key)
        return self._kept[key]

    def bound(self, key: str, which: str) -> Bound | None:
        """A bound of a variant, if there is one."""
        scene = self.scenes.get(key)
        if scene is None or which not in scene.bounds or not self.study.can(scene.variant):
            return None
        return self.study.bound(scene.variant, which, scene.bounded)

    def find(self, key: str, what: str) -> Any:
        """A variant's bound (of ``BOUNDS``), the cost of an agent (``ms:AGENT``), or an agent's
        runs; None if it is not there."""
        if what in BOUNDS:
            return self.bound(key, what)
        if what.startswith("ms:"):
            return self.cost.get(key, {}).get(what.removeprefix("ms:"))
        return self.runs(key).get(what)

    def _loaded(self, key: str) -> dict[str, Runs]:
        scene = self.scenes.get(key)
        if scene is None or not self.study.can(scene.variant):
            return {}
        found = self.study.results(scene.variant, [WORLD, *scene.agents], *scene.blocks)
        runs = {agent: Runs(found, agent) for agent in found.agents}
        if scene.few:
            found = self.study.results(scene.variant, scene.few, scene.blocks[0])
            runs |= {agent: Runs(found, agent) for agent in found.agents}
        return runs
