"""SE(2), SE(3), SO(3): exp, log, Ad and Jacobians against scipy, GTSAM, pypose, and themselves."""

import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch import Tensor

from coloc_env.geometry import (
    Poses,
    Se2,
    Se3,
    cross_matrix,
    pair_differences,
    pair_distances,
    quaternion_exp,
    quaternion_log,
    quaternion_matrix,
    rotation_matrix,
    so3,
)
from coloc_env.geometry.coefficients import inverse_coefficient, stumpff

PI = math.pi
GROUPS = [Se2, Se3]
# On both sides of where the series ends (1 rad), at zero, and up to half a turn.
ANGLES = [0.0, 1e-200, 1e-9, 1e-4, 0.1, 0.999999, 1.0, 1.000001, 2.5, 3.14, PI - 1e-7]

both = pytest.mark.parametrize("poses", GROUPS)
numbers = st.floats(-3.0, 3.0, allow_subnormal=False)


def tangents(poses: type[Poses], count: int = 40, largest: float = PI - 1e-7) -> Tensor:
    """Tangent vectors of every angle in ``ANGLES`` and of others up to ``largest``."""
    g = torch.Generator().manual_seed(count)
    angle = torch.rand(count, generator=g, dtype=torch.float64) * largest
    angle[: len(ANGLES)] = torch.tensor(ANGLES, dtype=torch.float64).clamp(max=largest)
    rho = 2 * torch.randn(count, poses.dim, generator=g, dtype=torch.float64)
    axis = torch.randn(count, poses.dof - poses.dim, generator=g, dtype=torch.float64)
    axis = axis / axis.norm(dim=-1, keepdim=True)
    return torch.cat((rho, axis * angle.unsqueeze(-1)), -1)


def algebra(xi: Tensor) -> np.ndarray:
    """The matrices whose exponentials are the poses."""
    d = 2 if xi.shape[-1] == 3 else 3
    hat = torch.zeros(*xi.shape[:-1], d + 1, d + 1, dtype=xi.dtype)
    if d == 2:
        hat[..., 1, 0], hat[..., 0, 1] = xi[..., 2], -xi[..., 2]
    else:
        hat[..., :3, :3] = cross_matrix(xi[..., 3:])
    hat[..., :d, d] = xi[..., :d]
    return hat.numpy()


def homogeneous(poses: type[Poses], x: Tensor) -> np.ndarray:
    position, attitude = poses.split(x)
    found = torch.eye(poses.dim + 1, dtype=x.dtype).repeat(*x.shape[:-1], 1, 1)
    found[..., : poses.dim, : poses.dim] = rotation_matrix(attitude)
    found[..., : poses.dim, poses.dim] = position
    return found.numpy()


def close(found: Any, expected: Any, atol: float) -> None:
    np.testing.assert_allclose(np.asarray(found), np.asarray(expected), rtol=0, atol=atol)


# ---------------------------------------------------------------- against scipy


@both
def test_exp_is_the_matrix_exponential(poses: type[Poses]) -> None:
    xi = tangents(poses)
    close(homogeneous(poses, poses.exp(xi)), expm(algebra(xi)), 2e-14)
    beyond = tangents(poses, largest=9.0)  # more than one turn
    close(homogeneous(poses, poses.exp(beyond)), expm(algebra(beyond)), 5e-13)  # expm's error


def test_log_of_scipys_rotations() -> None:
    rotation = Rotation.random(500, rng=np.random.default_rng(0))
    position = np.random.default_rng(1).normal(size=(500, 3))
    x = np.concatenate((position, rotation.as_quat(scalar_first=True)), -1)
    xi = Se3.log(torch.from_numpy(x))
    close(xi[:, 3:], rotation.as_rotvec(), 1e-14)
    close(expm(algebra(xi))[:, :3, 3], position, 1e-13)


