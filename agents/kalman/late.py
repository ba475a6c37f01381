"""Fusion of messages that are late: the team's beliefs of some steps ago are fused, and each UAV
brings the outcome to the present by what it has sensed itself since."""

import torch
from jaxtyping import Bool, Float, Float32, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.kalman.filter import GaussianBelief, GaussianFilter
from agents.kalman.log import SensedLog
from agents.localizer import Estimate, Localizer
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed


class LateBelief(TensorClass):
    """The belief about ``message_delay`` steps ago, that about now by the UAV alone, what was
    sensed in the steps from then on (zeros before the first), and steps taken; batch (B, N)."""

    past: GaussianBelief
    now: GaussianBelief
    sensed: Float32[Tensor, "B N K F"]
    step: Int64[Tensor, "B N"]


class LateFusion(Localizer[LateBelief]):
    """A filter whose UAVs exchange beliefs, with messages that need D steps: those that arrive now
    are about step k − D, and so is what is fused."""

    name = "ekf"

    def __init__(self, believed: Believed, core: GaussianFilter) -> None:
        super().__init__(believed)
        self.core, self.log, self.delay = core, SensedLog(believed), believed.message_delay

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> LateBelief:
        start = self.core.reset(observation)
        return LateBelief(
            past=start,
            now=start.clone(),
            sensed=self.log.empty(observation, self.delay + 1),
            step=start.step,
            batch_size=start.batch_size,
        )

    def step(self, belief: LateBelief, observation: Observation) -> tuple[LateBelief, Estimate]:
        log = self.log.appended(belief.sensed, observation)
        past, now, estimate = belief.past, belief.past, None
        for age in range(self.delay, -1, -1):
            links = observation["links"] * (age == self.delay)
            sensed = self.log.leaves(log[..., -1 - age, :])
            leaves = {**observation.leaves, **sensed, "links": links}
            then, estimate = self.core.step(now, Observation(leaves))
            now = chosen(belief.step >= age, then, now)  # no step before the first
            past = now if age == self.delay else past
        assert estimate is not None
        after = build(
            LateBelief, belief.step.shape, past=past, now=now, sensed=log, step=belief.step + 1
        )
        return after, estimate

    def mean(self, belief: LateBelief) -> Float[Tensor, "B N S"]:
        return belief.now.state

    def shifted(self, belief: LateBelief, offset: Float[Tensor, "B N d"]) -> LateBelief:
        return belief.replace(past=belief.past.shifted(offset), now=belief.now.shifted(offset))

    def gaussian(
        self, belief: LateBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        return belief.now.state, belief.now.covariance

    def diagnostics(self, belief: LateBelief) -> dict[str, Float[Tensor, "B N"]]:
        return self.core.diagnostics(belief.past)


def chosen(rows: Bool[Tensor, "*s"], new: GaussianBelief, old: GaussianBelief) -> GaussianBelief:
    """``new`` in these rows, ``old`` in the others."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(rows.reshape(*rows.shape, *[1] * (a.dim() - rows.dim())), a, b)

    found: GaussianBelief = new.apply(pick, old)
    return found
