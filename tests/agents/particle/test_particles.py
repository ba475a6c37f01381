"""The parts of a particle filter: weights, resampling, regularization, tempering."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from agents.models.process import ConstantVelocityProcess, InertialProcess, Process, WheeledProcess
from agents.particle import cloud
from agents.particle.tempering import increment
from coloc_env.scenario import ConstantVelocity, Inertial
from coloc_env.sensors import Imu, Odometry

B, N, M = 2, 3, 200
PLANE, SPACE = WheeledProcess(0.1, Odometry()), InertialProcess(0.1, Imu(), Inertial())
LINEAR = ConstantVelocityProcess(3, 0.1, ConstantVelocity())


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=generator(seed))


# ---------------------------------------------------------------- weights


def weights(*values: float) -> Tensor:
    return torch.tensor(values).view(1, 1, -1)


def test_effective_sample_size() -> None:
    size = cloud.effective_sample_size
    assert float(size(weights(*[-7.0] * 10))) == pytest.approx(10)
    assert float(size(weights(0.0, *[-math.inf] * 9))) == pytest.approx(1)
    assert float(size(weights(-3000.0, -3000.0, -math.inf))) == pytest.approx(2)
    w = torch.tensor([0.5, 0.3, 0.2])
    assert float(size(w.log())) == pytest.approx(float(1 / (w**2).sum()))
    assert float(size(w.log() - 1e4)) == pytest.approx(float(1 / (w**2).sum()), rel=1e-3)


@given(st.integers(1, 60), st.floats(2**-24, 1 - 2**-24), st.integers(0, 1000))
@settings(deadline=None, max_examples=100)
def test_systematic_counts_are_within_one_of_their_mean(m: int, offset: float, seed: int) -> None:
    w = torch.rand(1, 1, m, generator=generator(seed)) ** 4 + 1e-6
    index = cloud.systematic(w, torch.full((1, 1), offset, dtype=torch.float32))
    assert index.shape == w.shape
    assert (index.diff() >= 0).all()
    counts = torch.bincount(index.flatten(), minlength=m)
    mean = m * w.flatten().double() / w.double().sum()
    assert ((counts - mean).abs() < 1 + 1e-4).all()


def test_systematic_counts_are_unbiased() -> None:
    m, draws = 50, 4000
    w = torch.rand(m, generator=generator()) ** 3
    offsets = (torch.arange(draws) + 0.5) / draws
    index = cloud.systematic(w.expand(1, draws, m), offsets.unsqueeze(0))
    counts = torch.nn.functional.one_hot(index, m).double().sum(-2).mean((0, 1))
    torch.testing.assert_close(counts, m * w.double() / w.double().sum(), rtol=0, atol=2e-3)


@pytest.mark.parametrize("offset", [2**-24, 1e-3, 0.5, 1 - 2**-24])
def test_systematic_at_the_extremes(offset: float) -> None:
    at = torch.full((1, 1), offset)
    m = 800
    equal = cloud.systematic(torch.full((1, 1, m), 1 / m), at)
    assert torch.bincount(equal.flatten(), minlength=m).max() <= 2
    if offset == 0.5:
        assert equal.flatten().tolist() == list(range(m))
    for heavy in (0, 3, m - 1):
        one = torch.zeros(1, 1, m)
        one[..., heavy] = 1.0
        assert (cloud.systematic(one, at) == heavy).all()
    tiny = torch.full((1, 1, m), 1e-40)
    tiny[..., 7] = 3e-40
    assert cloud.systematic(tiny, at).max() < m


def test_no_particle_without_weight_is_drawn() -> None:
    w = torch.rand(1, 500, 64, generator=generator())
    dead = torch.rand(1, 500, 64, generator=generator(1)) < 0.5
    index = cloud.systematic(w.masked_fill(dead, 0.0), torch.rand(1, 500, generator=generator(2)))
    assert not dead.gather(-1, index).any()


def test_select_keeps_particles_with_their_numbers() -> None:
    x = torch.arange(B * N * M * 10.0).view(B, N, M, 10)
    index = torch.randint(0, M, (B, N, 7), generator=generator())
    chosen = cloud.select(x, index)
    for b in range(B):
        for n in range(N):
            assert torch.equal(chosen[b, n], x[b, n, index[b, n]])


# ---------------------------------------------------------------- moments and moves


@pytest.mark.parametrize("process", [SPACE, PLANE, LINEAR], ids=["space", "plane", "linear"])
def test_moments_are_those_of_the_weighted_cloud(process: Process, tools: SimpleNamespace) -> None:
    x = tools.cloud(process, 0.2)[0]
    w = torch.softmax(normal(B, N, M, seed=3), -1)
    found = cloud.moments(process, x, w)
    mean, apart = found.mean, found.apart - found.shift.unsqueeze(2)
    error = (w.unsqueeze(-1) * process.boxminus(x, mean.unsqueeze(2).expand_as(x))).sum(2)
    e = process.attitude_error
    linear = (
        error
        if e is None
        else error[..., [i for i in range(error.shape[-1]) if not e.start <= i < e.stop]]
    )
    assert linear.abs().max() < 1e-5
    assert error.abs().max() < 5e-3  # an attitude's mean is that of the tangents at one particle
    expected = torch.einsum("bnm,bnmi,bnmj->bnij", w, apart, apart).double()
    torch.testing.assert_close(found.covariance, expected, rtol=1e-4, atol=1e-6)
    d = process.dim
    plain = torch.from_numpy(np.cov(x[0, 0, :, :d].numpy().T, aweights=w[0, 0].numpy(), ddof=0))
    torch.testing.assert_close(found.covariance[0, 0, :d, :d], plain, rtol=1e-3, atol=1e-5)


def test_a_mean_does_not_fear_the_seam() -> None:
    x = torch.zeros(1, 1, 4, 5)
    x[..., 4] = torch.tensor([3.1, -3.1, 3.14, -3.14])
    found = cloud.moments(PLANE, x, torch.full((1, 1, 4), 0.25))
    assert abs(float(found.mean[0, 0, 4])) == pytest.approx(math.pi, abs=1e-3)
    assert (found.apart - found.shift.unsqueeze(2)).abs().max() < 0.05


@pytest.mark.parametrize("process", [SPACE, LINEAR], ids=["space", "linear"])
@pytest.mark.parametrize("shrink", [0.0, 0.3, 0.7, 1.0])
def test_liu_west_keeps_mean_and_covariance(
    process: Process, shrink: float, tools: SimpleNamespace
) -> None:
    """Above the floor, which comes on top."""
    m, e = 20_000, process.error_size
    mean = tools.cloud(process, 0.1)[1][:1, :1]
    root = 0.1 * torch.tril(normal(e, e, seed=1))
    apart = normal(1, 1, m, e, seed=2) @ root.mT
    apart = apart - apart.mean(2, keepdim=True)
    covariance = apart.mT @ apart / m
    floor = torch.full((e,), 0.02)
    whole = cloud.Moments(mean, covariance.double(), apart, torch.zeros(1, 1, e))
    all_of_them = torch.arange(m).expand(1, 1, m)
    draws = normal(1, 1, m, e, seed=3)
    moved = cloud.liu_west(process, whole, all_of_them, draws, shrink, floor)
    error = process.boxminus(moved, mean.unsqueeze(2).expand_as(moved))
    scale = covariance.diagonal(dim1=-2, dim2=-1)[0, 0].sqrt()
    assert (error.mean((0, 1, 2)).abs() / scale).max() < 0.05
    found = (error.mT @ error / m)[0, 0]
    expected = covariance[0, 0] + torch.diag(floor**2)
    assert ((found - expected) / (scale.unsqueeze(-1) * scale)).abs().max() < 0.05


def test_liu_west_of_a_collapsed_cloud_is_the_floor() -> None:
    m, floor = 5000, torch.linspace(0.01, 0.06, 6)
    mean, apart = torch.zeros(1, 1, 6), torch.zeros(1, 1, m, 6)
    nothing = cloud.Moments(mean, torch.zeros(1, 1, 6, 6).double(), apart, mean)
    ancestors = torch.zeros(1, 1, m, dtype=torch.int64)
    moved = cloud.liu_west(LINEAR, nothing, ancestors, normal(1, 1, m, 6), 0.7, floor)
    torch.testing.assert_close(moved[0, 0].std(0), floor, rtol=0.05, atol=0)


# ---------------------------------------------------------------- tempering


@pytest.mark.parametrize("sharpness", [0.0, 1.0, 1e2, 1e4, 1e6])
@pytest.mark.parametrize("target", [0.3, 0.5])
def test_increments_keep_the_share_asked_for(sharpness: float, target: float) -> None:
    gain = -sharpness * normal(4, 5, 300, seed=1) ** 2
    left = torch.rand(4, 5, generator=generator()) * 0.9 + 0.1
    level = torch.full_like(gain, -math.log(300))
    share = increment(level, gain, left, torch.full_like(left, 300 * target))
    size = cloud.effective_sample_size(level + share.unsqueeze(-1) * gain) / 300
    assert (share > 0).all()
    assert (share <= left).all()
    assert (size >= target - 1e-4).all()
    more = 1.05 * share  # and not much less than could be had
    larger = cloud.effective_sample_size(level + more.unsqueeze(-1) * gain) / 300
    assert ((share == left) | (larger < target)).all()


def test_increments_of_a_uav_are_its_own() -> None:
    gain = -torch.tensor([1.0, 100.0, 1e4]).view(1, 3, 1) * normal(1, 3, 300, seed=1) ** 2
    level, left = torch.full_like(gain, -math.log(300)), torch.tensor([[1.0, 0.5, 1.0]])
    goal = torch.full_like(left, 150)
    together = increment(level, gain, left, goal)
    for i in range(3):
        part = slice(i, i + 1)
        assert torch.equal(
            increment(level[:, part], gain[:, part], left[:, part], goal[:, part]),
            together[:, part],
        )


def test_particles_that_cannot_be_have_no_share() -> None:
    gain = -0.1 * normal(1, 2, 300, seed=1) ** 2
    gain[..., ::3] = -math.inf
    level, left = torch.full_like(gain, -math.log(300)), torch.ones(1, 2)
    share = increment(level, gain, left, torch.full_like(left, 150))
    assert torch.equal(share, left)  # 200 of 300 particles are left, whatever the share
    w = (level + share.unsqueeze(-1) * gain).softmax(-1)
    assert not w[..., ::3].any()
    ancestors = cloud.systematic(w, torch.full((1, 2), 0.5))
    assert (ancestors % 3 != 0).all()
