"""Range and bearing in the plane: to landmarks, and to other robots that a camera identifies."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import plane_angle, unrotate, wrap_angle
from coloc_env.sensors.base import (
    MASK,
    Layout,
    Leaf,
    Sensor,
    Window,
    require,
    squared_norm,
    usable,
)
from coloc_env.sensors.errors.persistence import gauss_markov
from coloc_env.sensors.landmarks import uniform_points

Biases = tuple[float, float]


def range_bearing(
    apart: Float64[Tensor, "*s 2"], std: tuple[float, float], white: Float32[Tensor, "*s 2"]
) -> Float32[Tensor, "*s 2"]:
    """Range (m) and bearing (rad, left of forward) of a body-frame vector, with Gaussian noise."""
    distance = squared_norm(apart).sqrt()
    bearing = plane_angle(apart[..., 0], apart[..., 1])
    clean = torch.stack((distance, bearing), -1).to(torch.float32)
    noisy = clean + white * white.new_tensor(std)
    return torch.stack((noisy[..., 0], wrap_angle(noisy[..., 1])), -1)


def sighting_biases(
    sensor: "LandmarkBearings | UavBearings", window: Window, links: int, stream: str
) -> Float32[Tensor, "R K N D*l 2"] | None:
    """Biases of the range (m) and bearing (rad) of what each UAV sees on so many links, the same
    for all measurements of a step; None where there are none."""
    if not any(sensor.bias_std):
        return None
    n = window.layout.arena.n_uavs
    numbers = torch.arange(n * links * 2, device=window.rows.device).view(n, links, 2)
    time, first = sensor.bias_time / window.layout.arena.dt, window.steps[:, 0]
    count = window.steps.shape[1]
    drawn = gauss_markov(window.rows, first, count, numbers, f"{stream}.bias", time)
    return (drawn * drawn.new_tensor(sensor.bias_std)).repeat(1, 1, 1, sensor.depth, 1)


def _biased(
    seen: Float32[Tensor, "*s 2"], bias: Float32[Tensor, "*s 2"] | None
) -> Float32[Tensor, "*s 2"]:
    """Ranges (m) and bearings (rad) with their biases."""
    if bias is None:
        return seen
    seen = seen + bias
    return torch.stack((seen[..., 0], wrap_angle(seen[..., 1])), -1)


def _require_biases(sensor: "LandmarkBearings | UavBearings") -> None:
    sizes = all(0 <= std < math.inf for std in sensor.bias_std)
    require(sizes, sensor, "bias_std", "standard deviations in m and rad ≥ 0")
    require(0 < sensor.bias_time < math.inf, sensor, "bias_time", "a time in s > 0")


@dataclass(frozen=True)
class LandmarkBearings(Sensor):
    """Leaves ``landmark_bearings`` [D · L · 2], their ``landmark_bearing_mask`` [D · L] and
    ``landmark_map`` [L · 2]: range (m) and bearing (rad) to each identified landmark.

    ``depth`` D: how many measurements of one landmark a step can deliver. ``share``: probability
    that a landmark within ``radius`` is measured at all in a step. Each UAV's sightings of a
    landmark have biases of standard deviation ``bias_std`` (m, rad), Gauss–Markov processes whose
    correlation falls by e in ``bias_time`` s.
    """

    count: int = 15
    range_std: float = 0.15
    bearing_std: float = 0.02
    radius: float = 8.0
    share: float = 1.0
    depth: int = 1
    bias_std: Biases = (0.0, 0.0)
    bias_time: float = 100.0

    def __post_init__(self) -> None:
        _require_biases(self)
        require(
            self.count >= 1, self, "count", "at least one landmark (leave the sensor out for 0)"
        )
        require(0 <= self.share <= 1, self, "share", "a probability in [0, 1]")

    @property
    def fix_slots(self) -> int:
        return self.depth * self.count

    def fixes(
        self, leaves: Mapping[str, Float32[Tensor, "B N F"]], attitude: Float32[Tensor, "B N a"]
    ) -> tuple[Float32[Tensor, "B N m d"], Bool[Tensor, "B N m"]]:
        z = leaves["landmark_bearings"].unflatten(-1, (-1, 2))
        z, there = usable(z, leaves["landmark_bearing_mask"] > 0, ranges=True)
        distance, bearing = z.unbind(-1)
        heading = attitude + bearing
        apart = distance.unsqueeze(-1) * torch.stack((heading.cos(), heading.sin()), -1)
        points = leaves["landmark_map"].unflatten(-1, (-1, 2)).repeat(1, 1, self.depth, 1)
        return points - apart, there

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 2, "LandmarkBearings", "dim", "bearings need a 2-D scenario")
        slots = self.depth * self.count
        return {
            "landmark_bearings": Leaf(2 * slots, unit="m, rad", frame="body"),
            "landmark_bearing_mask": Leaf(slots, *MASK),
        }

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"landmark_map": Leaf(2 * self.count, unit="m", frame="world")}

    def place(self, keys: Int64[Tensor, "R"], layout: Layout) -> dict[str, Tensor]:
        return {"positions": uniform_points(keys, "bearings.place", self.count, layout)}

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"landmark_map": placed["positions"].flatten(1).to(torch.float32)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion, n, slots = window.motion, window.layout.arena.n_uavs, self.depth * self.count
        points = placed["positions"].repeat(1, self.depth, 1)[:, None, None]
        apart = unrotate(motion.attitude.unsqueeze(-2), points - motion.position.unsqueeze(-2))
        white = noise.normal(window.keys, "bearings", 2 * n * slots).unflatten(-1, (n, slots, 2))
        drawn = noise.uniform(window.keys, "bearings.share", n * slots).unflatten(-1, (n, slots))
        mask = (squared_norm(apart) <= self.radius**2) & (drawn < self.share)
        mask &= window.alive.unsqueeze(-1)
        seen = range_bearing(apart, (self.range_std, self.bearing_std), white)
        seen = _biased(seen, sighting_biases(self, window, self.count, "bearings"))
        return {
            "landmark_bearings": seen.masked_fill_(~mask.unsqueeze(-1), 0.0).flatten(-2),
            "landmark_bearing_mask": mask.to(torch.float32),
        }


@dataclass(frozen=True)
class UavBearings(Sensor):
    """Leaves ``uav_bearings`` [D · S · 2] and ``uav_bearing_mask`` [D · S]: range (m) and bearing
    (rad) to each neighbour slot, each end measuring for itself. Biases are those of
    ``LandmarkBearings``, of each neighbour slot."""

    between_uavs = True

    range_std: float = 0.15
    bearing_std: float = 0.02
    share: float = 1.0
    depth: int = 1
    bias_std: Biases = (0.0, 0.0)
    bias_time: float = 100.0

    def __post_init__(self) -> None:
        _require_biases(self)
        require(0 <= self.share <= 1, self, "share", "a probability in [0, 1]")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 2, "UavBearings", "dim", "bearings need a 2-D scenario")
        slots = self.depth * layout.slots
        return {
            "uav_bearings": Leaf(2 * slots, unit="m, rad", frame="body"),
            "uav_bearing_mask": Leaf(slots, *MASK),
        }

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion, n, slots = window.motion, window.layout.arena.n_uavs, window.layout.slots
        positions = motion.position.unsqueeze(2).expand(-1, -1, n, -1, -1)
        index = window.neighbours.expand(*positions.shape[:2], -1, -1)
        theirs = positions.gather(3, index.unsqueeze(-1).expand(-1, -1, -1, -1, 2))
        apart = unrotate(motion.attitude.unsqueeze(-2), theirs - motion.position.unsqueeze(-2))
        apart = apart.repeat(1, 1, 1, self.depth, 1)
        count = self.depth * slots
        white = noise.normal(window.keys, "uav_bearings", 2 * n * count)
        drawn = noise.uniform(window.keys, "uav_bearings.share", n * count)
        mask = window.reach.repeat(1, 1, 1, self.depth) & (
            drawn.unflatten(-1, (n, count)) < self.share
        )
        std = (self.range_std, self.bearing_std)
        seen = range_bearing(apart, std, white.unflatten(-1, (n, count, 2)))
        seen = _biased(seen, sighting_biases(self, window, slots, "uav_bearings"))
        return {
            "uav_bearings": seen.masked_fill_(~mask.unsqueeze(-1), 0.0).flatten(-2),
            "uav_bearing_mask": mask.to(torch.float32),
        }