@both
def test_products_are_products_of_matrices(poses: type[Poses]) -> None:
    a, b = poses.exp(tangents(poses)), poses.exp(tangents(poses).flip(0))
    ma, mb = homogeneous(poses, a), homogeneous(poses, b)
    close(homogeneous(poses, poses.compose(a, b)), ma @ mb, 2e-14)
    close(homogeneous(poses, poses.between(a, b)), np.linalg.solve(ma, mb), 2e-14)
    close(homogeneous(poses, poses.inverse(a)), np.linalg.inv(ma), 2e-14)
    point = tangents(poses)[:, : poses.dim]
    applied = (ma[:, : poses.dim, : poses.dim] @ point.numpy()[..., None])[..., 0]
    close(poses.act(a, point), applied + ma[:, : poses.dim, poses.dim], 2e-14)


@both
def test_adjoint_moves_a_tangent_to_the_other_side(poses: type[Poses]) -> None:
    x, xi = poses.exp(tangents(poses)), 0.7 * tangents(poses).flip(0)
    moved = poses.carry(x, xi)
    right = homogeneous(poses, x) @ expm(algebra(xi))
    close(expm(algebra(moved)) @ homogeneous(poses, x), right, 1e-13)
    close((poses.adjoint(x) @ xi.unsqueeze(-1))[..., 0], moved, 2e-14)


# ---------------------------------------------------------------- inverses and identities


@both
@given(data=st.data())
@settings(deadline=None, max_examples=80)
def test_plus_and_minus_are_inverse(poses: type[Poses], data: st.DataObject) -> None:
    start, xi = (
        torch.tensor(data.draw(st.tuples(*[numbers] * poses.dof)), dtype=torch.float64)
        for _ in range(2)
    )
    x = poses.exp(start)
    y = poses.plus(x, xi)
    back = poses.minus(y, x)
    angle = float(back[poses.dim :].norm())
    assert angle <= PI + 1e-12
    close(homogeneous(poses, poses.plus(x, back)), homogeneous(poses, y), 1e-12)
    if float(xi[poses.dim :].norm()) < PI - 1e-6:
        close(back, xi, 1e-12)


@both
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_log_undoes_exp(poses: type[Poses], dtype: torch.dtype) -> None:
    xi = tangents(poses, largest=3.14).to(dtype)
    found = poses.log(poses.exp(xi))
    assert found.dtype == dtype
    close(found, xi, 60 * torch.finfo(dtype).eps)


@both
def test_half_turns(poses: type[Poses]) -> None:
    """At π the axis has two signs; either leads to the same pose."""
    xi = tangents(poses)[2:]  # those with an axis
    xi = torch.cat((xi[:, : poses.dim], PI * torch.nn.functional.normalize(xi[:, poses.dim :])), -1)
    x = poses.exp(xi)
    back = poses.log(x)
    close(back[:, poses.dim :].norm(dim=-1), PI, 1e-14)
    close(homogeneous(poses, poses.exp(back)), homogeneous(poses, x), 2e-14)


@both
def test_identity_and_zero(poses: type[Poses]) -> None:
    zero = torch.zeros(poses.dof, dtype=torch.float64)
    x = poses.identity(zero)
    assert x.shape == (poses.size,)
    close(homogeneous(poses, x), np.eye(poses.dim + 1), 0)
    assert torch.equal(poses.log(x), zero)
    for jacobian in (poses.right_jacobian(zero), poses.right_jacobian_inverse(zero)):
        close(jacobian, np.eye(poses.dof), 0)


@both
def test_a_long_product_stays_a_pose(poses: type[Poses]) -> None:
    step = tangents(poses)[-1].float()
    x = poses.identity(step)
    for _ in range(500):
        x = poses.plus(x, step)
    close(poses.quaternion(x).norm(), 1.0, 3e-7)


@both
def test_leading_dimensions_broadcast(poses: type[Poses]) -> None:
    a, b = poses.exp(tangents(poses, 12)), poses.exp(tangents(poses, 15))
    xi = tangents(poses, 15)
    for of, right in (
        (poses.compose, b),
        (poses.between, b),
        (poses.minus, b),
        (poses.plus, xi),
        (poses.carry, xi),
    ):
        table = of(a.unsqueeze(1), right)
        assert table.shape[:2] == (12, 15)
        close(table[3, 7], of(a[3], right[7]), 1e-15)


