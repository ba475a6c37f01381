"""Learned factors: map without training, reachable gradients, equivariance, any team size."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.envs.transforms import InitTracker, TransformedEnv

from agents import make
from agents.localizer import Estimate
from agents.policies.adapters import LocalizerPolicy
from agents.stdcl.factors.features import LINKS, NODES
from agents.stdcl.factors.network import (
    MAX_LOG_NOISE,
    MAX_LOG_WEIGHT,
    MAX_MEMORY,
    MAX_SHIFT,
    FactorNetwork,
)
from agents.weights import untrained
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

NEW = "stdcl:weights=none"


def small(n_uavs: int = 14, **overrides: float) -> Scenario:
    size = (4000.0, 4000.0, 2000.0)
    return make_scenario("swarm-v0", n_uavs=n_uavs, size=size, comm_radius=2500.0, **overrides)


def randomized(seed: int = 0) -> FactorNetwork:
    """A network all of whose weights are random, the last layers' included."""
    network = untrained(FactorNetwork, seed).double()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in network.parameters():
            more = torch.randn(weight.shape, generator=generator, dtype=torch.float64)
            weight.add_(more, alpha=0.1)
    return network


def estimates(
    agent: str, scenario: Scenario, steps: int, network: FactorNetwork | None = None
) -> list[Estimate]:
    localizer: Any = make(agent, scenario)
    world = World(scenario, 2)
    if network is not None:
        localizer.learn(network)
    observation = world.reset(torch.arange(2))
    belief = localizer.reset(observation)
    found: list[Estimate] = []
    with torch.no_grad():
        for _ in range(steps):
            belief, estimate = localizer.step(belief, observation)
            found.append(estimate)
            world.advance(estimate.action())
            observation = world.observation()
    return found


SWARM = small(nlos=0.3, nlos_time=10.0)
CAMPUS = make_scenario("campus-v0", flight="s2", horizon=10)
ANCHORS = make_scenario("indoor-v0", n_uavs=3, landmarks=0, anchors=8, horizon=10)


@pytest.mark.parametrize(
    ("agent", "scenario"),
    [(NEW, SWARM), (f"{NEW}:bank=true", SWARM), (NEW, CAMPUS), (NEW, ANCHORS)],
    ids=["alone", "bank", "campus", "anchors"],
)
def test_without_training_it_is_map(agent: str, scenario: Scenario) -> None:
    for ours, theirs in zip(
        estimates(agent, scenario, 4), estimates("map", scenario, 4), strict=True
    ):
        torch.testing.assert_close(ours.position, theirs.position, atol=1e-10, rtol=0)
        torch.testing.assert_close(ours.covariance, theirs.covariance, atol=1e-10, rtol=0)


def test_five_lines_add_a_loss_and_take_a_gradient_step() -> None:
    env = TransformedEnv(CoLocEnv(small(), 2, seed=0), InitTracker())
    actor = LocalizerPolicy(make(NEW, env.scenario), env.scenario, gradients=True)
    optimizer = torch.optim.SGD(actor.parameters(), 1e-6)
    loss = actor(env.reset())["uav", "action"][..., :3].square().mean()
    loss.backward()
    optimizer.step()

    assert sum(p.numel() for p in actor.parameters()) == sum(
        p.numel() for p in untrained(FactorNetwork, 0).parameters()
    )
    grown = dict(actor.named_parameters())["network.link_out.weight"]
    assert float(grown.abs().max()) > 0
    without = LocalizerPolicy(make("map", env.scenario), env.scenario)
    assert not list(without.parameters())


def test_gradients_are_those_of_finite_differences() -> None:
    """Of a loss of the second step, through the belief between. The network is blind, since what it
    sees is held: no gradient goes through features."""
    scenario = small(8, nlos=0.3)
    world, network = World(scenario, 1), randomized()
    localizer: Any = make(NEW, scenario)
    localizer.learn(network)
    with torch.no_grad():
        for blind in (network.encode_link.weight, network.encode_node.weight, network.relative):
            blind.zero_()
        observations = [world.reset(torch.arange(1))]
        _, estimate = localizer.step(localizer.reset(observations[0]), observations[0])
        world.advance(estimate.action())
        observations.append(world.observation())

    def loss() -> Tensor:
        belief = localizer.reset(observations[0])
        for observation in observations:
            belief, estimate = localizer.step(belief, observation)
        return (estimate.position / 1000).square().sum() + estimate.covariance.sum() / 1000

    loss().backward()
    eps = 1e-5
    for bias in (network.link_out.bias, network.node_out.bias):
        for k in range(len(bias)):
            each = []
            with torch.no_grad():
                for step in (eps, -2 * eps):
                    bias[k] += step
                    each.append(float(loss()))
                bias[k] += eps
            difference = (each[0] - each[1]) / (2 * eps)
            assert bias.grad is not None
            assert float(bias.grad[k]) == pytest.approx(difference, rel=1e-3, abs=1e-6)
            assert abs(difference) > 1e-6


