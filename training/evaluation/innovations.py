"""What can be said of a filter without truth: are its innovations as large, and as white, as it
believes?

NIS νᵀ S⁻¹ ν of each sensor with the band of a consistent filter, correlation of one innovation of
a link with the next, the share that a χ² gate would reject, and the predicted deviation
(Bar-Shalom, Li & Kirubarajan 2001, section 5.4).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.kalman.filter import GaussianBelief, GaussianFilter, predict
from agents.localizer import Localizer
from agents.models.measurements import model_of, received
from agents.robust.mahalanobis import chi_square, mahalanobis_squared
from coloc_env.motion import RecordedMotion
from coloc_env.scenario import Scenario
from training.evaluation.metrics import nees_band
from training.evaluation.rollout import Breakdown, Step, rollout

GATE = 0.999  # probability that a consistent innovation passes
_STEPS = 5  # at the start, while a vague prior settles, that do not count


@dataclass
class _Sums:
    """Running sums over the measurements of one sensor: of NIS, of those beyond the gate, of
    products of successive innovations of one link and of their squares."""

    size: int = 1
    count: int = 0
    nis: float = 0.0
    rejected: int = 0
    pairs: int = 0
    product: float = 0.0
    squares: float = 0.0
    last: Tensor | None = field(default=None, repr=False)

    def add(
        self,
        squared: Float[Tensor, "B N m"],
        scaled: Float[Tensor, "B N m"],
        there: Bool[Tensor, "B N m"],
    ) -> None:
        self.count += int(there.sum())
        self.nis += float(squared[there].sum())
        self.rejected += int((squared[there] > chi_square(GATE, self.size)).sum())
        before = torch.full_like(scaled, torch.nan) if self.last is None else self.last
        both = there & ~before.isnan()
        self.pairs += int(both.sum())
        self.product += float((scaled * before)[both].sum())
        self.squares += float((scaled[both] ** 2 + before[both] ** 2).sum()) / 2
        self.last = torch.where(there, scaled, before)

    def figures(self, name: str) -> dict[str, float]:
        low, high = nees_band(self.size, max(1, self.count))
        return {
            f"nis_{name}": self.nis / self.count if self.count else float("nan"),
            f"nis_{name}_low": low,
            f"nis_{name}_high": high,
            f"whiteness_{name}": self.product / self.squares if self.squares else float("nan"),
            f"whiteness_{name}_band": 1.96 / self.pairs**0.5 if self.pairs else float("nan"),
            f"rejected_{name}": self.rejected / self.count if self.count else float("nan"),
        }


def tracked(scenario: Scenario) -> bool:
    """Whether there is truth to score against at most steps."""
    return not isinstance(scenario.motion, RecordedMotion) or scenario.motion.tracked


def innovations(
    localizer: Localizer, scenario: Scenario, seeds: Tensor, device: str | torch.device = "cpu"
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Figures of a localizer without truth, flat by name, and the sensors that they are of.

    Of a localizer that is no Kalman filter the predicted deviation alone (m per axis, root mean
    square).
    """
    believed = scenario.believed
    kinds = [(sensor, model_of(type(sensor))) for sensor in believed.sensors]
    models = {_name(type(sensor).__name__): model(sensor) for sensor, model in kinds if model}
    gaussian = isinstance(localizer, GaussianFilter)
    sums = {name: _Sums() for name in models} if gaussian else {}
    before: GaussianBelief | None = None
    variance: list[float] = []

    def look(step: Step) -> None:
        observation = step.observation
        assert isinstance(localizer, GaussianFilter)
        assert before is not None
        x, covariance, _ = predict(localizer.process, before, observation)
        heard = received(believed, observation)
        for name, model in models.items():
            block = model.linearize(localizer.process, x, observation, heard)
            squared = mahalanobis_squared(block, covariance)
            spread = (block.jacobian @ covariance.unsqueeze(2) @ block.jacobian.mT).diagonal(
                dim1=-2, dim2=-1
            ) + block.total_variance
            scaled = (block.residual / spread.sqrt())[..., 0]
            there = block.mask & squared.isfinite()
            sums[name].size = block.residual.shape[-1]
            sums[name].add(squared, scaled, there)

    try:
        for step in rollout(localizer, scenario, seeds, device=device):
            if gaussian and step.k >= _STEPS:
                look(step)
            if gaussian:
                before = step.belief
            if step.estimate is not None:
                each = step.estimate.covariance.diagonal(dim1=-2, dim2=-1)
                variance.append(float(each.mean()))
    except Breakdown:
        return {}, ()
    figures: dict[str, float] = {"predicted_std": float(np.sqrt(np.mean(variance)))}
    for name, found in sums.items():
        figures |= found.figures(name)
    return figures, tuple(sums)


def disagreement(offsets: Mapping[str, np.ndarray]) -> dict[str, float]:
    """How far each method's estimates [R, K, N, d] are from the mean of the others' (m, root mean
    square)."""
    found = {}
    for name, own in offsets.items():
        others: Sequence[np.ndarray] = [each for other, each in offsets.items() if other != name]
        if others:
            apart = own.astype(np.float64) - np.mean(others, axis=0)
            found[name] = float(np.sqrt((apart**2).sum(-1).mean()))
    return found


def _name(sensor: str) -> str:
    """``AnchorRanging`` as ``anchor_ranging``."""
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in sensor).lstrip("_")
