"""Banks: each branch is the filter that it is said to be, and who speaks follows the evidence."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import make
from agents.bank import Bank, learned_branch
from agents.bank.evidence import accumulated, predictive_score
from agents.kalman.filter import predict
from agents.models.measurements import received
from agents.robust import Capped
from agents.robust.huber import huber_weights
from agents.trust import TrustNetwork
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario

HARD: dict[str, Any] = {"nlos": 0.3, "false_matches": 0.1}


def constant(logit: float) -> TrustNetwork:
    """Networks that give all the same weight."""
    network = TrustNetwork(relative=True).requires_grad_(False)
    network.vectors[-1].bias[0] = logit
    network.ranges[-1].bias[0] = logit
    network.ranges[-1].bias[1] = -40.0
    return network


def bank(scenario: Scenario, network: TrustNetwork, options: str = "") -> Bank:
    made = make(f"ekf_trust:weights=none{options}", scenario)
    assert isinstance(made, Bank)
    made.learn(network)
    return made


def series(run: Any, name: str) -> Tensor:
    """[K, B, N]"""
    return torch.stack([getattr(belief, name) for belief in run.beliefs[1:]])


@pytest.mark.parametrize("name", ["ekf_trust", "pf_trust"])
def test_the_fallback_is_the_filter_with_hubers_weights(name: str, tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=3, **HARD)
    few = ":particles=40:bounds=30,60" if name == "pf_trust" else ""
    run = tools.play(make(name + few, scenario), scenario, [0, 1], 12)
    expected = tools.replay(make("ekf:robust=huber", scenario), run.observations)
    for ours, theirs in zip(run.beliefs, expected.beliefs, strict=True):
        ours, theirs = ours.fallback.clone(), theirs.clone()
        ours.memory = theirs.memory = ours.memory[..., :0]
        tools.assert_same(ours, theirs, 1e-9)


def test_the_candidate_is_the_capped_filter(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=3, **HARD)
    run = tools.play(make("ekf_trust", scenario), scenario, [0, 1], 12)
    alone: Any = make("ekf_trust:bank=false:weights=trust_bank:iterations=2", scenario)
    alone.screen = Capped(alone.screen)
    expected = tools.replay(alone, run.observations)
    assert not series(run, "restarted").any()
    for ours, theirs in zip(run.beliefs, expected.beliefs, strict=True):
        ours = learned_branch(ours)
        torch.testing.assert_close(ours.memory.float(), theirs.memory, rtol=0, atol=1e-5)
        torch.testing.assert_close(ours.state, theirs.state, rtol=0, atol=1e-5)
        torch.testing.assert_close(ours.covariance, theirs.covariance, rtol=0, atol=1e-6)


def test_capped_weights_are_the_least_of_both(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=3, **HARD)
    alone: Any = make("ekf_trust:bank=false", scenario)
    capped, seen = Capped(alone.screen), []

    def watch(blocks: Any, evidence: Any, last: bool) -> Any:
        trusts = capped.weigh(blocks, evidence, last)
        if last:
            seen.append((blocks, alone.screen.weigh(blocks, evidence, last), trusts))
        return trusts

    plain: Any = make("ekf_trust:bank=false", scenario)
    plain.screen = SimpleNamespace(**{k: getattr(capped, k) for k in dir(capped) if k[0] != "_"})
    plain.screen.weigh = watch
    tools.play(plain, scenario, [0, 1], 12)
    huber_less = network_less = False
    for blocks, network, found in seen:
        for block, theirs, ours in zip(blocks, network, found, strict=True):
            huber = huber_weights(block)
            assert torch.equal(ours.weight, torch.minimum(huber, theirs.weight))
            huber_less |= bool((huber < theirs.weight)[block.mask].any())
            network_less |= bool((huber > theirs.weight)[block.mask].any())
    assert huber_less
    assert network_less


def test_evidence_is_that_of_both_predictions(tools: SimpleNamespace) -> None:
    """Computed again from the beliefs, each branch by itself."""
    scenario = make_scenario("indoor-v0", n_uavs=3, **HARD)
    localizer = make("ekf_trust", scenario)
    run = tools.play(localizer, scenario, [0, 1], 15)
    assert isinstance(localizer, Bank)
    process, models = localizer.process, localizer.models
    expected = torch.zeros(2, 3, dtype=torch.float64)
    for before, after, seen in zip(run.beliefs, run.beliefs[1:], run.observations, strict=False):
        scores = []
        for branch in (before.candidate, before.fallback):
            x, covariance, _ = predict(process, branch, seen)
            near = received(scenario.believed, seen)
            blocks = [model.linearize(process, x, seen, near) for model in models]
            scores.append(predictive_score(blocks, covariance, 4.0))
        expected = accumulated(expected, *scores, 0.995)
        torch.testing.assert_close(after.evidence, expected, rtol=0, atol=1e-4)
    assert expected.abs().min() > 1e-3


def test_full_trust_is_hubers_filter_and_speaks(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=3, **HARD)
    run = tools.play(bank(scenario, constant(40.0)), scenario, [0, 1], 12)
    for belief in run.beliefs:
        torch.testing.assert_close(belief.candidate.state, belief.fallback.state, rtol=0, atol=1e-9)
    assert series(run, "evidence").abs().max() < 1e-6


def test_no_trust_never_speaks_for_long_and_restarts(tools: SimpleNamespace) -> None:
    """Dead reckoning predicts worse and worse; at A < θ it is Huber's belief again, and A = 0."""
    scenario = make_scenario("indoor-v0", n_uavs=3)
    localizer = bank(scenario, constant(-200.0))
    run = tools.play(localizer, scenario, [0, 1], 40)
    restarted, evidence = series(run, "restarted"), series(run, "evidence")
    assert (restarted.sum(0) > 0).all()
    assert (evidence[restarted] == 0).all()
    assert (evidence >= localizer.options.restart).all()
    for k, belief in enumerate(run.beliefs[1:]):
        rows = restarted[k]
        assert torch.equal(belief.candidate.state[rows], belief.fallback.state[rows])
        assert torch.equal(belief.candidate.covariance[rows], belief.fallback.covariance[rows])
    huber = tools.replay(make("ekf:robust=huber", scenario), run.observations)
    speaks = (evidence >= 0) & ~restarted
    assert speaks[10:].double().mean() < 0.3  # measured: 0.19, after restarts
    silent = evidence < 0
    torch.testing.assert_close(run.position[silent], huber.position[silent], rtol=0, atol=1e-9)


