"""The unscented Kalman filter on the manifold, one per UAV (Julier & Uhlmann 1997)."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from agents.association import AssociationName, associated
from agents.kalman.filter import Beside, GaussianBelief, GaussianFilter, elapsed
from agents.models.measurements import (
    Measurement,
    Neighbours,
    make_measurements,
    per_state,
    received,
)
from agents.models.ordered_update import by_kind, pick
from agents.robust import Prediction, SoftName, Trust, soft_trust
from coloc_env.observation import Observation
from coloc_env.options import Quantity
from coloc_env.scenario import Believed

_BETA = 2.0  # the best for Gaussian errors
_GATE = 0.999  # of a landmark's pairing
_REWEIGHTED = 4  # updates of a prior: by plain variances, then by those at the state found

Alpha = Annotated[float, Quantity("", 1e-2, 10.0)]


class UnscentedFilter(GaussianFilter):
    """Unscented Kalman filter, one per UAV, fed by neighbours' messages as ``ekf`` is.

    2 E + 1 sigma points x ⊞ ±√(α² E) L eᵢ with P = L Lᵀ take the place of both Jacobians, in the
    motion and in the updates: by the UAV's own measurements, then by those that involve neighbours
    (E: size of the error; ``alpha``: how far out points are; β = 2, κ = 0; van der Merwe 2004).
    Noise adds, as in ``ekf``. ``cooperate=false`` leaves other UAVs out.

    ``robust``: Huber's weights or those of Student's t or of a mixture with wide tails, at the
    updated state: the prior is updated again by them, three times.
    ``association`` of landmarks that come without names, within 99.9 %: as ``ekf`` has it.
    """

    name = "ukf"
    associates = True

    def __init__(
        self,
        believed: Believed,
        *,
        alpha: Alpha = 1.0,
        cooperate: bool = True,
        robust: SoftName = "none",
        association: AssociationName = "joint",
    ) -> None:
        super().__init__(believed)
        self.association = associated(believed, self.process, association, _GATE)
        self.robust, self.iterations = robust, 1 if robust == "none" else _REWEIGHTED
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]
        e, self.alpha = self.process.error_size, alpha
        first = 1 - 1 / alpha**2  # λ / (E + λ), λ = α² E − E
        rest = [1 / (2 * alpha**2 * e)] * (2 * e)
        self.mean_weights = torch.tensor([first, *rest], dtype=torch.float64)
        weights = [first + 1 - alpha**2 + _BETA, *rest]
        self.weights = torch.tensor(weights, dtype=torch.float64)

    def predict(
        self, belief: GaussianBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N E E"]]:
        process, dt = self.process, elapsed(self.process, belief.step).double()
        u = process.inputs(observation)
        f, q = process.linearize(belief.state, u, dt)
        points = self._points(belief.state, belief.covariance)
        moved = process.propagate(points, u.unsqueeze(-2), dt.unsqueeze(-1))
        apart = process.boxminus(moved, moved[..., :1, :].expand_as(moved))
        shift, apart = self._centred(apart)
        return process.boxplus(moved[..., 0, :], shift), self._product(apart, apart) + q, f

    def update(
        self, prior: Prediction, beside: Beside
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N K"], Beside]:
        if self.association is not None:
            prior = self.association.named(prior)
        neighbours = received(self.believed, prior.observation)
        for kind in by_kind(self.models):
            models = pick(self.models, kind)
            if models:
                prior, beside = self._updated(prior, beside, models, neighbours)
        return prior.state, prior.covariance, prior.memory, beside

    def _updated(
        self,
        prior: Prediction,
        beside: Beside,
        models: Sequence[Measurement],
        neighbours: Neighbours,
    ) -> tuple[Prediction, Beside]:
        """x⁺ = x ⊞ K (z − ẑ), P⁺ = P − K S Kᵀ by some of the measurements."""
        residuals, variances = self._innovations(prior, models, neighbours)
        innovation, apart = self._centred(residuals)  # z − ẑ, and ẑ − h(xᵢ)
        spread, noise = self._product(apart, apart), variances
        cross = -self._product(self._offsets(prior.covariance), apart)
        state = prior.state
        for iteration in range(self.iterations):
            if iteration:
                noise = variances / self._weights(prior, state, models, neighbours)
            s = spread + torch.diag_embed(noise)
            gain = torch.linalg.solve(s, cross.mT).mT.contiguous()  # K = P_xz S⁻¹
            delta = (gain * innovation.unsqueeze(-2)).sum(-1)
            state = self.process.boxplus(prior.state, delta)
        covariance = prior.covariance - gain @ s @ gain.mT
        covariance = 0.5 * (covariance + covariance.mT)
        if self.biases:
            seen, trusts = prior.observation, [Trust()] * len(models)
            blocks = [m.linearize(self.process, prior.state, seen, neighbours) for m in models]
            considered = self.biases.of_update(
                beside.considered, prior.covariance, covariance, blocks, trusts, seen, models
            )
            beside = replace(beside, considered=considered)
        return replace(prior, state=state, covariance=covariance), beside

    def diagnostics(self, belief: GaussianBelief) -> dict[str, Float[Tensor, "B N"]]:
        if not any(model.cooperative for model in self.models):
            return {}
        return {"bytes": belief.state.new_full(belief.step.shape, 4 * 3 * self.process.dim)}

    def _weights(
        self,
        prior: Prediction,
        state: Float[Tensor, "B N S"],
        models: Sequence[Measurement],
        neighbours: Neighbours,
    ) -> Float[Tensor, "B N K"]:
        """What each number measured counts at a state; 1 where nothing was measured."""
        weights = []
        for model in models:
            seen = prior.observation
            block = model.linearize(self.process, state, seen, neighbours, derivatives=False)
            weight = soft_trust(self.robust, block).weight
            assert weight is not None
            counted = torch.where(block.mask, weight, 1.0).unsqueeze(-1)
            weights.append(counted.expand_as(block.residual).flatten(-2))
        return torch.cat(weights, -1)

    # ---------------------------------------------------------------- the unscented transform

    def _offsets(self, covariance: Float[Tensor, "B N E E"]) -> Float[Tensor, "B N M E"]:
        """Sigma points' errors: 0, then ±√(E + λ) L eᵢ."""
        e = covariance.shape[-1]
        root = torch.linalg.cholesky_ex(covariance).L.mT * (self.alpha * math.sqrt(e))
        return torch.cat((torch.zeros_like(root[..., :1, :]), root, -root), -2)

    def _points(
        self, state: Float[Tensor, "B N S"], covariance: Float[Tensor, "B N E E"]
    ) -> Float[Tensor, "B N M S"]:
        offsets = self._offsets(covariance)
        at = state.unsqueeze(-2).expand(*offsets.shape[:-1], -1)
        return self.process.boxplus(at, offsets)

    def _centred(
        self, x: Float[Tensor, "B N M k"]
    ) -> tuple[Float[Tensor, "B N k"], Float[Tensor, "B N M k"]]:
        """Mean over sigma points, and what is left of them."""
        x = x.contiguous()  # in one order of memory, so that rounding is the same in any batch
        mean = (self.mean_weights.to(x.device).unsqueeze(-1) * x).sum(-2, keepdim=True)
        return mean[..., 0, :], x - mean

    def _product(
        self, x: Float[Tensor, "B N M k"], y: Float[Tensor, "B N M l"]
    ) -> Float[Tensor, "B N k l"]:
        """Σ wᵢ xᵢ yᵢᵀ."""
        return x.mT @ (self.weights.to(y.device).unsqueeze(-1) * y)

    def _innovations(
        self, prior: Prediction, models: Sequence[Measurement], neighbours: Neighbours
    ) -> tuple[Float[Tensor, "B N M K"], Float[Tensor, "B N K"]]:
        """z − h(xᵢ) at the sigma points, and the noise's variances; 0 and 1 where nothing was
        measured."""
        points = self._points(prior.state, prior.covariance)
        around = per_state(prior.observation, neighbours)
        residuals, variances = [], []
        for model in models:
            block = model.linearize(self.process, points, *around, derivatives=False)
            absent = ~block.mask.unsqueeze(-1).expand_as(block.residual)
            residuals.append(block.residual.masked_fill(absent, 0.0).flatten(-2))
            variance = block.total_variance.expand_as(block.residual)[:, :, 0]  # about the mean
            if block.stray:  # between sigma points it may be anything
                at_mean = model.linearize(self.process, prior.state, prior.observation, neighbours)
                d = self.process.dim
                variance = at_mean.curved(prior.covariance[..., :d, :d]).total_variance
            variances.append(variance.masked_fill(absent[:, :, 0], 1.0).flatten(-2))
        return torch.cat(residuals, -1), torch.cat(variances, -1)
