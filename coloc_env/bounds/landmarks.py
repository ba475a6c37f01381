"""Landmarks whose identities or places are not known.

Which landmark is seen: the bound with identities known is given. It holds for those who have to
find them out, as they know less. Where landmarks are: their positions are states of their own,
beside a team's errors, uniform in the arena at first (taken as a Gaussian, as a uniform prior is).
A vector z = Rᵀ(L − p) + noise informs of L as of −p, and its Jacobians are taken at the truth,
where others are in expectation: derivatives at places that differ from step to step would hold
information on where the map as a whole is, which no vector holds.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.bounds.information import gram, landmark_rows
from coloc_env.motion import Arena, Kinematics
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.sensors import Landmarks, UnlabelledLandmarks, UnmappedLandmarks

# About each UAV's errors, about a team's errors and landmarks, and about each coordinate of these.
MapInformation = tuple[Float64[Tensor, "B N E E"], Float64[Tensor, "T m l"], Float64[Tensor, "T l"]]


def known_landmarks(scenario: Scenario) -> Scenario:
    """The same worlds with landmarks that bear names and whose map is there to be looked at."""
    sensors = tuple(
        s.labelled
        if isinstance(s, UnlabelledLandmarks)
        else s.landmarks
        if isinstance(s, UnmappedLandmarks)
        else s
        for s in scenario.sensors
    )
    return replace(scenario, sensors=sensors)


@dataclass(frozen=True)
class LandmarkStates:
    """The coordinates of an unmapped ``sensor``'s landmarks in the ``arena`` (None: no states)."""

    sensor: Landmarks | None
    arena: Arena

    @classmethod
    def of(cls, scenario: Scenario) -> "LandmarkStates":
        found = (s.landmarks for s in scenario.sensors if isinstance(s, UnmappedLandmarks))
        return cls(next(found, None), scenario.arena)

    @property
    def count(self) -> int:
        return 0 if self.sensor is None else self.sensor.count * self.arena.dim

    @cached_property
    def prior(self) -> Float64[Tensor, "l l"]:
        """Covariance (m²) before anything is seen."""
        sides = zip(self.arena.low, self.arena.high, strict=True)
        variance = torch.tensor([(b - a) ** 2 / 12 for a, b in sides], dtype=torch.float64)
        return variance.repeat(self.count // self.arena.dim).diag()

    def information(
        self, truth: Kinematics, seen: Observation, pose: Float64[Tensor, "D E"], n: int
    ) -> MapInformation:
        """What a step's vectors say, for teams of ``n`` UAVs, at the truth."""
        assert self.sensor is not None
        rows, weights = landmark_rows(self.sensor, truth, seen)
        by_place = -rows[..., : self.arena.dim]  # Rᵀ, of orthonormal rows
        rows = rows @ pose
        weighted = rows.mT * weights[..., None, None]
        cross = (weighted @ by_place).movedim(2, 3).flatten(3)  # [B, N, E, l]
        each = weights.repeat_interleave(self.arena.dim, -1)
        cross = cross.reshape(-1, n * pose.shape[1], self.count)
        return gram(rows, weights), cross, each.reshape(-1, n, self.count).sum(1)
