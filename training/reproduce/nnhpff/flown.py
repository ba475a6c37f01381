"""All that the report is made from: what was flown, by variant and agent."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from training.evaluation.metrics import Flags, Floats
from training.learning.nnhpff import FAILED
from training.reproduce.cost import Cost
from training.reproduce.nnhpff.measures import Runs
from training.reproduce.study import WORLD, Study, Variant


@dataclass(frozen=True, eq=False)
class Detections:
    """Samples of a detector that only watches: the network's probability, the Mahalanobis distance,
    the estimate's error (m)."""

    probability: Floats
    distance: Floats
    error: Floats

    @property
    def failed(self) -> Flags:
        return self.error > FAILED


@dataclass(frozen=True, eq=False)
class Flown:
    """What a study holds; ``cost`` of the methods' steps; ``learning``: a training's curve, samples
    seen and cross-entropy on worlds it had not seen then."""

    study: Study
    cost: dict[str, Cost]
    learning: Floats | None

    def runs(self, variant: Variant, agents: Sequence[str], count: int) -> dict[str, Runs]:
        """Those that were flown, by agent; none where the worlds are not there."""
        if not self.study.can(variant):
            return {}
        results = self.study.results(variant, [WORLD, *agents], count)
        return {a: Runs(results, a) for a in agents if a in results.agents}

    def detections(self, scenes: Sequence[tuple[Variant, str]], count: int) -> Detections | None:
        """All samples of several scenarios, each with its filter."""
        parts: list[tuple[Floats, Floats, Floats]] = []
        for variant, agent in scenes:
            for one in self.runs(variant, [agent], count).values():
                series, scored = one.one.series, one.results.worlds.scored
                told = series["failure"], series["mahalanobis"], one.error
                parts.append(tuple(x[scored] for x in told))  # type: ignore[arg-type]
        if not parts:
            return None
        return Detections(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def learning_curve(folder: Path) -> Floats | None:
    """[E, 2] of a training's folder, if it is there."""
    file = folder / "metrics" / "scalars" / "held_out_loss.csv"
    return np.loadtxt(file, delimiter=",", ndmin=2) if file.is_file() else None
