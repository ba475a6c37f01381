"""The sliding window of ``dwmds_st``: its stress, its steps, and what it is without old ranges."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from agents import make
from agents.localizer import Estimate
from agents.swarm import joint, window
from agents.swarm.belief import SwarmBelief
from agents.swarm.links import lengths, links_of
from agents.swarm.majorization import pull, stress
from agents.swarm.window import History
from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

SMALL: dict[str, Any] = {"n_uavs": 14, "anchor_share": 0.3, "ins_bias": 0.0, "horizon": 20}
GUIDES, STD, INS, PRIOR, FIX = 4, 10.0, 0.5, 50.0, 0.1  # UAVs; the rest in m and m/s
PLAIN = "dwmds_st:confidence=none"


def normal(*shape: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def flown(
    agent: str, steps: int, **overrides: Any
) -> tuple[list[Observation], list[SwarmBelief], list[Estimate]]:
    """What a team was given, believed afterwards and said, step by step."""
    scenario = make_scenario("swarm-v0", **SMALL | overrides)
    localizer, world = make(agent, scenario), World(scenario, 1)
    observation = world.reset(5)
    belief = localizer.reset(observation)
    seen, beliefs, said = [], [], []
    for _ in range(steps):
        belief, estimate = localizer.step(belief, observation)
        seen.append(observation)
        beliefs.append(belief)
        said.append(estimate)
        world.advance(estimate.action())
        observation = world.observation()
    return seen, beliefs, said


def remembered(worlds: int = 2, n: int = 12, steps: int = 3) -> tuple[Tensor, History]:
    """Places now, and a window of made-up links around them."""
    place = 300 * normal(worlds, n, 3, seed=0)
    past = window.begun(place, joint.independent(torch.ones(worlds, n).double(), 1), steps)
    for k in range(steps):
        upper = torch.triu(normal(worlds, n, n, seed=10 + k), 1)
        noise = upper + upper.mT
        distance = lengths(place) + STD * noise
        weight = (noise.abs() > 0.5) * noise.abs() / STD**2
        past = window.pushed(past, place, past.joint[:, :, :1], distance, weight, weight)
        moved = 20 * normal(worlds, n, 3, seed=20 + k)
        ones = torch.ones(worlds, n, dtype=torch.float64)
        past = window.carried(past, moved, ones, 0.3 * ones, 0.9 * ones[:, :1])
        place = place + moved + normal(worlds, n, 3, seed=30 + k)
    return place, past


def test_the_pull_is_the_stress_gradient() -> None:
    y, past = remembered()
    y = y.requires_grad_(True)
    (gradient,) = torch.autograd.grad(window.stress(y, past).sum(), y)
    torch.testing.assert_close(window.pull(y.detach(), past), -0.5 * gradient)


@pytest.mark.parametrize("relaxed", [1.0, 1.8])
def test_guttman_steps_never_raise_the_stress(relaxed: float) -> None:
    place, past = remembered()
    fixed = torch.zeros(place.shape[:2], dtype=torch.bool)
    fixed[:, :GUIDES] = True
    distance, weight = past.distance[:, :, 0] + 3.0, past.weight[:, :, 0]
    everybody = torch.arange(place.shape[1])
    total = weight + past.weight.sum(2)
    factor = torch.linalg.cholesky(joint.held(joint.laplacian(total, everybody), fixed))
    nothing = torch.zeros_like(place[..., 0])

    def whole(y: Tensor) -> Tensor:
        return stress(y, distance, weight, place, nothing) + window.stress(y, past)

    y = place + 200 * normal(*place.shape, seed=1).masked_fill(fixed.unsqueeze(-1), 0.0)
    before = whole(y)
    begin = before
    for _ in range(60):
        down = pull(y, distance, weight) + window.pull(y, past)
        down = down.masked_fill(fixed.unsqueeze(-1), 0.0)
        y = y + relaxed * torch.cholesky_solve(down, factor)
        after = whole(y)
        assert (after <= before * (1 + 1e-12)).all()
        before = after
    assert (before < 0.2 * begin).all()


def test_a_window_ends_where_scipy_finds_the_least_stress() -> None:
    """Equation 19 written anew from observations: while the window reaches back to the first step,
    the prior is the team's first, carried on by the INS."""
    decay, last = 0.2, 3
    agent = f"{PLAIN}:window=8:decay={decay}:iterations=1000:first=1000"
    seen, _, said = flown(agent, last + 1)
    fixes = [o["position_fix"][0].double().numpy() for o in seen]
    anchor = (seen[0]["position_fix_mask"][0, :, 0] > 0).numpy()
    velocity = [o["ins"][0].double().numpy() for o in seen]
    moved = [np.zeros_like(fixes[0])]  # since each step, the last first
    for k in range(last, 0, -1):
        own = np.where(anchor[:, None], fixes[k] - fixes[k - 1], velocity[k])
        moved.append(moved[-1] + own)
    links = [links_of(o) for o in reversed(seen)]
    start = seen[0]["prior"][0, :, :3].double().numpy()
    prior = (start + moved[-1])[~anchor]
    trust = 1 / (PRIOR**2 + last * INS**2)

    def cost(flat: np.ndarray) -> tuple[float, np.ndarray]:
        y = fixes[last].copy()
        y[~anchor] = flat.reshape(-1, 3)
        off = y[~anchor] - prior
        value, gradient = trust * (off**2).sum(), np.zeros_like(y)
        gradient[~anchor] = 2 * trust * off
        for age, (link, since) in enumerate(zip(links, moved, strict=True)):
            apart = (y - since)[:, None] - (y - since)
            length = np.linalg.norm(apart, axis=-1) + np.eye(len(y))
            error = link.mask[0].numpy() * (link.distance[0].numpy() - length)
            weight = np.exp(-decay * age) / STD**2
            value += 0.5 * weight * (error**2).sum()
            gradient -= 2 * weight * ((error / length)[..., None] * apart).sum(1)
        return float(value), gradient[~anchor].ravel()

    found = said[last].position[0].double().numpy()[~anchor]
    best = minimize(cost, prior.ravel(), jac=True, method="BFGS", options={"gtol": 1e-7})
    np.testing.assert_allclose(found, best.x.reshape(-1, 3), atol=2e-2)
    assert cost(found.ravel())[0] == pytest.approx(best.fun, rel=1e-7)


