"""Rotations of clouds about one rotation, against matrices in float64."""

import pytest
import torch
from torch import Tensor

from agents.models import rotations
from coloc_env import geometry

B, N, M = 2, 3, 40


def unit(attitude: Tensor) -> Tensor:
    return attitude if attitude.shape[-1] == 1 else torch.nn.functional.normalize(attitude, dim=-1)


def attitudes(size: int, spread: float) -> tuple[Tensor, Tensor]:
    """One attitude a UAV, and a cloud about it, quaternions of either sign."""
    g = torch.Generator().manual_seed(size)
    about = 3 * torch.randn(B, N, size, generator=g)
    about = unit(about)
    delta = spread * torch.randn(B, N, M, 3 if size == 4 else 1, generator=g)
    cloud = geometry.rotate_by(about.unsqueeze(-2), delta)
    if size == 4:
        cloud = torch.where(torch.rand(B, N, M, 1, generator=g) < 0.5, -cloud, cloud)
    return about, cloud


@pytest.mark.parametrize("size", [1, 4])
@pytest.mark.parametrize("spread", [1e-3, 2.0])
def test_a_turn_is_what_matrices_differ_by(size: int, spread: float) -> None:
    """R̄ᵀ R − I, and as precise as its size where rotations are close."""
    about, cloud = attitudes(size, spread)
    dim = 3 if size == 4 else 2
    turn = rotations.turn(cloud, about)
    by = rotations.turn_map(dim, turn.dtype, turn.device)
    found = (turn.mT @ by).unflatten(-1, (dim, dim)).double()
    own, centre = (geometry.rotation_matrix(unit(x.double())) for x in (cloud, about))
    expected = centre.mT.unsqueeze(2) @ own - torch.eye(dim, dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=0, atol=3e-6 if spread > 1 else 5e-7)


def test_one_quaternion_times_a_cloud_is_the_product() -> None:
    about, cloud = attitudes(4, 1.0)
    one = about.unsqueeze(-2)
    found = rotations.product(one, cloud)
    torch.testing.assert_close(found, geometry.quaternion_product(one, cloud), rtol=0, atol=3e-7)
    for m in (25, 33):  # as many as there are must not show
        assert torch.equal(rotations.product(one[1:, :1], cloud[1:, :1, :m]), found[1:, :1, :m])
