"""Landmarks that look alike: what is seen, without which of them it is."""

from dataclasses import dataclass

from jaxtyping import Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window
from coloc_env.sensors.landmarks import Landmarks


@dataclass(frozen=True)
class UnlabelledLandmarks(Sensor):
    """Leaves ``unlabelled_landmarks`` [L · d] with ``unlabelled_landmark_mask`` [L], and the map,
    ``landmark_map`` [L · d].

    What ``labelled`` landmarks give (vectors in the body frame, m), in an order that is drawn for
    every UAV and step: entry m is that of any landmark of the map.
    """

    labelled: Landmarks

    @property
    def std(self) -> float:
        """Standard deviation of each component, m."""
        return self.labelled.std

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        vectors = self.labelled.leaves(layout)["landmarks"]
        return {
            "unlabelled_landmarks": vectors,
            "unlabelled_landmark_mask": Leaf(self.labelled.count, *MASK),
        }

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        return self.labelled.map_leaves(layout)

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        return self.labelled.place(keys, layout)

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return self.labelled.map_values(placed)

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        seen, count = self.labelled.sample(window, placed), self.labelled.count
        shape = (window.layout.arena.n_uavs, count)
        drawn = noise.uniform(window.keys, "landmarks.order", shape[0] * count)
        order = drawn.unflatten(-1, shape).argsort(dim=-1, stable=True)
        vectors = seen["landmarks"].unflatten(-1, (count, -1))
        shuffled = vectors.gather(-2, order.unsqueeze(-1).expand_as(vectors))
        mask = seen["landmark_mask"].gather(-1, order)
        return {"unlabelled_landmarks": shuffled.flatten(-2), "unlabelled_landmark_mask": mask}
