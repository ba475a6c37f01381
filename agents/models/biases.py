"""Biases that an estimator does not estimate but considers: Schmidt's filter with its gains kept.

Ranges and sightings carry biases that last, and that the position absorbs: innovations do not show
them. An estimator's own covariance P leaves them out. Beside it goes what they have made of the
error: with gains as they are, the error is that without biases plus C b, and

    X = Cov(C b),  Y = Cov(C b, b),  b stationary Gauss–Markov with covariance Σ = diag(σ_b²)
    predict:  X ← F X Fᵀ,  Y ← F Y φ,  φ = exp(−dt / τ)
    update:   X ← A X Aᵀ − A Y Dᵀ − D Yᵀ Aᵀ + D Σ Dᵀ,  Y ← A Y − D Σ

with A = I − P⁺ Λ = P⁺ P⁻¹ and D = P⁺ Hᵀ W R⁻¹ B, where B gives each measurement its bias. P + X is
the upper block of the augmented covariance of [δx, b] (Schmidt 1966; Jazwinski 1970, section 8.4,
for gains that ignore b), to the last term: the base part reproduces P at every update.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block, Measurement
from agents.robust.screen import Trust
from coloc_env.observation import Observation

Considered = Float[Tensor, "*s E F"]  # [X, Y], F = E + number of biases; of width 0: none believed


@dataclass(frozen=True)
class Biases:
    """The biases of the links that ``models`` measure, one for each number of each link, in steps
    of ``dt`` s. In large teams a bias belongs to the neighbour slot, whoever is in it."""

    models: Sequence[Measurement]
    dt: float

    def __bool__(self) -> bool:
        return any(model.bias_std for model in self.models)

    def initial(self, observation: Observation, like: Float[Tensor, "B N E E"]) -> Considered:
        """Before anything is measured: no error by biases; ``like``: the error covariance."""
        if not self:
            return like[..., :0]
        return like.new_zeros(*like.shape[:-1], like.shape[-1] + self.count(observation))

    def predict(
        self,
        considered: Considered,
        f: Float[Tensor, "*s E E"],
        observation: Observation,
    ) -> Considered:
        """After a step with transition F."""
        if not self:
            return considered
        e = f.shape[-1]
        x, y = considered[..., :e], considered[..., e:]
        return torch.cat((f @ x @ f.mT, (f @ y) * self._decay(observation, y)), -1)

    def update(
        self,
        considered: Considered,
        kept: Float[Tensor, "*s E E"],
        gain: Float[Tensor, "*s E b"],
        observation: Observation,
    ) -> Considered:
        """After an update that keeps A of the error and takes in D of the biases."""
        e = kept.shape[-1]
        x, y = considered[..., :e], considered[..., e:]
        own, by_bias = kept @ y, gain * self._variance(observation, y)  # A Y, D Σ
        cross = own @ gain.mT  # A Y Dᵀ
        x = kept @ x @ kept.mT - cross - cross.mT + by_bias @ gain.mT
        return torch.cat((0.5 * (x + x.mT), own - by_bias), -1)

    def of_update(
        self,
        considered: Considered,
        before: Float[Tensor, "*s E E"],
        after: Float[Tensor, "*s E E"],
        blocks: Sequence[Block],
        trusts: Sequence[Trust],
        observation: Observation,
        models: Sequence[Measurement] | None = None,
    ) -> Considered:
        """After an update of covariance P by the blocks of ``models`` (None: all) to P⁺, so
        trusted."""
        if not self:
            return considered
        scaled = [
            block.jacobian.mul(trust.information(block).unsqueeze(-1)).movedim(-1, -3)
            for block, trust in zip(blocks, trusts, strict=True)
        ]
        vectors = dict(zip(models or self.models, scaled, strict=True))
        gain = after @ self.by_bias(vectors, observation)
        return self.update(considered, kept_share(before, after), gain, observation)

    def by_bias(
        self, gains: Mapping[Measurement, Float[Tensor, "*s E m k"]], observation: Observation
    ) -> Float[Tensor, "*s E b"]:
        """Gains of measurements (of some of the models) as gains of their biases."""
        like, parts = next(iter(gains.values())), []
        for model in self.models:
            links = model.count(observation) // model.depth
            if not model.bias_std:
                continue
            if model in gains:
                each = gains[model].unflatten(-2, (model.depth, links)).sum(-3)
            else:
                each = like.new_zeros(*like.shape[:-2], links, len(model.bias_std))
            parts.append(each.flatten(-2))
        return torch.cat(parts, -1)

    def _variance(
        self, observation: Observation, like: Float[Tensor, "*s E b"]
    ) -> Float[Tensor, "b"]:
        """σ_b² of each bias: of each number of each link of each model; of a team's biases, one
        UAV's after the other's."""
        return self._each(observation, like, lambda m: [std**2 for std in m.bias_std])

    def _decay(self, observation: Observation, like: Float[Tensor, "*s E b"]) -> Float[Tensor, "b"]:
        """φ of each bias over a step."""
        return self._each(
            observation, like, lambda m: [math.exp(-self.dt / m.bias_time)] * len(m.bias_std)
        )

    def count(self, observation: Observation) -> int:
        """How many biases a UAV's measurements have."""
        links = [m.count(observation) // m.depth * len(m.bias_std) for m in self.models]
        return sum(links)

    def _each(
        self,
        observation: Observation,
        like: Float[Tensor, "*s E b"],
        numbers: Callable[[Measurement], list[float]],
    ) -> Float[Tensor, "b"]:
        links = [(m, m.count(observation) // m.depth) for m in self.models if m.bias_std]
        own = like.new_tensor([x for m, count in links for _ in range(count) for x in numbers(m)])
        return own.repeat(like.shape[-1] // len(own))


def kept_share(
    before: Float[Tensor, "*s E E"], after: Float[Tensor, "*s E E"]
) -> Float[Tensor, "*s E E"]:
    """A = I − K H = P⁺ P⁻¹: what an update leaves of the error."""
    root = torch.linalg.cholesky_ex(before).L
    return torch.cholesky_solve(after, root).mT


def reported(
    covariance: Float[Tensor, "*s E E"], considered: Considered
) -> Float[Tensor, "*s E E"]:
    """P + X, in which biases are considered."""
    if not considered.shape[-1]:
        return covariance
    return covariance + considered[..., : covariance.shape[-1]]
