"""Lamps at known places on the ceiling: how bright each is, and in which direction."""

import math
from dataclasses import dataclass, field
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import cross, cross_matrix, unrotate
from coloc_env.options import Group, PositiveCount, PositiveMetres, Quantity, Radians, Share
from coloc_env.sensors.base import MASK, Layout, Leaf, Sensor, Window, require, squared_norm
from coloc_env.sensors.sight import Sight

_SIZE = 0.1  # m²: a lamp is no point
Lux = Annotated[float, Quantity("lx", 0.0)]
LampPower = Annotated[float, Quantity("lx·m²", above=0.0)]


@dataclass(frozen=True)
class Light(Sensor):
    """Leaves ``light`` [K] (lx), ``light_direction`` [K · 3] (unit vectors, body frame),
    ``light_mask`` [K] and ``light_map`` [K · 3], for K lamps that shine down and are told apart by
    how they flicker.

    Intensity is I = I₀ cos θ / (r² + 0.1) + ``ambient``, θ the angle from straight below, with
    Gaussian noise of variance (``share`` I)² + ``floor``². Directions u to lamps are scattered as
    von Mises and Fisher have it, with κ = 1 / ``angle_std``² (rad): N(0, ``angle_std``² I) across u
    where that is small. Lamps within ``radius`` m are seen, from below and where nothing of the
    ``sight`` is between.
    """

    lamps: tuple[tuple[float, ...], ...]
    power: float = 1000.0
    ambient: float = 20.0
    share: float = 0.05
    floor: float = 0.5
    angle_std: float = 0.05
    radius: float = 10.0
    sight: Sight = field(default_factory=Sight)

    def __post_init__(self) -> None:
        require(len(self.lamps) >= 1, self, "lamps", "at least one lamp")
        whole = all(len(lamp) == 3 for lamp in self.lamps)
        require(whole, self, "lamps", "positions of three numbers")
        require(0 < self.power < math.inf, self, "power", "an intensity at 1 m in lx·m² > 0")
        require(0 <= self.ambient < math.inf, self, "ambient", "an intensity in lx ≥ 0")
        require(0 <= self.share < 1, self, "share", "a share of the intensity in [0, 1)")
        require(0 <= self.floor < math.inf, self, "floor", "an intensity in lx ≥ 0")
        require(0 < self.angle_std < 1, self, "angle_std", "an angle in rad > 0 and < 1")
        require(self.radius > 0, self, "radius", "a distance in m > 0")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        require(layout.arena.dim == 3, "Light", "dim", "a ceiling needs a 3-D scenario")
        count = len(self.lamps)
        return {
            "light": Leaf(count, unit="lx"),
            "light_direction": Leaf(3 * count, frame="body"),
            "light_mask": Leaf(count, *MASK),
        }

    def map_leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"light_map": Leaf(3 * len(self.lamps), unit="m", frame="world")}

    def place(self, keys: Tensor, layout: Layout) -> dict[str, Tensor]:
        lamps = torch.tensor(self.lamps, dtype=torch.float64, device=keys.device)
        return {"lamps": lamps.expand(len(keys), -1, -1)}

    def map_values(self, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"light_map": placed["lamps"].flatten(1).to(torch.float32)}

    def intensity(
        self, apart: Float[Tensor, "*s K 3"]
    ) -> tuple[Float[Tensor, "*s K"], Float[Tensor, "*s K 3"]]:
        """I by the vectors v = L − p (m, world) to lamps, and ∂I/∂v: I₀ v_z / (r (r² + s)), from
        above 0 but for the ambient light."""
        squared = squared_norm(apart).clamp_min(1e-6)
        r, width = squared.sqrt(), squared + _SIZE
        below = apart[..., 2].clamp_min(0.0)
        beam = self.power / (r * width)
        up = apart.new_tensor((0.0, 0.0, 1.0)) * (below > 0).unsqueeze(-1)
        fade = below * (1 / squared + 2 / width)
        gradient = beam.unsqueeze(-1) * (up - fade.unsqueeze(-1) * apart)
        return beam * below + self.ambient, gradient

    def direction(
        self, apart: Float[Tensor, "*s K 3"], rotation: Float[Tensor, "*s 3 3"]
    ) -> Float[Tensor, "*s K 3"]:
        """u = Rᵀ v / r by the vectors v = L − p (m, world) to lamps."""
        return apart / _length(apart) @ rotation

    def direction_by_pose(
        self, apart: Float[Tensor, "*s K 3"], rotation: Float[Tensor, "*s 3 3"]
    ) -> Float[Tensor, "*s K 3 6"]:
        """Its derivatives by δp (world) and δθ (right): −Rᵀ (I − v vᵀ / r²) / r and [u]×."""
        r = _length(apart)
        way = apart / r
        eye = torch.eye(3, dtype=way.dtype, device=way.device)
        across = (way.unsqueeze(-1) * way.unsqueeze(-2) - eye) / r.unsqueeze(-1)
        return torch.cat((rotation.mT.unsqueeze(-3) @ across, cross_matrix(way @ rotation)), -1)

    def variance(self, intensity: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
        """Of an intensity's noise, lx²."""
        return (self.share * intensity) ** 2 + self.floor**2

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        motion, lamps = window.motion, placed["lamps"][:, None, None]
        own = motion.position.unsqueeze(-2)
        apart = lamps - own  # [R, K, N, L, 3]
        exact, _ = self.intensity(apart)
        seen = window.alive.unsqueeze(-1) & (apart[..., 2] > 0)
        seen = seen & (squared_norm(apart) <= self.radius**2)
        if not self.sight.clear:
            seen = seen & (self.sight.between(window, own, lamps) == 0)
        n, count = exact.shape[-2:]
        white = noise.normal(window.keys, "light", n * count).unflatten(-1, (n, count))
        measured = exact.to(torch.float32) + self.variance(exact).sqrt().to(torch.float32) * white
        way = unrotate(motion.attitude.unsqueeze(-2), apart).to(torch.float32)
        way = way / squared_norm(way).sqrt().clamp_min(1e-6).unsqueeze(-1)
        directions = scattered(way, self.angle_std, window.keys, "light.direction")
        mask = seen.to(torch.float32)
        return {
            "light": measured * mask,
            "light_direction": (directions * mask.unsqueeze(-1)).flatten(-2),
            "light_mask": mask,
        }


def _length(apart: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 1"]:
    """Of vectors to lamps (m), never 0."""
    return torch.linalg.vector_norm(apart, dim=-1, keepdim=True).clamp_min(1e-3)


def scattered(
    u: Float32[Tensor, "R K N L 3"], std: float, keys: Int64[Tensor, "R K"], stream: str
) -> Float32[Tensor, "R K N L 3"]:
    """Unit vectors about u, von Mises–Fisher with κ = 1 / ``std``²: w = u·x has the distribution
    function (e^κw − e^−κ) / (e^κ − e^−κ), inverted here, and the angle about u is uniform (Mardia &
    Jupp, "Directional Statistics", 2000, section 9.3)."""
    n, count = u.shape[-3:-1]
    chance, turn = (
        noise.uniform(keys, stream, 2 * n * count).unflatten(-1, (2, n, count)).unbind(-3)
    )
    less = -(std**2) * (chance + (1 - chance) * math.exp(-2 / std**2)).log()  # 1 − w
    aside = (less * (2 - less)).clamp_min(0.0).sqrt()
    x, y, z = u.unbind(-1)
    level = torch.stack((torch.zeros_like(x), z, -y), -1)  # e_x × u, or e_z × u where that is short
    other = torch.stack((-y, x, torch.zeros_like(x)), -1)
    first = torch.where((x.abs() < 0.9).unsqueeze(-1), -level, other)
    first = first / squared_norm(first).sqrt().unsqueeze(-1)
    second = cross(u, first)
    angle = 2 * math.pi * turn
    about = angle.cos().unsqueeze(-1) * first + angle.sin().unsqueeze(-1) * second
    return (1 - less).unsqueeze(-1) * u + aside.unsqueeze(-1) * about


def lamp_places(count: int, room: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    """Positions (m) of so many lamps on the ceiling of a room with sides in m: in rows along its
    first side, spread as evenly as they can be."""
    rows = max(1, round(math.sqrt(count * room[1] / room[0])))
    each = [count // rows + (row < count % rows) for row in range(rows)]
    return tuple(
        (room[0] * (i + 0.5) / many, room[1] * (row + 0.5) / rows, room[2])
        for row, many in enumerate(each)
        for i in range(many)
    )


@dataclass(frozen=True)
class LightOptions(Group):
    """With ``light``, UAVs see so many ``lamps``, evenly on the ceiling, within ``light_radius`` m:
    how bright each is (``lamp_power`` lx at 1 m straight below, with ``light_ambient`` lx of other
    light), with noise of a share ``light_share`` and a floor of ``light_floor`` lx, and its
    direction (body frame), to ``light_angle_std`` rad. Walls and obstacles hide lamps."""

    title: ClassVar[str] = "lamps"

    light: bool = False
    lamps: PositiveCount = 6
    lamp_power: LampPower = 1000.0
    light_ambient: Lux = 20.0
    light_share: Share = 0.05
    light_floor: Lux = 0.5
    light_angle_std: Radians = 0.05
    light_radius: PositiveMetres = 10.0

    def true(self, room: tuple[float, ...], sight: Sight) -> tuple[Light, ...]:
        """The sensor as it is, in a room with sides in m and what stands in it; nothing without
        light."""
        if not self.light:
            return ()
        own = (self.lamp_power, self.light_ambient, self.light_share, self.light_floor)
        seen = (self.light_angle_std, self.light_radius, sight)
        return (Light(lamp_places(self.lamps, room), *own, *seen),)
