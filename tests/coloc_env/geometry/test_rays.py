"""Rays in a room, against a walk along them in small steps, and finite differences."""

import pytest
import torch
from torch import Tensor

from coloc_env.geometry.rays import corner_curvature, first_surface

ROOM = ((0.0, 0.0, 0.0), (6.0, 4.0, 3.0))
BOXES = (((2.0, 1.0, 0.0), (3.0, 2.0, 2.0)), ((4.0, 0.0, 1.0), (4.5, 3.0, 3.0)))


def inside(x: Tensor, box: tuple) -> Tensor:
    low, high = (x.new_tensor(corner) for corner in box)
    return ((x > low) & (x < high)).all(-1)


def rays(count: int) -> tuple[Tensor, Tensor]:
    """From free points in the room, some along its axes."""
    g = torch.Generator().manual_seed(0)
    origin = torch.rand(count, 3, generator=g, dtype=torch.float64) * torch.tensor(ROOM[1])
    free = ~(inside(origin, BOXES[0]) | inside(origin, BOXES[1]))
    way = torch.randn(count, 3, generator=g, dtype=torch.float64)
    way[: count // 4] = torch.eye(3, dtype=torch.float64).repeat(count, 1)[: count // 4]
    way[: count // 8] *= -1
    return origin[free], (way / way.norm(dim=-1, keepdim=True))[free]


def test_the_first_surface_is_where_a_walk_ends() -> None:
    origin, way = rays(200)
    distance, _ = first_surface(origin, way, ROOM, BOXES)
    for t, p, b in zip(distance, origin, way, strict=True):
        path = p + torch.linspace(0, 8, 4001, dtype=torch.float64).unsqueeze(-1) * b
        ends = ~inside(path, ROOM) | inside(path, BOXES[0]) | inside(path, BOXES[1])
        walked = 8 / 4000 * int(ends.to(torch.int8).argmax())
        assert float(t) == pytest.approx(walked, abs=2.1e-3)
    walls, _ = first_surface(origin, way, ROOM)
    assert 0.1 < float((distance < walls).double().mean()) < 0.9


def test_derivatives_are_those_of_the_distance() -> None:
    origin, way = rays(60)
    distance, slope = first_surface(origin, way, ROOM, BOXES)
    steep = slope.abs().amax(-1) < 20  # not along a face
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-6
        for name, by in (("origin", slope), ("way", distance.unsqueeze(-1) * slope)):
            ends = [
                first_surface(
                    origin + s * step * (name == "origin"),
                    way + s * step * (name == "way"),
                    ROOM,
                    BOXES,
                )[0]
                for s in (1, -1)
            ]
            change = (ends[0] - ends[1]) / 2e-6
            torch.testing.assert_close(change[steep], by[steep, axis], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("std", [0.05, 0.3])
def test_corners_count_about_what_linearizing_neglects(std: float) -> None:
    """½ (c σ²)² against sampling, for points of the room: seldom less, where a third wall or the
    point's own wall matters too, and next to nothing far from corners."""
    origin, way = rays(300)
    distance, slope = first_surface(origin, way, ROOM)
    g = torch.Generator().manual_seed(1)
    delta = std * torch.randn(1000, len(origin), 3, generator=g, dtype=torch.float64)
    moved = origin + delta
    within = inside(moved, ROOM)
    there, _ = first_surface(moved, way, ROOM)
    left = (there - distance - (slope * delta).sum(-1)).square()
    found = torch.where(within, left, 0.0).sum(0) / within.sum(0)
    counted = 0.5 * (corner_curvature(origin, way, ROOM) * std**2) ** 2
    near = found > 0.01 * std**2
    assert 0.05 < float(near.double().mean()) < 0.4
    assert 0.3 < float((found / counted)[near].median()) < 1
    assert float((found > 1.2 * counted + 1e-12).double().mean()) < (0.03 if std < 0.1 else 0.2)
    upright = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    assert float(corner_curvature(origin[:1], upright, ROOM)) < 1e-6
