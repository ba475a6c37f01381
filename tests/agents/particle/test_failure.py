"""What tells that a filter has failed: the evidence, the χ² test, and the network."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.stats import chi2
from torch import Tensor

from agents import make
from agents.models.measurements import AnchorRanges
from agents.models.process import make_process
from agents.particle.failure import (
    ChiSquare,
    Evidence,
    FailureDetector,
    NeuralDetector,
    ResidualSum,
    evidence,
    network_features,
)
from agents.weights import learned, load, untrained, write
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import AnchorRanging
from coloc_env.world import World

some = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def sensed(scenario: Scenario, worlds: int = 3) -> tuple[Tensor, Observation]:
    """Truth (position, velocity and attitude [B, N, S]) a few steps on, and what is seen of it."""
    world = World(scenario, worlds)
    seen = world.reset(4)
    for _ in range(3):
        world.advance(torch.zeros(worlds, scenario.arena.n_uavs, 3 * scenario.arena.dim))
        seen = world.observation()
    truth = world.truth
    return torch.cat((truth.position, truth.velocity, truth.attitude), -1), seen


def looked_at(scenario: Scenario, state: Tensor, observation: Observation) -> Evidence:
    sensor = scenario.believed.sensor(AnchorRanging)
    assert sensor is not None
    return evidence(AnchorRanges(sensor), make_process(scenario.believed), state, observation)


def drawn(count: int, anchors: int, seed: int = 0) -> Evidence:
    """Evidence [count, 2] of which a third is missing; of the first UAV everything."""
    g = torch.Generator().manual_seed(seed)
    there = (torch.rand(count, 2, anchors, generator=g) < 0.67).float()
    there[0, 0] = 0.0
    residuals = torch.randn(count, 2, anchors, generator=g).abs() * there
    return Evidence((25 * residuals**2).sum(-1), residuals, there.sum(-1))


# ---------------------------------------------------------------- evidence


@some
@given(
    anchors=st.integers(1, 8),
    dropout=st.sampled_from([0.0, 0.3, 1.0]),
    std=st.floats(0.02, 2),
    off=st.floats(0, 3),
)
def test_evidence_is_what_numpy_computes(
    anchors: int, dropout: float, std: float, off: float
) -> None:
    """d = Σ r² / σ² with the σ that the team believes, over the ranges that arrived."""
    scenario = make_scenario(
        "wsn-v0", anchors=anchors, n_uavs=2, uwb_dropout=dropout, believed_uwb_std=std
    )
    truth, seen = sensed(scenario)
    position = (truth[..., :2] + off).float()
    found = looked_at(scenario, position, seen)
    places = seen["anchor_map"].double().numpy().reshape(3, 2, anchors, 2)
    expected = np.linalg.norm(position.double().numpy()[:, :, None] - places, axis=-1)
    there = seen["anchor_range_mask"].numpy() > 0
    r = np.where(there, seen["anchor_ranges"].double().numpy() - expected, 0.0)
    np.testing.assert_allclose(found.residuals, np.abs(r), atol=1e-5)
    np.testing.assert_allclose(found.distance, (r**2 / std**2).sum(-1), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(found.count, there.sum(-1))


def test_values_behind_the_mask_are_no_evidence() -> None:
    scenario = make_scenario("wsn-v0", n_uavs=2, uwb_dropout=0.5)
    truth, seen = sensed(scenario)
    mask = seen["anchor_range_mask"]
    assert 0 < mask.mean() < 1
    filled = torch.where(mask > 0, seen["anchor_ranges"], 1e6)
    plain, other = (
        looked_at(scenario, truth[..., :2], Observation({**seen.leaves, "anchor_ranges": ranges}))
        for ranges in (seen["anchor_ranges"], filled)
    )
    for name in ("distance", "residuals", "count"):
        assert torch.equal(getattr(plain, name), getattr(other, name))


def test_lever_arms_are_known(tools: SimpleNamespace) -> None:
    """At the truth, with attitude, what is left is noise; with another attitude it is more."""
    scenario = tools.families["tags"]()
    truth, seen = sensed(scenario, 10)
    right = looked_at(scenario, truth, seen)
    turned = truth.clone()
    turned[..., 6:10] = truth[..., [7, 6, 9, 8]]
    assert right.count.unique().tolist() == [8.0]
    assert float(right.distance.mean()) == pytest.approx(8, abs=5 * (16 / 30) ** 0.5)
    assert looked_at(scenario, turned, seen).distance.mean() > right.distance.mean() + 1


# ---------------------------------------------------------------- the χ² test


@pytest.mark.parametrize("quantile", [0.5, 0.95, 0.98, 0.9999])
def test_failure_is_a_distance_beyond_the_quantile_of_chi_square(quantile: float) -> None:
    """With as many degrees of freedom as there are ranges; without any there is no failure."""
    test = ChiSquare(quantile, 8)
    for count in range(1, 9):
        limit = chi2.ppf(quantile, count)
        distance = torch.tensor([[0.0, limit * (1 - 1e-5), limit * (1 + 1e-5), 1e6]])
        seen = Evidence(distance, torch.zeros(1, 4, 8), torch.full((1, 4), float(count)))
        assert test.probability(seen).tolist() == [[0.0, 0.0, 1.0, 1.0]]
    nothing = Evidence(torch.zeros(1, 1), torch.zeros(1, 1, 8), torch.zeros(1, 1))
    assert test.probability(nothing).tolist() == [[0.0]]


@pytest.mark.parametrize(("case", "low", "high"), [(1, 0.07, 0.13), (2, 0.9, 1.0), (3, 0.0, 0.001)])
def test_alarms_at_the_truth_are_as_frequent_as_promised(
    case: int, low: float, high: float
) -> None:
    """One in ten, if the team's belief of the ranges is right; otherwise too many or too few."""
    scenario = make_scenario("wsn-v0", case=case, uwb_dropout=0.2)
    truth, seen = sensed(scenario, 3000)
    found = ChiSquare(0.9, 4).probability(looked_at(scenario, truth[..., :2], seen))
    assert low <= found.mean() <= high


