"""The magnetic field in a building, whose iron bends it, and a map of it."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import cross_matrix, unrotate
from coloc_env.motion import Box
from coloc_env.options import Count, Group, PositiveMetres, PositiveSeconds, Quantity, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require
from coloc_env.sensors.field_map import MOST, FieldMap

MicroTesla = Annotated[float, Quantity("µT", 0.0)]


@dataclass(frozen=True)
class Magnetic(Sensor):
    """Leaves ``magnetic`` [3] (µT, body frame) and ``magnetic_mask`` [1].

    z = Rᵀ B(p) + N(0, ``std``² I), B the field of the ``earth`` (east, north, up) and an anomaly,
    interpolated (trilinear) between nodes 1 m apart from the ``room``'s low corner on. At the nodes
    each component of the anomaly is a Gaussian random field of covariance
    ``anomaly_std``² exp(−|Δ|² / 2 ℓ²), ℓ = ``length`` (m). (Components are independent: a true
    field has neither sources nor eddies.) It is that of building number ``building``, the same in
    all worlds, as are walls and anchors. The team's map is that with an error N(0, ``map_std``²) at
    each node, which stays the same while a UAV is near it: about ``map_time`` s. With a ``survey``
    nothing is drawn: the field (µT) and the map are both what was surveyed. A share ``dropout`` is
    missing.
    """

    room: Box
    std: float = 0.5
    anomaly_std: float = 5.0
    length: float = 2.0
    map_std: float = 0.5
    map_time: float = 1.0
    building: int = 0
    dropout: float = 0.0
    earth: tuple[float, float, float] = (0.0, 20.0, -44.0)
    survey: FieldMap | None = None

    def __post_init__(self) -> None:
        for name in ("std", "anomaly_std", "map_std"):
            sane = 0 <= getattr(self, name) < math.inf
            require(sane, self, name, "a standard deviation in µT ≥ 0")
        require(0 < self.length < math.inf, self, "length", "a distance in m > 0")
        require(0 < self.map_time < math.inf, self, "map_time", "a time in s > 0")
        require(self.building >= 0, self, "building", "a number ≥ 0")
        require(0 <= self.dropout <= 1, self, "dropout", "a probability in [0, 1]")
        fits = self.survey is not None or math.prod(self.nodes) <= MOST
        require(fits, self, "room", f"a map of at most {MOST} nodes, 1 m apart")

    @property
    def nodes(self) -> tuple[int, int, int]:
        """How many nodes the map has along each axis, the last ones at the high walls or beyond."""
        x, y, z = (math.ceil(b - a - 1e-9) + 1 for a, b in zip(*self.room, strict=True))
        return x, y, z

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 3, "Magnetic", "dim", "a field needs a 3-D scenario")
        return {
            "magnetic": Leaf(3, unit="µT", frame="body"),
            "magnetic_mask": Leaf(1, *MASK),
        }

    def field(
        self, position: Float[Tensor, "*s 3"]
    ) -> tuple[Float[Tensor, "*s 3"], Float[Tensor, "*s 3 3"]]:
        """B (µT, world frame) at positions (m), and ∂B/∂p."""
        return _drawn(self)[0].at(position)

    def mapped(
        self, position: Float[Tensor, "*s 3"]
    ) -> tuple[Float[Tensor, "*s 3"], Float[Tensor, "*s 3 3"]]:
        """The same by the team's map."""
        return _drawn(self)[1].at(position)

    @staticmethod
    def in_body_by_pose(
        field: Float[Tensor, "*s 3"],
        slope: Float[Tensor, "*s 3 3"],
        rotation: Float[Tensor, "*s 3 3"],
    ) -> Float[Tensor, "*s 3 6"]:
        """Derivatives of Rᵀ B by δp (world) and δθ (right), from B and ∂B/∂p."""
        seen = (rotation.mT @ field.unsqueeze(-1))[..., 0]
        return torch.cat((rotation.mT @ slope, cross_matrix(seen)), -1)

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion = window.motion
        field, _ = self.field(motion.position)
        exact = unrotate(motion.attitude, field).to(torch.float32)
        n, seen = exact.shape[-2], window.alive
        if self.dropout:
            seen = seen & (noise.uniform(window.keys, "magnetic.dropout", n) >= self.dropout)
        white = noise.normal(window.keys, "magnetic", 3 * n).unflatten(-1, (n, 3))
        mask = seen.to(torch.float32).unsqueeze(-1)
        return {"magnetic": (exact + self.std * white) * mask, "magnetic_mask": mask}


@lru_cache(maxsize=8)
def _drawn(sensor: Magnetic) -> tuple[FieldMap, FieldMap]:
    """The field (µT), and the map of it."""
    if sensor.survey is not None:
        return sensor.survey, sensor.survey
    key, shape = noise.row_keys(torch.tensor([sensor.building])), (*sensor.nodes, 3)
    field = noise.normal(key, "magnetic.anomaly", math.prod(shape)).double().view(shape)
    for axis, n in enumerate(sensor.nodes):
        field = (field.movedim(axis, -1) @ _root(n, sensor.length).mT).movedim(-1, axis)
    true = sensor.anomaly_std * field + field.new_tensor(sensor.earth)
    error = noise.normal(key, "magnetic.map", math.prod(shape)).double().view(shape)
    true, known = (x.reshape(-1, 3) for x in (true, true + sensor.map_std * error))
    x, y, z = sensor.room[0]
    low = (x, y, z)
    return FieldMap(low, sensor.nodes, true), FieldMap(low, sensor.nodes, known)


def _root(n: int, length: float) -> Float64[Tensor, "n n"]:
    """L with L Lᵀ = exp(−|i − j|² / 2 ℓ²), a squared exponential's factor along one axis."""
    i = torch.arange(n, dtype=torch.float64)
    covariance = (-0.5 * ((i - i.unsqueeze(-1)) / length) ** 2).exp()
    return torch.linalg.cholesky(covariance + 1e-9 * torch.eye(n, dtype=torch.float64))


@dataclass(frozen=True)
class MagneticOptions(Group):
    """With ``magnetic``, UAVs measure the magnetic field in the body frame with noise of
    ``magnetic_std`` µT. To the Earth's the building adds an anomaly of ``anomaly_std`` µT that
    changes over ``anomaly_length`` m, that of building number ``building``; the team has a map of
    both with an error of ``magnetic_map_std`` µT at every metre, which it believes to last
    ``magnetic_map_time`` s. A share ``magnetic_dropout`` is missing."""

    title: ClassVar[str] = "magnetic field"

    magnetic: bool = False
    magnetic_std: MicroTesla = 0.5
    anomaly_std: MicroTesla = 5.0
    anomaly_length: PositiveMetres = 2.0
    magnetic_map_std: MicroTesla = 0.5
    magnetic_map_time: PositiveSeconds = 1.0
    building: Count = 0
    magnetic_dropout: Share = 0.0

    def true(self, room: tuple[float, ...]) -> tuple[Magnetic, ...]:
        """The sensor as it is, in a room with sides in m; nothing without a magnetometer."""
        if not self.magnetic:
            return ()
        field = (self.magnetic_std, self.anomaly_std, self.anomaly_length)
        known = (self.magnetic_map_std, self.magnetic_map_time, self.building)
        return (Magnetic(((0.0,) * 3, room), *field, *known, self.magnetic_dropout),)