@pytest.mark.parametrize("steps", [1, 5])
def test_the_first_step_is_that_of_a_snapshot(steps: int) -> None:
    (_, _, (alone,)), (_, _, (windowed,)) = (
        flown(f"dwmds_st:window={t}", 1, ins_bias=0.3) for t in (0, steps)
    )
    torch.testing.assert_close(windowed.position, alone.position, rtol=0, atol=1e-9)
    torch.testing.assert_close(windowed.covariance, alone.covariance)


def test_a_window_that_fades_at_once_is_a_snapshot() -> None:
    *_, alone = flown(f"{PLAIN}:prior=false", 6)
    *_, windowed = flown(f"{PLAIN}:prior=false:window=2:decay=60", 6)
    for x, y in zip(alone, windowed, strict=True):
        torch.testing.assert_close(x.position, y.position, rtol=0, atol=1e-3)


@pytest.mark.parametrize("ins_bias", [0.0, 1.0])
def test_without_ranges_a_window_dead_reckons_as_the_filter_does(ins_bias: float) -> None:
    *_, alone = flown("dwmds_st", 8, link_failure=1.0, ins_bias=ins_bias)
    *_, windowed = flown("dwmds_st:window=3", 8, link_failure=1.0, ins_bias=ins_bias)
    for x, y in zip(alone, windowed, strict=True):
        torch.testing.assert_close(x.position, y.position)
        torch.testing.assert_close(x.covariance, y.covariance, rtol=1e-5, atol=0)


def test_what_was_known_before_the_window_is_carried_on_step_by_step() -> None:
    n, steps = 6, 3
    root = normal(1, n, n, seed=2)
    known = (root @ root.mT).unsqueeze(2)
    fixed = torch.zeros(1, n, dtype=torch.bool)
    past, expected = window.begun(normal(1, n, 3, seed=3), known, steps), known
    for k in range(steps):
        kept, added = 1 + 0.1 * normal(1, n, seed=4 + k), normal(1, n, seed=8 + k).square()
        expected = joint.carried(expected, kept, added, fixed, 0.0)
        past = window.carried(past, normal(1, n, 3, seed=k), kept, added, torch.ones(1, 1).double())
    torch.testing.assert_close(window.before(past)[1], expected)


def test_a_window_holds_its_last_steps() -> None:
    seen, beliefs, _ = flown(f"{PLAIN}:window=2:decay=0.1", 5)
    past = beliefs[-1].past
    assert past.weight.shape == (1, 14, 2, 14)
    for age in (0, 1):
        links = links_of(seen[-1 - age])
        assert torch.equal(past.distance[:, :, age] * links.mask, links.distance)
        expected = links.mask.double() * np.exp(-0.1 * age) / STD**2
        torch.testing.assert_close(past.weight[:, :, age], expected)
    assert flown("dwmds_st", 1)[1][0].past.weight.shape == (1, 14, 0, 14)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("window=-1", "window=-1 is not allowed: a number of steps ≥ 0"),
        ("decay=-0.1", "decay=-0.1 is not allowed: a rate in 1/s ≥ 0"),
    ],
)
def test_wrong_windows(option: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(f"dwmds_st:{option}", make_scenario("swarm-v0"))
