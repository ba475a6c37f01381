"""1-point RANSAC with the prior: landmarks that agree with each other stay, others are left out.

Civera, Grasa, Davison & Montiel, Journal of Field Robotics 27(5), 2010: with a prior, one
measurement makes a hypothesis of the whole state. A UAV sees few landmarks, so that every one of
them is tried instead of a random choice, and the outcome is no matter of chance.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements import Block, LandmarkRangeBearings, Measurement
from agents.robust.landmark_vectors import as_vectors
from agents.robust.mahalanobis import chi_square, whitened_squares

_PROBABILITY = 0.99  # that a good measurement votes for another good one


def consensus_weights(
    model: Measurement, block: Block, covariance: Float[Tensor, "B N E E"]
) -> Float[Tensor, "B N m"] | None:
    """1 for the largest set of measurements that are consistent with one of them, 0 for others.

    None where there is nothing to compare (other UAVs' measurements, or scalar ones).
    """
    if model.cooperative or block.residual.shape[-1] < 2:
        return None
    if isinstance(model, LandmarkRangeBearings):
        block = as_vectors(block)
    limit = chi_square(_PROBABILITY, block.residual.shape[-1])
    distance = distances_to_hypotheses(block, covariance)
    return largest_consensus(distance, block.mask, limit).to(distance.dtype)


def distances_to_hypotheses(
    block: Block, covariance: Float[Tensor, "B N E E"]
) -> Float[Tensor, "B N m h"]:
    """Squared Mahalanobis distance of measurement m from what the prior, updated with measurement h
    alone, makes it: the terms of the pair's joint innovation that come after those of h."""
    m, k = block.residual.shape[-2:]
    rows = block.jacobian.flatten(-3, -2)
    joint = (rows @ covariance @ rows.mT).unflatten(-1, (m, k)).unflatten(-3, (m, k))
    joint = joint.permute(3, 5, 0, 1, 2, 4).contiguous()  # [k, k, B, N, m, h]
    noise = torch.diag_embed(block.total_variance).permute(3, 4, 0, 1, 2)
    own = joint.diagonal(dim1=-2, dim2=-1) + noise
    residual = block.residual.movedim(-1, 0)
    r = [*residual.unsqueeze(-2), *residual.unsqueeze(-1)]
    s = [list(row) for row in own.unsqueeze(-2)]
    s += [[*joint[i], *own[i].unsqueeze(-1)] for i in range(k)]
    terms = whitened_squares(r, s)[k:]
    return sum(terms[1:], terms[0])


def largest_consensus(
    distance: Float[Tensor, "B N m h"], mask: Bool[Tensor, "B N m"], limit: float
) -> Bool[Tensor, "B N m"]:
    """The set that most measurements vote into; of equal ones that with the smaller distances.
    Everything where no two agree."""
    m = distance.shape[-1]
    alone = torch.eye(m, dtype=torch.bool, device=distance.device)
    agree = (distance <= limit) | alone
    agree = agree & mask.unsqueeze(-1) & mask.unsqueeze(-2)
    spread = torch.where(agree & ~alone, distance, 0.0).sum(-2) / (limit * m)  # less than one vote
    votes = agree.sum(-2)
    best = (votes - spread).argmax(-1, keepdim=True)
    chosen = agree.gather(-1, best.unsqueeze(-2).expand(*agree.shape[:-1], 1))[..., 0]
    return chosen | (votes.gather(-1, best) < 2)
