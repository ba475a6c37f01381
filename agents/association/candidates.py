"""Every pairing of a landmark vector with a landmark of the map, under a Gaussian prior."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements import LandmarkVectors, no_neighbours
from agents.models.process import Process
from agents.robust.mahalanobis import innovation_terms, whitened_squares
from agents.robust.screen import Prediction
from coloc_env.observation import Observation
from coloc_env.sensors.base import usable


@dataclass(frozen=True)
class Candidates:
    """Measurement m (z, body frame, m) against landmark l, linearized at the prior's mean: what is
    expected of l, its Jacobian H by the pose (δp, δθ) and that one's covariance P, the noise's
    ``variance`` (m²), squared Mahalanobis distances of the innovations ν = z − ẑ under
    S = H P Hᵀ + R, and log |S|."""

    z: Float[Tensor, "B N M d"]
    mask: Bool[Tensor, "B N M"]
    expected: Float[Tensor, "B N L d"]
    jacobian: Float[Tensor, "B N L d e"]
    covariance: Float[Tensor, "B N e e"]
    variance: float
    squared: Float[Tensor, "B N M L"]
    log_det: Float[Tensor, "B N L"]


def candidates(model: LandmarkVectors, process: Process, prior: Prediction) -> Candidates:
    """All pairings of what is seen without names with the map."""
    seen, d, x = prior.observation, process.dim, prior.state
    z = seen["unlabelled_landmarks"].unflatten(-1, (-1, d))
    z, mask = usable(z, seen["unlabelled_landmark_mask"] > 0)
    z, turn = z.to(x.dtype), process.attitude_error
    pose = [*range(d), *([] if turn is None else range(turn.start, turn.stop))]
    points = seen["landmark_map"]
    nothing = {
        "landmarks": torch.zeros_like(points),
        "landmark_mask": torch.ones_like(points[..., ::d]),
        "landmark_map": points,
    }
    block = model.linearize(process, x, Observation(nothing), no_neighbours(x[..., :d]))
    expected = -block.residual
    spread = block.jacobian @ prior.covariance.unsqueeze(-3)
    s = [
        [(spread[..., i, :] * block.jacobian[..., j, :]).sum(-1) for j in range(i + 1)]
        for i in range(d)
    ]
    for i in range(d):
        s[i][i] = s[i][i] + model.std**2
    apart = z.unsqueeze(-2) - expected.unsqueeze(-3)
    terms = whitened_squares(apart.unbind(-1), [[c.unsqueeze(-2) for c in row] for row in s])
    pivots = innovation_terms(block, prior.covariance)[1]
    log_det = sum((pivot.log() for pivot in pivots[1:]), pivots[0].log())
    return Candidates(
        z=z,
        mask=mask,
        expected=expected,
        jacobian=block.jacobian[..., pose],
        covariance=prior.covariance[..., pose, :][..., pose],
        variance=model.std**2,
        squared=sum(terms[1:], terms[0]),
        log_det=log_det,
    )
