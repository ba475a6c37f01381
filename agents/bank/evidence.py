"""Which of two filters predicts better what is measured: a score, and its running sum."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from agents.models.measurements import Block
from agents.robust.mahalanobis import innovation_terms
from coloc_env.options import Factor, Group, OpenShare, Quantity

LARGEST = 3.0  # nats that one step may say for or against a branch
_WORST = -1e9  # nats: of a prediction that is no number


@dataclass(frozen=True)
class BankOptions(Group):
    """``bank=false`` leaves the classical branch out. The evidence for the learned branch is a sum
    that forgets: a step's counts ``forgetting`` (λ) in the next. It is the difference of
    predictive scores, of Student's t with ``degrees`` (ν) of freedom; below ``restart`` (θ, nats)
    the learned branch starts again from the classical one.
    """

    title: ClassVar[str] = "bank"

    bank: bool = True
    forgetting: OpenShare = 0.995
    degrees: Factor = 4.0
    restart: Annotated[float, Quantity("", below=0.0)] = -10.0


def predictive_score(
    blocks: Sequence[Block], covariance: Float[Tensor, "B N E E"], degrees: float
) -> Float64[Tensor, "B N"]:
    """ℓ = Σ −½ log|S| − ½ (ν + k) log(1 + d²/ν) over all that was measured, S = H P Hᵀ + R and
    d² = rᵀ S⁻¹ r: log of Student's t of the innovations, without what no filter changes. ``blocks``
    are linearized at the prediction, whose covariance P is. A number that two UAVs hold counts half
    for each."""
    total = covariance.new_zeros(covariance.shape[:-2])
    for block in blocks:
        terms, pivots = innovation_terms(block, covariance)
        k = len(terms)
        distance = sum(terms[1:], terms[0])
        logarithm = sum((pivot.log() for pivot in pivots[1:]), pivots[0].log())  # log|S|
        each = -0.5 * (logarithm + (degrees + k) * (distance / degrees).log1p())
        share = 0.5 if block.mutual else 1.0
        total = total + share * torch.where(block.mask, each, 0.0).sum(-1)
    return total


def accumulated(
    evidence: Float64[Tensor, "B N"],
    candidate: Float[Tensor, "B N"],
    fallback: Float[Tensor, "B N"],
    forgetting: float,
) -> Float64[Tensor, "B N"]:
    """A ← λ A + clip(ℓ_candidate − ℓ_fallback, ±3)."""
    scores = (x.double().nan_to_num(_WORST, neginf=_WORST) for x in (candidate, fallback))
    ours, theirs = scores
    return forgetting * evidence + (ours - theirs).clamp(-LARGEST, LARGEST)
