"""Distances expanded to the second order, against moments of samples."""

from dataclasses import replace

import torch

from agents.models.measurements import AnchorRanges, received
from agents.models.measurements.second_order import expanded
from agents.models.process import make_process
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import AnchorRanging
from coloc_env.world import World


def test_moments_of_a_distance_are_those_of_samples() -> None:
    """E r and Var r of distances to anchors of a Gaussian position, 0.6 and 0.4 m off."""
    scenario = make_scenario("wsn-v0", n_uavs=1)
    believed = scenario.believed
    sensor = believed.sensor(AnchorRanging)
    assert sensor is not None
    model, process = AnchorRanges(sensor), make_process(believed)
    seen = World(scenario, 1).reset(0)
    x = torch.zeros(1, 1, process.state_size, dtype=torch.float64)
    x[..., :2] = torch.tensor([4.0, 3.0])
    p = torch.tensor([[0.36, 0.1], [0.1, 0.16]], dtype=torch.float64)
    noise = torch.randn(400_000, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    places = x[0, 0, :2] + noise @ torch.linalg.cholesky(p).mT
    anchors = torch.tensor(sensor.anchors, dtype=torch.float64)
    distances = (places.unsqueeze(1) - anchors).norm(dim=-1)  # [M, m]
    mean, variance = distances.mean(0), distances.var(0)
    leaves = {**seen.leaves, "anchor_ranges": mean.to(torch.float32).expand(1, 1, -1)}
    seen = Observation(leaves)
    linear = model.linearize(process, x, seen, received(believed, seen))
    linear = replace(linear, variance=torch.zeros_like(linear.variance))
    block = expanded(model, linear, p.expand(1, 1, 1, 2, 2), seen)
    h = block.jacobian[0, 0, :, 0, :2]
    s = ((h @ p) * h).sum(-1) + block.variance[0, 0, :, 0]
    far = mean > 3.0  # σ of a fifth of the distance at most
    assert far.sum() >= 2
    assert (block.residual[0, 0, far, 0].abs() < 0.05 * linear.residual[0, 0, far, 0].abs()).all()
    torch.testing.assert_close(s[far], variance[far], rtol=0.03, atol=0.0)
