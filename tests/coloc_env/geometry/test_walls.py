"""Walls and columns in a line of sight, against points sampled along it."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coloc_env.geometry.walls import crossed, depth, near

# Millimetres and a half: no point lies on a face, where rounding decides.
POINT = st.tuples(*(st.integers(-5000, 15000).map(lambda mm: (mm + 0.5) / 1000) for _ in range(3)))
WALLS = (((0.0, 0.0, 0.0), (1.0, 10.0, 5.0)), ((4.0, 2.0, 1.0), (6.0, 8.0, 3.0)))
SAMPLES = 4001
ROUNDING = 1e-9  # m


def along(start, end):
    share = torch.linspace(0, 1, SAMPLES, dtype=torch.float64).unsqueeze(-1)
    return start + share * (end - start)


@settings(max_examples=60, deadline=None)
@given(POINT, POINT)
def test_crossings_and_depth_are_those_of_points_along_the_segment(a, b):
    start, end = (torch.tensor(p, dtype=torch.float64) for p in (a, b))
    points, length = along(start, end), float((end - start).norm())
    fine = length / (SAMPLES - 1)
    within, metres = 0, 0.0
    for low, high in WALLS:
        bottom, top = (torch.tensor(x, dtype=torch.float64) for x in (low, high))
        inside = ((points > bottom + ROUNDING) & (points < top - ROUNDING)).all(-1)
        within += bool(inside.any())
        metres += float(inside.sum()) * fine
    got = depth(start, end, WALLS)
    assert abs(float(got) - metres) <= 2.1 * len(WALLS) * fine + 1e-9
    count = int(crossed(start, end, WALLS))
    assert count >= within  # a corner cut finer than the samples counts, too
    if float(got) > 2 * len(WALLS) * fine:
        assert count >= 1
    if count > within:
        thin = sum(0 < float(depth(start, end, (wall,))) <= 2 * fine for wall in WALLS)
        assert thin >= count - within


@settings(max_examples=60, deadline=None)
@given(POINT, POINT, st.tuples(st.floats(0, 10), st.floats(0, 10)), st.floats(0.05, 4.0))
def test_columns_are_near_where_a_sampled_point_is(a, b, centre, radius):
    start, end, at = (torch.tensor(p, dtype=torch.float64) for p in (a, b, centre))
    points = along(start, end)
    apart = float((points[:, :2] - at).norm(dim=-1).min())
    fine = float((end - start)[:2].norm()) / (SAMPLES - 1)
    got = bool(near(start, end, at, radius))
    if apart < radius:
        assert got or radius - apart < 1e-9
    if apart > radius + fine:
        assert not got


@settings(max_examples=40, deadline=None)
@given(POINT, POINT, st.floats(0.05, 4.0))
def test_both_ends_count_the_same(a, b, radius):
    start, end = (torch.tensor(p, dtype=torch.float64) for p in (a, b))
    at = torch.tensor((3.0, 3.0), dtype=torch.float64)
    assert torch.equal(crossed(start, end, WALLS), crossed(end, start, WALLS))
    assert torch.equal(near(start, end, at, radius), near(end, start, at, radius))


def test_a_segment_along_a_face_passes_nothing_and_shapes_broadcast():
    start = torch.zeros(3, 1, 3, dtype=torch.float64)
    end = torch.tensor(np.array([[[0.0, 9.0, 0.0], [9.0, 5.0, 2.0]]]))
    assert crossed(start, end, WALLS).tolist() == [[0, 2]] * 3
    assert not near(start, start, torch.full((2,), 3.0, dtype=torch.float64), 1.0).any()
