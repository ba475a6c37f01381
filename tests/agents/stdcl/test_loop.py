"""The loop between optimizer and network: equation 36, what a correction keeps, and variants."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from agents import make
from agents.stdcl.feedback import FEEDBACKS
from agents.stdcl.loop import LoopBelief, _corrected
from agents.stdcl.network import Correction
from agents.swarm import delays, window
from agents.swarm.belief import Solution
from agents.swarm.joint import independent
from agents.swarm.links import Links, lengths
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from tests.agents.stdcl.test_network import STD, N, step_of


def no_correction() -> Correction:
    return Correction(torch.zeros(2, N, 3), torch.ones(2, N), None)


# ---------------------------------------------------------------- equation 36


@given(st.floats(0.001, 0.2), st.integers(2, 40))
@settings(max_examples=20, deadline=None)
def test_equation_36_accumulates(kappa: float, steps: int) -> None:
    """c after n steps with the residual r is exp(−n κ |r|/σ), each step's factor at least 0.9, and
    the whole at least 0.1."""
    inputs, found, _, _ = step_of(3)
    residual = torch.linspace(-60.0, 60.0, N * N).double().view(1, N, N).expand(2, -1, -1)
    residual = torch.triu(residual, 1) + torch.triu(residual, 1).mT
    mask = ~torch.eye(N, dtype=torch.bool).expand(2, -1, -1)
    inputs = replace(inputs, links=Links((lengths(found.position) + residual) * mask, mask))
    feedback = FEEDBACKS["paper"](kappa)
    c = torch.ones(2, N, N, dtype=torch.float64)
    for _ in range(steps):
        c = feedback.confidence(c, inputs, found, no_correction(), STD)
    expected = (-kappa * residual.abs() / STD).exp().clamp_min(0.9) ** steps
    assert torch.allclose(c[mask], expected.clamp_min(0.1)[mask], rtol=1e-9)
    assert (c[~mask] == 1).all()


def test_a_link_without_a_range_keeps_its_confidence() -> None:
    inputs, found, _, _ = step_of(5)
    before = torch.full((2, N, N), 0.7, dtype=torch.float64)
    after = FEEDBACKS["paper"](0.1).confidence(before, inputs, found, no_correction(), STD)
    assert (after[~inputs.links.mask] == 0.7).all()
    assert (after[inputs.links.mask] < 0.7).any()


# ---------------------------------------------------------------- corrections


def test_a_correction_keeps_delays_and_the_window() -> None:
    inputs, found, _, _ = step_of(6)
    covariance = independent(found.variance, 1)
    past = window.push(
        window.empty(found.position, covariance, 3),
        found.position,
        covariance,
        inputs.links.distance,
        inputs.links.mask.double(),
        inputs.links.mask.double(),
    )
    late = delays.initial(found.position, None)
    whole = Solution(found.position, found.variance, covariance, past, late)
    corrected = _corrected(inputs, whole, no_correction(), 1.0)
    assert corrected.delays is late
    assert corrected.window is past
    assert torch.equal(corrected.position, found.position)


# ---------------------------------------------------------------- variants


def beliefs(agent: str, steps: int = 6, **overrides: Any) -> tuple[Any, list[LoopBelief], Tensor]:
    """A loop, its beliefs and its last positions in a small swarm."""
    few = {"n_uavs": 14, "anchor_share": 0.3, "nlos": 0.4, "horizon": 20, "comm_radius": 9000.0}
    scenario = make_scenario("swarm-v0", **few | overrides)
    localizer: Any = make(agent, scenario)
    world = World(scenario, 1)
    observation = world.reset(3)
    each, position = [localizer.reset(observation)], torch.zeros(0)
    for _ in range(steps):
        belief, estimate = localizer.step(each[-1], observation)
        each.append(belief)
        position = estimate.position
        world.advance(estimate.action())
        observation = world.observation()
    return localizer, each, position


def test_the_papers_loop_lowers_confidences_step_by_step() -> None:
    _, each, _ = beliefs("stdcl:variant=paper:weights=none")
    for one, other in pairwise(each):
        assert (other.confidence <= one.confidence).all()
        assert (other.confidence >= 0.9 * one.confidence - 1e-12).all()
    assert float(each[-1].confidence.min()) < 0.8


def test_a_variant_is_a_choice_of_parts() -> None:
    """The calibrated loop is the paper's with other parts, and each part can be named."""
    _, _, one = beliefs("stdcl:variant=calibrated")
    _, _, same = beliefs(
        "stdcl:variant=paper:weights=stdcl_calibrated:feedback=learned:confidence=em"
    )
    _, _, other = beliefs("stdcl:variant=paper:weights=none")
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("variant=papers", "did you mean|paper"),
        ("kappa=-1", "kappa=.-1"),
        ("kappa=x", "kappa"),
        ("kappa=0.2:window=3", "kappa, window: for variant=calibrated or paper alone"),
        ("weights=stdcl_paper", "weights of kind 'stgnn'"),
    ],
)
def test_one_clear_line(options: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        make(f"stdcl:{options}", make_scenario("swarm-v0", n_uavs=10))
    assert "\n" not in str(error.value)
