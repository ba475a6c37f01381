"""What teams spend: rotor power by the paper's own figures, distance, energy and collisions."""

import pytest
import torch
from scipy.optimize import minimize_scalar

from coloc_env import make_scenario
from coloc_env.commands import Commands
from coloc_env.effort import Effort, rotor_power
from coloc_env.world import World


def power(speed: float) -> float:
    return float(rotor_power(torch.tensor(speed, dtype=torch.float64)))


def test_rotor_power_has_the_papers_best_speeds() -> None:
    """Zeng, Xu and Zhang 2019, section II: 10.2 m/s for the longest time, 18.3 m/s for range."""
    assert power(0.0) == pytest.approx(79.8563 + 88.6279)
    longest = minimize_scalar(power, bounds=(1, 40), method="bounded").x
    farthest = minimize_scalar(lambda v: power(v) / v, bounds=(1, 40), method="bounded").x
    assert longest == pytest.approx(10.2, abs=0.1)
    assert farthest == pytest.approx(18.3, abs=0.1)


def test_a_straight_way_and_two_that_meet_are_counted() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2, control="velocity", landmarks=0)
    world = World(scenario, 3)
    world.reset(1)
    effort, first = Effort(world, apart=3.0), world.truth.position.clone()
    near = torch.zeros(3, dtype=torch.int64)
    for _ in range(120):
        place = world.truth.position
        towards = (place.flip(1) - place).to(torch.float32)
        world.step(torch.zeros(3, 2, 9), Commands(towards / towards.norm(dim=-1, keepdim=True)))
        effort.count()
        p = world.truth.position
        near += (p[:, 0] - p[:, 1]).norm(dim=-1) < 3.0
    assert torch.equal(effort.collisions, near.unsqueeze(-1).expand(3, 2))
    assert near.sum() > 0
    straight = (world.truth.position - first).norm(dim=-1)
    assert (effort.distance >= straight - 1e-9).all()
    low, high = 12.0 * power(1.0), 12.0 * power(0.0)  # 12 s at up to 1 m/s: slower costs more
    assert ((effort.energy > low) & (effort.energy < high)).all()
