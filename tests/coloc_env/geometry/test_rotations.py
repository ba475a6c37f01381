"""Rotations against scipy, their inverses, and gradients where the formulas change."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from agents.models import rotations
from coloc_env import geometry

PI = math.pi
components = st.floats(-4.0, 4.0, allow_subnormal=False)
vectors = st.tuples(components, components, components).map(
    lambda v: torch.tensor(v, dtype=torch.float64)
)


def turns(count: int = 200) -> Tensor:
    """Rotation vectors of every size up to π, tiny ones included."""
    g = torch.Generator().manual_seed(0)
    axis = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=g, dtype=torch.float64), dim=-1
    )
    angle = torch.logspace(-12, 0, count, dtype=torch.float64) * (PI - 1e-9)
    return axis * angle.unsqueeze(-1)


def quaternion(v: Tensor) -> Tensor:
    """scipy's exponential, scalar first."""
    q = Rotation.from_rotvec(v.numpy()).as_quat(scalar_first=True)
    return torch.from_numpy(q)


def wide(x: Tensor) -> Tensor:
    """With the dimensions of a cloud of particles."""
    return x[None, None]


# ---------------------------------------------------------------- against scipy


def test_exp_is_scipys() -> None:
    v = turns()
    torch.testing.assert_close(geometry.quaternion_exp(v), quaternion(v), rtol=0, atol=3e-16)


def test_log_is_scipys() -> None:
    v = turns()
    expected = Rotation.from_rotvec(v.numpy()).as_rotvec()
    found = geometry.quaternion_log(quaternion(v)).numpy()
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_log_and_exp_are_exact_relative_to_the_angle(dtype: torch.dtype) -> None:
    v = turns().to(dtype)
    found = geometry.quaternion_log(geometry.quaternion_exp(v))
    relative = (found - v).norm(dim=-1) / v.norm(dim=-1)
    assert relative[:-1].max() < 10 * torch.finfo(dtype).eps  # the last is π, of either sign


def test_matrix_product_and_rotation_are_scipys() -> None:
    v, w = turns(), turns().flip(0)
    a, b = Rotation.from_rotvec(v.numpy()), Rotation.from_rotvec(w.numpy())
    qa, qb = quaternion(v), quaternion(w)
    points = turns().roll(7, 0)
    np.testing.assert_allclose(geometry.quaternion_matrix(qa), a.as_matrix(), atol=1e-15)
    product = geometry.quaternion_product(qa, qb)
    np.testing.assert_allclose(geometry.quaternion_matrix(product), (a * b).as_matrix(), atol=3e-15)
    np.testing.assert_allclose(geometry.rotate(qa, points), a.apply(points), atol=5e-15)
    np.testing.assert_allclose(geometry.unrotate(qa, points), a.inv().apply(points), atol=5e-15)


def test_yaw_turns_forward_to_the_left() -> None:
    turned = geometry.rotate(geometry.yaw_quaternion(torch.tensor(PI / 2)), torch.eye(3)[0])
    torch.testing.assert_close(turned, torch.tensor([0.0, 1.0, 0.0]))


def test_cross_matrix() -> None:
    v, w = turns(), turns().flip(0)
    product = (geometry.cross_matrix(v) @ w.unsqueeze(-1))[..., 0]
    torch.testing.assert_close(product, torch.linalg.cross(v, w))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_states_and_clouds_rotate_alike(dtype: torch.dtype) -> None:
    """``rotations`` has a form for each; both are the same algebra."""
    v = turns().to(dtype)
    q, p = geometry.quaternion_exp(v), geometry.quaternion_exp(v.flip(0))
    ways = {
        "product": (q, p),
        "matrix": (q,),
        "exp": (v,),
        "rotate": (q, v.flip(0)),
        "rotate_by": (q, v.flip(0)),
        "rotation_between": (q, p),
    }
    for name, arguments in ways.items():
        of = getattr(rotations, name)
        state, cloud = of(*arguments), of(*(wide(x) for x in arguments))[0, 0]
        assert state.dtype == dtype
        tolerance = 20 * torch.finfo(dtype).eps
        torch.testing.assert_close(state, cloud, rtol=0, atol=tolerance, msg=name)


# ---------------------------------------------------------------- inverses


@given(vectors, vectors)
@settings(deadline=None, max_examples=200)
def test_plus_and_minus_are_inverse(v: Tensor, w: Tensor) -> None:
    start = geometry.quaternion_exp(v)
    moved = geometry.rotate_by(start, w)
    torch.testing.assert_close(moved.norm(), torch.tensor(1.0).double(), rtol=0, atol=1e-15)
    back = geometry.rotation_between(start, moved)
    assert back.norm() <= PI + 1e-12
    again = geometry.rotate_by(start, back)
    same = torch.minimum((again - moved).norm(), (again + moved).norm())
    assert same < 1e-14
    if w.norm() < PI - 1e-6:
        torch.testing.assert_close(back, w, rtol=0, atol=1e-12)


@given(vectors)
@settings(deadline=None, max_examples=100)
def test_both_signs_of_a_quaternion_are_one_rotation(v: Tensor) -> None:
    q = geometry.quaternion_exp(v)
    torch.testing.assert_close(geometry.quaternion_matrix(q), geometry.quaternion_matrix(-q))
    a, b = geometry.quaternion_log(q), geometry.quaternion_log(-q)
    assert min((a - b).norm(), (a + b).norm()) < 1e-12  # at π itself the axis has two signs