def test_a_permuted_team_has_permuted_factors() -> None:
    network, n = randomized().requires_grad_(False), 9
    generator = torch.Generator().manual_seed(2)
    link = torch.randn(1, n, n, len(LINKS), generator=generator, dtype=torch.float64)
    link = link + link.transpose(1, 2)
    mask = torch.rand(1, n, n, generator=generator) < 0.5
    mask = mask | mask.mT
    node = torch.randn(1, n, len(NODES), generator=generator, dtype=torch.float64)
    past = torch.randn(1, n, network.steps, network.width, generator=generator).double()
    order = torch.randperm(n, generator=generator)
    one = network(link, node, mask, past)
    link, mask = link[:, order][:, :, order], mask[:, order][:, :, order]
    other = network(link, node[:, order], mask, past[:, order])
    for a, b in zip(one[:3], other[:3], strict=True):
        torch.testing.assert_close(a[:, order][:, :, order], b)
        torch.testing.assert_close(a, a.mT)
        assert not a[:, ~(mask[0][order.argsort()][:, order.argsort()])].any()
    for a, b in zip(one[3:], other[3:], strict=True):
        torch.testing.assert_close(a[:, order], b)
    for part, limit in zip(
        one[:4], (MAX_LOG_WEIGHT, MAX_SHIFT, MAX_MEMORY, MAX_LOG_NOISE), strict=True
    ):
        assert float(part.abs().max()) <= limit


def test_one_network_serves_teams_of_all_sizes() -> None:
    for n_uavs in (8, 25):
        found = estimates(NEW, small(n_uavs), 3, randomized())
        assert all(one.position.isfinite().all() for one in found)


def test_convolutions_look_at_the_past_alone() -> None:
    """Each of the last steps counts, none before them."""
    network, n = randomized().requires_grad_(False), 5
    link = torch.zeros(1, n, n, len(LINKS), dtype=torch.float64)
    node = torch.zeros(1, n, len(NODES), dtype=torch.float64)
    mask = torch.zeros(1, n, n, dtype=torch.bool)

    def noise_after(impulse: int, steps: int) -> Tensor:
        past = network.start(torch.Size((1, n)))
        for k in range(steps):
            out = network(link, node + (k == impulse), mask, past)
            past = out[-1]
        return out[3]

    calm = noise_after(-1, 12)
    for age in range(12):
        moved = not torch.equal(noise_after(11 - age, 12), calm)
        assert moved == (age <= network.steps)


def test_among_anchors_the_network_has_a_say() -> None:
    """It remembers links between UAVs and anchors at both ends, and bears a range."""
    localizer: Any = make(NEW, ANCHORS)
    localizer.swarm.learn(randomized())
    world = World(ANCHORS, 2)
    observation = world.reset(0)
    belief = localizer.reset(observation)
    for _ in range(3):
        belief, _ = localizer.step(belief, observation)
        world.advance(localizer.step(belief, observation)[1].action())
        observation = world.observation()
    means = belief.swarm.memory.means.seen
    assert means.shape == (2, 3, 11)
    assert bool((means[..., 3:] > 0).any())
    whole = localizer.swarm.of_members(belief.swarm, 8).memory.means.seen
    torch.testing.assert_close(whole, whole.mT)


@pytest.mark.parametrize("variant", ["calibrated", "paper"])
def test_the_loops_serve_teams_whose_motion_an_ins_drives(variant: str) -> None:
    with pytest.raises(ValueError, match="whose motion an INS drives"):
        make(f"stdcl:variant={variant}:weights=none", ANCHORS)
    with pytest.raises(ValueError, match="bank=true is for teams whose motion an INS drives"):
        make(f"{NEW}:bank=true", ANCHORS)
