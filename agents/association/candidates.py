"""Every pairing of a landmark vector with a landmark of the map, under a Gaussian prior."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements import LandmarkVectors, no_neighbours
from agents.models.process import Process
from agents.robust.mahalanobis import eliminated, innovation_covariance
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
    z, pose = z.to(x.dtype), process.pose_errors
    points = seen["landmark_map"]
    nothing = {
        "landmarks": torch.zeros_like(points),
        "landmark_mask": torch.ones_like(points[..., ::d]),
        "landmark_map": points,
    }
    block = model.linearize(process, x, Observation(nothing), no_neighbours(x[..., :d]))
    expected = -block.residual
    spread = block.jacobian @ prior.covariance.unsqueeze(-3)
    s = innovation_covariance(spread, block.jacobian, [model.std**2] * d)
    apart = z.unsqueeze(-2) - expected.unsqueeze(-3)
    terms, wide = eliminated(apart.unbind(-1), [[c.unsqueeze(-2) for c in row] for row in s])
    pivots = [pivot.squeeze(-2) for pivot in wide]
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
