"""Names for landmarks that were seen without: what comes after works as if they had come so."""

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Int64
from torch import Tensor

from agents.association.candidates import Candidates, candidates
from agents.association.joint import joint
from agents.association.nearest import nearest
from agents.models.measurements import LandmarkVectors
from agents.models.process import Process
from agents.robust.mahalanobis import chi_square
from agents.robust.screen import Prediction
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import UnlabelledLandmarks

AssociationName = Literal["nearest", "joint"]
_BEAMS = 8  # partial sets of pairings that the search for joint compatibility keeps


class Association:
    """Pairs each vector with at most one landmark of the map, and each landmark with at most one
    vector, by the prediction: ``nearest`` neighbour, or ``joint`` compatibility, both within the χ²
    quantile ``gate``; what fits nothing is left out."""

    def __init__(
        self, process: Process, sensor: UnlabelledLandmarks, method: AssociationName, gate: float
    ) -> None:
        self.process, self.method, self.gate = process, method, gate
        self.model = LandmarkVectors(sensor)

    def candidates(self, prior: Prediction) -> Candidates:
        """All pairings under a prediction."""
        return candidates(self.model, self.process, prior)

    def pairs(self, prior: Prediction) -> Int64[Tensor, "B N M"]:
        """The landmark of each vector, −1 for none."""
        found = self.candidates(prior)
        if self.method == "joint":
            return joint(found, self.gate, _BEAMS)
        squared = found.squared.masked_fill(~found.mask.unsqueeze(-1), torch.inf)
        return nearest(squared, chi_square(self.gate, self.process.dim))

    def unseen(self, observation: Observation) -> Observation:
        """The observation with named landmarks of which none is seen."""
        points, d = observation["landmark_map"], self.process.dim
        nothing = {
            "landmarks": torch.zeros_like(points),
            "landmark_mask": torch.zeros_like(points[..., ::d]),
        }
        return Observation({**observation.leaves, **nothing})

    def named(self, prior: Prediction) -> Prediction:
        """The same with ``landmarks`` and ``landmark_mask`` in the order of the map."""
        seen, d = prior.observation, self.process.dim
        vectors = seen["unlabelled_landmarks"].unflatten(-1, (-1, d))
        landmark = self.pairs(prior)
        count = seen["landmark_map"].shape[-1] // d
        shape = (*landmark.shape[:-1], count + 1)  # the last for what is left out
        index = torch.where(landmark < 0, count, landmark)
        there = vectors.new_zeros(shape).scatter_(-1, index, 1.0)[..., :count]
        wide = index.unsqueeze(-1).expand_as(vectors)
        z = vectors.new_zeros(*shape, d).scatter_(-2, wide, vectors)[..., :count, :]
        leaves = {"landmarks": z.flatten(-2), "landmark_mask": there}
        return replace(prior, observation=Observation({**seen.leaves, **leaves}).kept())


def associated(
    believed: Believed, process: Process, method: AssociationName, gate: float
) -> Association | None:
    """How a team's landmarks get their names; None where they have them."""
    sensor = believed.sensor(UnlabelledLandmarks)
    return None if sensor is None else Association(process, sensor, method, gate)