# ---------------------------------------------------------------- Jacobians


def numeric_right_jacobian(poses: type[Poses], xi: Tensor, step: float = 1e-5) -> Tensor:
    """Central differences of ``exp(ξ)⁻¹ exp(ξ + δ)``."""
    delta = step * torch.eye(poses.dof, dtype=xi.dtype)
    xi, x = xi.unsqueeze(-2), poses.exp(xi).unsqueeze(-2)
    up, down = (poses.minus(poses.exp(xi + sign * delta), x) for sign in (1, -1))
    return ((up - down) / (2 * step)).mT


@both
def test_right_jacobian_is_the_derivative(poses: type[Poses]) -> None:
    xi = tangents(poses)
    close(poses.right_jacobian(xi), numeric_right_jacobian(poses, xi), 2e-9)


def test_right_jacobian_of_rotations_is_the_derivative() -> None:
    v = tangents(Se3)[:, 3:]
    turns = torch.cat((torch.zeros_like(v), v), -1)
    expected = numeric_right_jacobian(Se3, turns)[..., 3:, 3:]
    close(so3.right_jacobian(v), expected, 2e-9)
    eye = so3.right_jacobian(v) @ so3.right_jacobian_inverse(v)
    close(eye, np.broadcast_to(np.eye(3), eye.shape), 1e-14)


@both
def test_inverse_right_jacobian(poses: type[Poses]) -> None:
    xi = tangents(poses, largest=5.0)
    product = poses.right_jacobian(xi) @ poses.right_jacobian_inverse(xi)
    close(product, np.broadcast_to(np.eye(poses.dof), product.shape), 1e-13)


@both
def test_jacobians_leave_their_own_argument(poses: type[Poses]) -> None:
    """``J_r(r) r = r``: why a Gauss–Newton step of one factor needs no solve."""
    r = tangents(poses)
    close((poses.right_jacobian(r) @ r.unsqueeze(-1))[..., 0], r, 1e-12)
    close((poses.right_jacobian_inverse(r) @ r.unsqueeze(-1))[..., 0], r, 1e-12)


@both
def test_a_step_at_either_end_closes_one_relative_pose(poses: type[Poses]) -> None:
    """For r = log(T⁻¹ x_i⁻¹ x_j): −r at x_j, or Ad(T) r at x_i, and nothing is left."""
    start, measured, noise = (tangents(poses, n)[:15] for n in (15, 16, 17))
    x_i, t = poses.exp(start), poses.exp(measured.roll(3, 0))
    x_j = poses.plus(poses.compose(x_i, t), noise.roll(7, 0))
    r = poses.minus(poses.between(x_i, x_j), t)
    assert r.norm(dim=-1).max() > 1
    at_j = poses.between(x_i, poses.plus(x_j, -r))
    at_i = poses.between(poses.plus(x_i, poses.carry(t, r)), x_j)
    for closed in (at_j, at_i):
        close(poses.minus(closed, t), torch.zeros_like(r), 1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coefficients_meet_where_the_series_ends(dtype: torch.dtype) -> None:
    """Against the series with twice the terms, which float64 sums exactly up to s = 2."""
    s = torch.linspace(0, 2, 201, dtype=torch.float64)
    powers = s.unsqueeze(-1) ** torch.arange(20)
    eps = torch.finfo(dtype).eps
    for order, found in enumerate(stumpff(s.to(dtype), range(6))):
        terms = [(-1) ** n / math.factorial(2 * n + order) for n in range(20)]
        close(
            found * math.factorial(order), powers @ s.new_tensor(terms) * terms[0] ** -1, 150 * eps
        )
    half = 0.5 * s[1:].sqrt()
    expected = (half.sin() - half * half.cos()) / (s[1:] * half.sin())
    close(12 * inverse_coefficient(s[50:].to(dtype)), 12 * expected[49:], 100 * eps)


# ---------------------------------------------------------------- gradients


@both
@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-9, 0.999999, 1.0, 2.5, PI - 1e-7])
def test_gradients(poses: type[Poses], angle: float) -> None:
    xi = tangents(poses)[-1]
    turn = torch.nn.functional.normalize(xi[poses.dim :], dim=-1) * angle
    xi = torch.cat((xi[: poses.dim], turn)).requires_grad_()
    x = poses.exp(xi.detach()).requires_grad_()
    for of, at in (
        (poses.exp, xi),
        (poses.log, x),
        (lambda x: poses.minus(x, poses.exp(0.1 * xi.detach())), x),
        (lambda xi: poses.log(poses.exp(xi)), xi),
        (poses.right_jacobian, xi),
        (poses.right_jacobian_inverse, xi),
    ):
        assert torch.autograd.functional.jacobian(of, at).isfinite().all()
        if angle < 3.14:  # finite differences would step over the half turn
            assert torch.autograd.gradcheck(of, at, atol=1e-6)


