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
from agents.models.measurements import (
    Block,
    Measurement,
    Neighbours,
    make_measurements,
    received,
)
from agents.models.measurements.second_order import expanded
from agents.models.ordered_update import by_kind, pick
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
    ``cooperate=false`` leaves other UAVs out. ``second_order``, with ``fusion=ci``: ranges are
    expanded to the second order, as ``ekf_joint`` has them, where priors are broad too.
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
        second_order: bool = False,
    ) -> None:
        super().__init__(believed)
        if second_order and fusion != "ci":
            raise ValueError(f"ekf: second_order=true is not allowed with fusion={fusion}: ci")
        self.iterations, self.fusion = iterations, fusion
        self.second_order = second_order
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
        if self.second_order:
            return self._expanded(prior, neighbours)
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

    def _expanded(
        self, prior: Prediction, neighbours: Neighbours
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N K"]]:
        """As ``_split``, with ranges' second-order terms, in one iteration."""
        x, covariance = prior.state, prior.covariance
        blocks = self._blocks(x, covariance, prior, neighbours, self.models)
        evidence = self.screen.judge(blocks, prior)
        trusts = self.screen.weigh(blocks, evidence, True)
        own, shared = by_kind(self.models)
        if own:
            known = information(pick(blocks, own), pick(trusts, own))
            delta, covariance = posterior(covariance, *known)
            x = self.process.boxplus(x, delta)
        if shared:
            models = pick(self.models, shared)
            blocks = self._blocks(x, covariance, prior, neighbours, models)
            x, covariance = self._intersect(x, covariance, blocks, pick(trusts, shared))
        memory = self.screen.remember(
            prior, evidence, lambda: self._blocks(x, covariance, prior, neighbours, self.models)
        )
        return x, covariance, memory

    def _blocks(
        self,
        x: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
        prior: Prediction,
        neighbours: Neighbours,
        models: Sequence[Measurement],
    ) -> list[Block]:
        """Measurements linearized at a state, ranges expanded to the second order."""
        d, observation = self.process.dim, prior.observation
        own = covariance[..., None, :d, :d]
        apart = own + torch.diag_embed(neighbours.variance)
        return [
            expanded(
                model,
                model.linearize(self.process, x, observation, neighbours),
                apart if model.cooperative else own,
                observation,
            )
            for model in models
        ]

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
