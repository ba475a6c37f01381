"""Landmarks that can be told apart, but whose positions nobody knows at the start."""

from dataclasses import dataclass, field
from typing import ClassVar

from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.options import Group
from coloc_env.sensors.base import Layout, Leaf, Sensor, Window
from coloc_env.sensors.landmarks import Landmarks


@dataclass(frozen=True)
class UnmappedLandmarks(Sensor):
    """Leaves ``landmarks`` [L · d] and ``landmark_mask`` [L], as ``landmarks`` has them; no map.
    Entry l is always of the same landmark, which lies anywhere in the arena."""

    landmarks: Landmarks = field(default_factory=Landmarks)

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return self.landmarks.leaves(layout)

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        return self.landmarks.place(keys, layout)

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return self.landmarks.sample(window, placed)

    def true_map(self, keys: Int64[Tensor, "R"], layout: Layout) -> Float64[Tensor, "R L d"]:
        """Where the landmarks are (m), in worlds of these keys; privileged."""
        return self.place(keys, layout)["positions"]


@dataclass(frozen=True)
class MapOptions(Group):
    """``landmarks_known``: whether the team knows where landmarks are; otherwise it can only tell
    them apart."""

    title: ClassVar[str] = "mapping"

    landmarks_known: bool = True

    def of(self, sensors: tuple[Landmarks, ...]) -> tuple[Sensor, ...]:
        """The sensors, with or without their map."""
        return sensors if self.landmarks_known else tuple(map(UnmappedLandmarks, sensors))