@both
def test_gradient_of_log_of_exp_is_one(poses: type[Poses]) -> None:
    for xi in tangents(poses, 20):
        jacobian = torch.autograd.functional.jacobian(lambda v: poses.log(poses.exp(v)), xi)
        close(jacobian, np.eye(poses.dof), 1e-8)


@both
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_at_the_identity_of_batches(poses: type[Poses], dtype: torch.dtype) -> None:
    """One row at zero must not spoil it, nor the others (``where`` would pass NaN on)."""
    xi = tangents(poses).to(dtype)
    xi[1] = 0
    xi.requires_grad_()
    x = poses.exp(xi)
    (poses.minus(x, x.detach()).sum() + poses.right_jacobian(xi).sum()).backward()
    assert xi.grad is not None
    assert xi.grad.isfinite().all()


@both
def test_function_transforms(poses: type[Poses]) -> None:
    xi = tangents(poses, 12, largest=2.0)
    start = poses.exp(0.5 * xi[0])

    def residual(v: Tensor) -> Tensor:
        return poses.minus(poses.exp(v), start)

    forward = torch.func.vmap(torch.func.jacfwd(residual))(xi)
    backward = torch.func.vmap(torch.func.jacrev(residual))(xi)
    torch.testing.assert_close(forward, backward, rtol=1e-9, atol=1e-9)


# ---------------------------------------------------------------- pairs


@both
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pairs_are_differences_one_by_one(poses: type[Poses], dtype: torch.dtype) -> None:
    g = torch.Generator().manual_seed(3)
    x, y = (
        poses.exp(2 * torch.randn(2, n, poses.dof, generator=g, dtype=torch.float64)).to(dtype)
        for n in (5, 7)
    )
    y[:, :2] = x[:, :2]
    weights = torch.rand(2, 5, 7, generator=g, dtype=torch.float64).to(dtype)
    apart = poses.between(x.unsqueeze(-2), y.unsqueeze(-3))
    turn = poses.log(apart)[..., poses.dim :]
    position = apart[..., : poses.dim]
    distance, angle = pair_distances(poses, x, y)
    tolerance = 300 * torch.finfo(dtype).eps
    close(distance, (position**2).sum(-1), tolerance)
    close(angle, (turn**2).sum(-1), tolerance)
    expected = (weights.unsqueeze(-1) * torch.cat((position, turn), -1)).sum(-2)
    close(pair_differences(poses, x, y, weights), expected, tolerance)


@both
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pulls_are_sums_of_differences(poses: type[Poses], dtype: torch.dtype) -> None:
    g = torch.Generator().manual_seed(4)
    x, y = (
        poses.exp(2 * torch.randn(2, n, poses.dof, generator=g, dtype=torch.float64)).to(dtype)
        for n in (5, 7)
    )
    y[:, :2] = x[:, :2]
    w = torch.rand(2, 7, generator=g, dtype=torch.float64).to(dtype)
    found = poses.pulls(x, y, w)
    for m in range(5):
        tangent = torch.stack([poses.minus(y[:, n], x[:, m]) for n in range(7)], 1)
        position, turn = tangent[..., : poses.dim], tangent[..., poses.dim :]
        tolerance = 300 * torch.finfo(dtype).eps
        close(found.tangent[:, m], (w.unsqueeze(-1) * tangent).sum(1), tolerance)
        close(found.position[:, m], (w * position.square().sum(-1)).sum(1), 10 * tolerance)
        close(found.turn[:, m], (w * turn.square().sum(-1)).sum(1), tolerance)


