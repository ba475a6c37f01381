"""Log-likelihoods of particles against direct sums in float64."""

from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from agents.models.measurements import LandmarkVectors, Neighbours, UavRanges
from agents.models.process import ConstantVelocityProcess, InertialProcess, Process, WheeledProcess
from agents.particle.likelihood import (
    landmark_log_likelihood,
    log_likelihood,
    range_log_likelihood,
)
from agents.robust import Trust
from coloc_env.geometry import rotation_matrix
from coloc_env.observation import Observation
from coloc_env.scenario import ConstantVelocity, Inertial
from coloc_env.sensors import Imu, Landmarks, Odometry, RangeNoise, Ranging

B, N, M, COUNT = 2, 3, 200, 12
PLANE, SPACE = WheeledProcess(0.1, Odometry()), InertialProcess(0.1, Imu(), Inertial())
LINEAR = ConstantVelocityProcess(3, 0.1, ConstantVelocity())


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=generator(seed))


def landmarks_seen(process: Process, centre: Tensor, origin: float) -> Observation:
    """Landmarks within some metres of the centres, half of them measured from there."""
    d = process.dim
    points = origin + 8 * torch.rand(B, N, COUNT, d, generator=generator(2)) - 4
    mask = torch.rand(B, N, COUNT, generator=generator(3)).round()
    apart = points - centre[..., None, :d]
    z = apart @ rotation_matrix(process.attitude(centre)) + 0.15 * normal(B, N, COUNT, d, seed=4)
    return Observation(
        {
            "landmarks": (z * mask.unsqueeze(-1)).flatten(-2),
            "landmark_mask": mask,
            "landmark_map": points.flatten(-2),
        }
    )


def direct(process: Process, cloud: Tensor, seen: Observation, std: float) -> Tensor:
    """−Σ‖z − Rᵀ(L − p)‖² / 2σ² of the very same float32 particles, in float64."""
    d, x = process.dim, cloud.double()
    z = seen["landmarks"].double().unflatten(-1, (-1, d)).unsqueeze(2)
    points = seen["landmark_map"].double().unflatten(-1, (-1, d)).unsqueeze(2)
    expected = (points - x[..., None, :d]) @ rotation_matrix(process.attitude(x))
    squared = ((z - expected) ** 2).sum(-1)
    return -0.5 * (squared * seen["landmark_mask"].double().unsqueeze(2)).sum(-1) / std**2


@pytest.mark.parametrize("process", [SPACE, PLANE], ids=["space", "plane"])
@pytest.mark.parametrize("origin", [0.0, 10_000.0])
@pytest.mark.parametrize("spread", [0.03, 1.0])
def test_landmark_sums_are_the_direct_sum(
    process: Process, origin: float, spread: float, tools: SimpleNamespace
) -> None:
    """Up to a constant per UAV, whatever the distance to the origin."""
    std = 0.15
    x, centre = tools.cloud(process, spread, origin)
    seen = landmarks_seen(process, centre, origin)
    model = LandmarkVectors(Landmarks(COUNT, std))
    found = landmark_log_likelihood(model, process, x, centre, seen, Trust()).double()
    expected = direct(process, x, seen, std)
    apart = (found - found[..., :1]) - (expected - expected[..., :1])
    size = (expected - expected.amax(-1, keepdim=True)).abs().amax()
    assert apart.abs().max() < 2e-3 + 3e-6 * size


def test_landmark_sums_need_an_attitude(tools: SimpleNamespace) -> None:
    x, centre = tools.cloud(LINEAR, 1.0)
    seen = landmarks_seen(SPACE, tools.cloud(SPACE, 1.0)[1], 0.0)
    with pytest.raises(ValueError, match="the motion model has no attitude"):
        landmark_log_likelihood(LandmarkVectors(Landmarks(COUNT)), LINEAR, x, centre, seen, Trust())


def ranges_seen(process: Process, centre: Tensor, origin: float) -> tuple[Observation, Neighbours]:
    d = process.dim
    place = origin + 10 * torch.rand(B, N, 5, d, generator=generator(5)) - 5
    mask = torch.rand(B, N, 5, generator=generator(6)).round()
    distance = (centre[..., None, :d] - place).norm(dim=-1)
    near = Neighbours(
        place,
        torch.rand(B, N, 5, d, generator=generator(7)),
        torch.rand(B, N, 5, generator=generator(8)) > 0.3,
    )
    noisy = distance + 0.2 * normal(B, N, 5, seed=9)
    return Observation({"ranges": noisy * mask, "range_mask": mask}), near


@pytest.mark.parametrize("origin", [0.0, 10_000.0])
def test_range_likelihood_is_the_direct_sum(origin: float, tools: SimpleNamespace) -> None:
    x, centre = tools.cloud(SPACE, 0.3, origin)
    seen, near = ranges_seen(SPACE, centre, origin)
    model = UavRanges(Ranging(RangeNoise(0.2)))
    block = model.linearize(SPACE, centre, seen, near, derivatives=False)
    found = range_log_likelihood(block, seen["ranges"], x[..., :3], near.position, Trust())
    distance = (x[..., None, :3].double() - near.position.unsqueeze(2).double()).norm(dim=-1)
    about = centre[..., None, :3].double() - near.position.double()
    unit = torch.nn.functional.normalize(about, dim=-1)
    variance = 0.2**2 + (unit**2 * near.variance).sum(-1)
    weight = (seen["range_mask"] > 0) & near.known
    squared = (seen["ranges"].double().unsqueeze(2) - distance) ** 2
    expected = -0.5 * (squared * (weight / variance).unsqueeze(2)).sum(-1)
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=2e-3)


def test_both_ways_to_weigh_a_range_agree_at_the_centre(tools: SimpleNamespace) -> None:
    """The fast one takes the variance at the centre; tags of no length take the general way."""
    x, centre = tools.cloud(SPACE, 0.01)
    seen, near = ranges_seen(SPACE, centre, 0.0)
    bare = tuple(((0.0, 0.0, 0.0),) for _ in range(N))
    ways = [UavRanges(Ranging(RangeNoise(0.2), tags)) for tags in ((), bare)]
    fast, general = (log_likelihood([m], SPACE, x, centre, seen, near, [Trust()]) for m in ways)
    fast, general = fast - fast[..., :1], general - general[..., :1]
    torch.testing.assert_close(fast, general, rtol=0.02, atol=0.02)