@pytest.mark.parametrize("count", [1, 3, 4])
def test_the_residuals_detector_is_a_limit_on_their_rms(count: int) -> None:
    """Whatever d says, and however many ranges there are."""
    residuals = torch.zeros(2, 1, 4)
    residuals[0, :, :count], residuals[1, :, :count] = 0.49, 0.51
    seen = Evidence(torch.full((2, 1), 1e9), residuals, torch.full((2, 1), float(count)))
    assert ResidualSum(0.5).probability(seen)[:, 0].tolist() == [0.0, 1.0]
    none = Evidence(*(torch.zeros(1, 1, *shape) for shape in ((), (4,), ())))
    assert ResidualSum(0.5).probability(none).tolist() == [[0.0]]


@pytest.mark.parametrize("quantile", [0.0, 1.0, -0.1, 1.5])
def test_quantiles_are_probabilities(quantile: float) -> None:
    words = rf"quantile={quantile} is not allowed: a number > 0 and < 1"
    with pytest.raises(ValueError, match=words):
        make("hpff", make_scenario("wsn-v0"), quantile=quantile)


# ---------------------------------------------------------------- the network


@pytest.mark.parametrize("anchors", [1, 2, 4, 6, 8])
def test_the_network_sees_the_distance_and_the_four_largest_residuals(anchors: int) -> None:
    """In the anchors' own order where there are no more; d as if there were four ranges."""
    seen = drawn(50, anchors)
    features = network_features(seen)
    assert features.shape == (50, 2, 5)
    d, residuals, count = (x.numpy() for x in (seen.distance, seen.residuals, seen.count))
    share = 4 / np.maximum(count, 1)
    np.testing.assert_allclose(features[..., 0], np.log1p(d * share), rtol=1e-5)
    if anchors > 4:
        residuals = -np.sort(-residuals, -1)[..., :4]
    expected = np.zeros((50, 2, 4), np.float32)
    expected[..., : residuals.shape[-1]] = residuals
    np.testing.assert_array_equal(features[..., 1:], expected)
    assert FailureDetector.features == ("log1p_d", "r1", "r2", "r3", "r4")


def test_the_network_is_the_papers() -> None:
    """5–10–5–2 with tanh, as numpy computes it."""
    network = untrained(FailureDetector, 3)
    weights = {name: value.double().numpy() for name, value in network.state_dict().items()}
    shapes = [value.shape for name, value in weights.items() if name.endswith("weight")]
    assert shapes == [(10, 5), (5, 10), (2, 5)]
    features = network_features(drawn(20, 4))
    x = features.double().numpy()
    for layer in ("hidden.0", "hidden.1"):
        x = np.tanh(x @ weights[f"{layer}.weight"].T + weights[f"{layer}.bias"])
    x = x @ weights["out.weight"].T + weights["out.bias"]
    np.testing.assert_allclose(network(features).detach(), x, atol=1e-5)


@pytest.mark.parametrize("anchors", [2, 4, 6])
def test_the_probability_is_the_softmax_of_the_logits(anchors: int) -> None:
    """Of failure, the second; zero where nothing was measured."""
    network = untrained(FailureDetector, 5)
    seen = drawn(60, anchors)
    found = NeuralDetector(network).probability(seen)
    expected = network(network_features(seen)).softmax(-1)[..., 1]
    some = seen.count > 0
    assert (~some).any()
    torch.testing.assert_close(found[some], expected[some].detach())
    assert not found[~some].any()
    assert not found.requires_grad
    assert found[some].unique().numel() > 30


@pytest.mark.parametrize("anchors", [3, 4, 7])
@pytest.mark.parametrize("kind", ["network", "chi_square"])
def test_a_row_is_judged_as_if_it_were_alone(kind: str, anchors: int) -> None:
    """Bit for bit."""
    detector = {
        "network": NeuralDetector(untrained(FailureDetector, 0)),
        "chi_square": ChiSquare(0.9, anchors),
    }[kind]
    seen = drawn(70, anchors)
    whole = detector.probability(seen)
    for row in (0, 1, 33, 69):
        one = slice(row, row + 1)
        alone = Evidence(seen.distance[one], seen.residuals[one], seen.count[one])
        assert torch.equal(detector.probability(alone), whole[one])
        uav = Evidence(*(x[:, 1:] for x in (alone.distance, alone.residuals, alone.count)))
        assert torch.equal(detector.probability(uav), whole[one, 1:])


def test_weights_are_written_and_read(tmp_path: Path) -> None:
    network = untrained(FailureDetector, 8)
    write(tmp_path / "mine.safetensors", network, {"command": "none"})
    again = untrained(FailureDetector, 9)
    card = load(tmp_path / "mine.safetensors", again)
    assert (card["kind"], card["features"]) == ("nnhpff", list(FailureDetector.features))
    seen = drawn(20, 4)
    read = NeuralDetector(learned(FailureDetector, str(tmp_path / "mine.safetensors")))
    written = NeuralDetector(network).probability(seen)
    assert torch.equal(read.probability(seen), written)
    assert torch.equal(NeuralDetector(again).probability(seen), written)