@both
def test_pair_differences_are_the_gradient_of_the_distances(poses: type[Poses]) -> None:
    g = torch.Generator().manual_seed(4)
    x, y = (poses.exp(torch.randn(6, poses.dof, generator=g, dtype=torch.float64)) for _ in "xy")

    def energy(delta: Tensor) -> Tensor:
        return -0.5 * sum(d.sum() for d in pair_distances(poses, poses.plus(x, delta), y))

    zero = torch.zeros(6, poses.dof, dtype=torch.float64)
    gradient = torch.autograd.functional.jacobian(energy, zero)
    ones = torch.ones(6, 6, dtype=torch.float64)
    close(pair_differences(poses, x, y, ones), gradient, 1e-12)


# ---------------------------------------------------------------- against other libraries
# Not at tiny angles: GTSAM's Pose2 is then wrong by 2e-7 m (at 1e-9 rad), pypose by 3e-10 m;
# scipy's matrix exponential, above, sides with us.


def moderate(poses: type[Poses]) -> Tensor:
    xi = tangents(poses, largest=3.1)
    return xi[xi[:, poses.dim :].norm(dim=-1) > 0.05]


def rotation_first(poses: type[Poses], matrix: Tensor) -> np.ndarray:
    """A Jacobian or Ad in GTSAM's order of tangents (the plane's is like ours)."""
    order = [3, 4, 5, 0, 1, 2] if poses is Se3 else [0, 1, 2]
    return matrix.numpy()[..., order, :][..., order]


@both
def test_gtsam(poses: type[Poses]) -> None:
    gtsam = pytest.importorskip("gtsam", reason="the `oracles` extra has gtsam")
    theirs = gtsam.Pose3 if poses is Se3 else gtsam.Pose2
    order = [3, 4, 5, 0, 1, 2] if poses is Se3 else [0, 1, 2]
    xi, eta = moderate(poses), 0.5 * moderate(poses).flip(0)
    x, y = poses.exp(xi), poses.exp(eta)
    for i in range(len(xi)):
        a, b = theirs.Expmap(xi[i].numpy()[order]), theirs.Expmap(eta[i].numpy()[order])
        close(homogeneous(poses, x[i]), a.matrix(), 2e-12)
        close(poses.minus(y, x)[i].numpy()[order], theirs.Logmap(a.between(b)), 2e-12)
        close(rotation_first(poses, poses.adjoint(x)[i]), a.AdjointMap(), 2e-12)
        jacobian = theirs.ExpmapDerivative(xi[i].numpy()[order])
        close(rotation_first(poses, poses.right_jacobian(xi)[i]), jacobian, 1e-9)
        inverse = theirs.LogmapDerivative(a)
        close(rotation_first(poses, poses.right_jacobian_inverse(xi)[i]), inverse, 1e-9)


def test_pypose() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pp = pytest.importorskip("pypose", reason="the `oracles` extra has pypose")
    xi, eta = moderate(Se3), 0.5 * moderate(Se3).flip(0)
    ours, theirs = Se3.exp(xi), pp.se3(xi).Exp()
    scalar_last = ours[:, [0, 1, 2, 4, 5, 6, 3]]
    close(
        scalar_last * scalar_last[:, 6:].sign(),
        theirs.tensor() * theirs.tensor()[:, 6:].sign(),
        1e-12,
    )
    close(Se3.log(ours), theirs.Log().tensor(), 1e-12)
    close(Se3.carry(ours, eta), theirs.Adj(pp.se3(eta)).tensor(), 1e-12)
    close(so3.right_jacobian(xi[:, 3:]), pp.so3(xi[:, 3:]).Jr(), 1e-9)
    close(quaternion_matrix(ours[:, 3:]), theirs.rotation().matrix(), 1e-12)
    close(quaternion_log(quaternion_exp(xi[:, 3:])), pp.so3(xi[:, 3:]).Exp().Log().tensor(), 1e-12)
