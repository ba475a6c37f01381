"""The cooperative error-state EKF, one filter per UAV.

Roumeliotis & Bekey 2002 with the error state on the manifold: (δp, δv, δθ) and, where the team
believes in them, IMU biases. Ranges to neighbours use their broadcast estimate *and* its
uncertainty. What the UAVs' estimates have in common is ignored by that (``fusion="naive"``), so the
filter can grow overconfident; ``fusion="ci"`` never does, at a price.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from agents.kalman.filter import GaussianFilter
from agents.models.measurements import Block, Neighbours, make_measurements, received
from agents.models.update import information, iterated_update, posterior
from agents.robust import Fixed, Prediction, RobustScreen, Screen, Trust
from coloc_env.observation import Observation
from coloc_env.options import OpenShare, PositiveCount
from coloc_env.scenario import Believed

# Weights tried by covariance intersection.
_OMEGA = (1.0, 0.99, 0.97, 0.93, 0.87, 0.8, 0.7, 0.55, 0.4)


class CooperativeEkf(GaussianFilter):
    """Cooperative error-state EKF, one per UAV, fed by neighbours' messages.

    ``robust``: ``none``, or any of these joined by ``+``: ``huber`` reweights at every iteration;
    ``gate`` drops innovations outside the χ² quantile ``gate``, ``ransac`` landmarks that do not
    agree with most others, ``temporal`` what does not agree with the last two steps, ``cross`` what
    neighbours' measurements contradict. ``fusion``: ``naive``, or ``ci`` (split covariance
    intersection for everything that involves a neighbour). ``iterations`` of each update.
    ``cooperate=false`` leaves other UAVs out.
    """

    name = "ekf"

    def __init__(
        self,
        believed: Believed,
        *,
        robust: str = "none",
        gate: OpenShare = 0.999,
        fusion: Literal["naive", "ci"] = "naive",
        iterations: PositiveCount = 2,
        cooperate: bool = True,
    ) -> None:
        super().__init__(believed)
        self.iterations, self.fusion = iterations, fusion
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]
        self.screen: Screen = RobustScreen(self.process, self.models, robust, gate)

    @property
    def exchanges(self) -> bool:
        return self.screen.exchanges

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        return self.screen.memory(observation)

    def update(
        self, prior: Prediction
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N K"]]:
        if not self.models:
            return super().update(prior)
        neighbours = received(self.believed, prior.observation)
        found = iterated_update(prior, neighbours, self.screen, self.iterations)
        if self.fusion == "naive":
            return found.state, found.covariance, found.memory
        x, covariance = self._split(prior, neighbours, found.trusts)
        return x, covariance, found.memory

    def _split(
        self, prior: Prediction, neighbours: Neighbours, trusts: Sequence[Trust]
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        """First the UAV's own measurements, then an intersection with what involves neighbours;
        each trusted as in the naive update."""
        pairs = list(zip(self.models, trusts, strict=True))
        own = [pair for pair in pairs if not pair[0].cooperative]
        shared = [pair for pair in pairs if pair[0].cooperative]
        x, covariance = prior.state, prior.covariance
        if own:
            models, fixed = zip(*own, strict=True)
            screen = Fixed(self.process, models, fixed)
            found = iterated_update(prior, neighbours, screen, self.iterations)
            x, covariance = found.state, found.covariance
        if shared:
            models, fixed = zip(*shared, strict=True)
            blocks = [m.linearize(self.process, x, prior.observation, neighbours) for m in models]
            x, covariance = self._intersect(x, covariance, blocks, fixed)
        return x, covariance

    def _intersect(
        self,
        x: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
        blocks: Sequence[Block],
        trusts: Sequence[Trust],
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        """Split covariance intersection (Julier & Uhlmann 2001; Li & Nashashibi 2013): own
        covariance over ω, the neighbours' over 1 − ω, ω chosen for the least position variance."""
        d = self.process.dim
        best: tuple[Tensor, Tensor, Tensor] | None = None
        for omega in _OMEGA:
            if omega == 1.0:
                delta, updated = torch.zeros_like(covariance[..., 0]), covariance
            else:
                apart = [_inflated(block, 1 - omega) for block in blocks]
                delta, updated = posterior(covariance / omega, *information(apart, trusts))
            trace = updated[..., :d, :d].diagonal(dim1=-2, dim2=-1).sum(-1)
            if best is None:
                best = (trace, delta, updated)
            else:
                better = trace < best[0]
                best = (
                    torch.where(better, trace, best[0]),
                    torch.where(better[..., None], delta, best[1]),
                    torch.where(better[..., None, None], updated, best[2]),
                )
        assert best is not None
        return self.process.boxplus(x, best[1]), best[2]


def _inflated(block: Block, share: float) -> Block:
    """The block with its partners' uncertainty divided by their share of the weight."""
    assert block.partner_variance is not None
    return replace(block, partner_variance=block.partner_variance / share)