@pytest.mark.parametrize("real", [0.0, -0.0, 1e-12, -1e-12])
def test_half_turns(real: float) -> None:
    q = torch.tensor([real, 0.0, 1.0, 0.0], dtype=torch.float64)
    v = geometry.quaternion_log(q)
    assert abs(float(v.norm()) - PI) < 1e-11
    torch.testing.assert_close(
        geometry.quaternion_matrix(geometry.quaternion_exp(v)),
        torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)),
        rtol=0,
        atol=1e-11,
    )


def test_plane_is_the_vertical_axis_of_space() -> None:
    heading = torch.linspace(-4, 4, 50, dtype=torch.float64).unsqueeze(-1)
    flat = geometry.rotation_matrix(heading)
    space = geometry.quaternion_matrix(geometry.yaw_quaternion(heading[:, 0]))
    torch.testing.assert_close(flat, space[:, :2, :2])
    v = torch.randn(50, 2, dtype=torch.float64)
    torch.testing.assert_close(geometry.rotate(heading, v), (flat @ v.unsqueeze(-1))[..., 0])
    torch.testing.assert_close(geometry.unrotate(heading, geometry.rotate(heading, v)), v)


# ---------------------------------------------------------------- gradients


@pytest.mark.parametrize("exp", [geometry.quaternion_exp, rotations.exp])
@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-8, 0.01, 1.0, PI])
def test_gradient_of_exp(exp: Callable[[Tensor], Tensor], size: float) -> None:
    v = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64) * size
    jacobian = torch.autograd.functional.jacobian(exp, v)
    assert jacobian.isfinite().all()
    if size < 1e-6:
        expected = torch.cat((torch.zeros(1, 3), 0.5 * torch.eye(3))).double()
        torch.testing.assert_close(jacobian, expected, rtol=0, atol=1e-8)
    else:
        assert torch.autograd.gradcheck(exp, v.requires_grad_())


@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-8, 0.02, 1.0, 3.14159, PI])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_gradient_of_log(angle: float, sign: float) -> None:
    half = torch.tensor(0.5 * angle, dtype=torch.float64)
    q = sign * torch.stack((half.cos(), 0.6 * half.sin(), 0.8 * half.sin(), 0 * half))
    jacobian = torch.autograd.functional.jacobian(geometry.quaternion_log, q)
    assert jacobian.isfinite().all()
    if 1e-6 < angle < 3.2 and angle != PI:
        assert torch.autograd.gradcheck(geometry.quaternion_log, q.requires_grad_())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_where_formulas_could_divide_by_zero(dtype: torch.dtype) -> None:
    v = torch.tensor([[0.3, -0.2, 0.9], [0.0, 0.0, 0.0], [1e-30, 0.0, 0.0]], dtype=dtype)
    half_turns = torch.tensor([[0.0, 0.0, 0.0, 1.0], [-0.0, 0.6, 0.8, 0.0]], dtype=dtype)
    q = torch.cat((geometry.quaternion_exp(v), half_turns)).requires_grad_()
    v.requires_grad_()
    geometry.quaternion_log(q).sum().backward()
    geometry.rotation_between(q, q.detach()).sum().backward()
    geometry.quaternion_log(geometry.quaternion_exp(v)).sum().backward()
    geometry.quaternion_log(rotations.exp(v)).sum().backward()
    for leaf in (q, v):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
    torch.testing.assert_close(v.grad, torch.full_like(v, 2.0), rtol=0, atol=1e-5)


# ---------------------------------------------------------------- angles


@given(st.floats(-1e4, 1e4))
@settings(deadline=None, max_examples=300)
def test_wrapping_keeps_the_angle(angle: float) -> None:
    wrapped = float(geometry.wrap_angle(torch.tensor(angle, dtype=torch.float64)))
    assert -PI <= wrapped < PI
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wrapping_at_the_seam(dtype: torch.dtype) -> None:
    seam = torch.tensor([PI, -PI, 3 * PI, 0.0], dtype=dtype)
    near = torch.cat((seam.nextafter(seam + 1), seam.nextafter(seam - 1), seam))
    wrapped = geometry.wrap_angle(near)
    assert (wrapped >= -PI - 1e-6).all()
    assert (wrapped <= PI + 1e-6).all()
    torch.testing.assert_close(wrapped.cos(), near.cos())
    torch.testing.assert_close(geometry.wrap_angle(near + 2 * PI).cos(), near.cos())


@given(st.floats(-5, 5), st.floats(-5, 5))
@settings(deadline=None, max_examples=300)
def test_plane_angle_is_atan2(x: float, y: float) -> None:
    a, b = (torch.tensor(c, dtype=torch.float64) for c in (x, y))
    found, expected = float(geometry.plane_angle(a, b)), math.atan2(y, x + 0.0)
    assert abs(found) <= PI
    assert math.cos(found - expected) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("x", "y", "angle"),
    [
        (0.0, 1.0, PI / 2),
        (0.0, -1.0, -PI / 2),
        (-0.0, 1.0, PI / 2),
        (-0.0, -1.0, -PI / 2),
        (-1.0, 0.0, PI),
        (-1.0, -0.0, PI),
        (1.0, -0.0, 0.0),
        (0.0, 0.0, 0.0),
        (-0.0, 0.0, 0.0),
        (1e-300, 1e300, PI / 2),
    ],
)
def test_plane_angle_on_the_axes(x: float, y: float, angle: float) -> None:
    a, b = (torch.tensor(c, dtype=torch.float64) for c in (x, y))
    assert float(geometry.plane_angle(a, b)) == pytest.approx(angle, abs=1e-15)