def test_who_speaks_is_what_is_said_and_counted(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=3, landmarks=5, **HARD)
    localizer: Any = make("ekf_trust", scenario)
    run = tools.play(localizer, scenario, [0, 1], 40)
    shares = []
    for belief, estimate in zip(run.beliefs[1:], run.estimates, strict=True):
        speaks = (belief.evidence >= 0) & ~belief.restarted
        d = scenario.arena.dim
        for rows, branch in ((speaks, belief.candidate), (~speaks, belief.fallback)):
            assert torch.equal(estimate.position[rows], branch.state[rows][..., :d])
        figures = localizer.diagnostics(belief)
        assert torch.equal(figures["trust_share"] + figures["huber_share"], torch.ones(2, 3))
        assert torch.equal(figures["restarts_per_run"], belief.restarted.float())
        shares.append(figures["trust_share"])
    assert 0 < torch.stack(shares).mean() < 1


@pytest.mark.parametrize("name", ["ekf_trust", "pf_trust:particles=40:bounds=30,60"])
def test_a_row_of_a_batch_is_its_own_run(name: str, tools: SimpleNamespace) -> None:
    """Also where only other rows restart."""
    scenario = make_scenario("indoor-v0", n_uavs=3, landmarks=5, **HARD)
    localizer = make(f"{name}:restart=-1", scenario)
    many = tools.play(localizer, scenario, range(4), 25)
    assert 0 < series(many, "restarted").double().mean() < 1
    for seed in (0, 3):
        alone = tools.play(localizer, scenario, [seed], 25)
        for one, whole in zip(alone.estimates, many.estimates, strict=True):
            tools.assert_same(one, whole[seed : seed + 1])


def test_it_can_be_corrected_from_outside(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=3)
    localizer = make("ekf_trust", scenario)
    belief = tools.play(localizer, scenario, [0, 1], 5).beliefs[-1]
    offset = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64).expand(2, 3, 3)
    apart = localizer.mean(localizer.shifted(belief, offset)) - localizer.mean(belief)
    torch.testing.assert_close(apart[..., :3], offset)


def test_without_a_bank_it_is_the_network_alone() -> None:
    scenario = make_scenario("indoor-v0")
    assert not isinstance(make("ekf_trust:bank=false", scenario), Bank)
    assert not isinstance(make("pf_trust:bank=false", scenario), Bank)
