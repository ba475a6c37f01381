"""pf_corrected: untrained it is apf, soft resampling by its closed form, gradients by finite
differences, and features that mean the same for any number of measurements."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import make
from agents.errors import NotServed
from agents.particle.evidence_corrector import (
    FEATURES,
    LARGEST_SCALE,
    MOST,
    EvidenceCorrector,
    distances,
    summary,
)
from agents.particle.resampling import Resampling
from agents.particle.soft_resampling import SoftResampling
from coloc_env.scenarios import make_scenario

RANGES = {"landmarks": 0, "anchors": 4, "prior": "uniform"}
FEW: dict[str, Any] = {"particles": 40, "bounds": None, "weights": "none"}


class Line:
    """One coordinate."""

    error_size, noise_size = 1, 1

    def boxplus(self, x: Tensor, delta: Tensor) -> Tensor:
        return x + delta

    def boxminus(self, x: Tensor, y: Tensor) -> Tensor:
        return x - y


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def resampled(alpha: float | None, log_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Particles and log-weights that a cloud of two UAVs leaves; plain resampling for None."""
    m = log_weights.shape[-1]
    resampling = Resampling(Line(), [0.01], None)
    if alpha is not None:
        resampling = SoftResampling(resampling, alpha)
    count, key = torch.full((1, 2), m), torch.tensor([[3, 8]])
    particles = normal(1, 2, m, 1, seed=1)
    weighed = resampling.weigh(particles, log_weights, count)
    assert bool(resampling.few(weighed, count).all())
    return resampling.next_particles(particles, weighed, count, key)


# ---------------------------------------------------------------- soft resampling


def test_with_alpha_1_it_is_plain_resampling() -> None:
    log_weights = 4 * normal(1, 2, 30)
    for found, expected in zip(
        resampled(1.0, log_weights), resampled(None, log_weights), strict=True
    ):
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_ancestors_keep_w_over_q(alpha: float) -> None:
    """h = 0 and no noise leave particles where they were, which names their ancestors."""
    w = torch.softmax(4 * normal(1, 2, 30).double(), -1)
    resampling = SoftResampling(Resampling(Line(), [0.0], None, 0.0), alpha)
    particles = torch.arange(30.0).expand(1, 2, 30).unsqueeze(-1)
    count = torch.full((1, 2), 30)
    weighed = resampling.weigh(particles, w.log().float(), count)
    moved, kept = resampling.next_particles(particles, weighed, count, torch.tensor([[3, 8]]))
    ancestors = moved[..., 0].round().long()
    q = alpha * w + (1 - alpha) / 30
    expected = (w / q).gather(-1, ancestors)
    torch.testing.assert_close(
        kept.double().exp(), expected / expected.sum(-1, keepdim=True), rtol=1e-4, atol=1e-8
    )
    number = torch.zeros(1, 2, 30, dtype=torch.float64)
    number.scatter_add_(-1, ancestors, torch.ones_like(expected))
    assert ((number - 30 * q).abs() < 1 + 1e-6).all()  # systematic: 30 q, rounded either way


def test_gradients_pass_through_soft_resampling() -> None:
    """d log w′ / d log w against finite differences; through plain resampling nothing passes."""
    start, along = (4 * normal(1, 2, 12)), normal(1, 2, 12, seed=4)
    some = normal(1, 2, 12, seed=5)

    def value(x: Tensor, alpha: float) -> Tensor:
        return (some * resampled(alpha, x)[1]).sum()

    leaf = start.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf, 0.5), leaf)
    h = 1e-3
    expected = (value(start + h * along, 0.5) - value(start - h * along, 0.5)) / (2 * h)
    assert float((gradient * along).sum()) == pytest.approx(float(expected), rel=2e-2)
    (none,) = torch.autograd.grad(value(leaf, 1.0), leaf)
    assert none.abs().max() < 1e-4 < gradient.abs().max()


# ---------------------------------------------------------------- the filter


@pytest.mark.parametrize("overrides", [{}, RANGES])
def test_untrained_it_is_apf_bit_for_bit(overrides: dict, tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0", **overrides)
    own = tools.play(
        make("pf_corrected:weights=none", scenario, particles=100), scenario, [0, 1], 6
    )
    plain = tools.play(make("apf", scenario, particles=100), scenario, [0, 1], 6)
    tools.assert_same(own.beliefs[-1], plain.beliefs[-1])
    tools.assert_same(own.estimates[-1], plain.estimates[-1])


def drawn(seed: int, scale: float) -> EvidenceCorrector:
    network = EvidenceCorrector()
    with torch.no_grad():
        for i, parameter in enumerate(network.parameters()):
            parameter.copy_(scale * normal(*parameter.shape, seed=seed + i))
    return network


def test_gradients_of_a_step_are_those_of_finite_differences(tools: SimpleNamespace) -> None:
    """Of the mean and of the covariance that a step gives, in each network's last layer."""
    scenario = make_scenario("indoor-v0", n_uavs=3, **RANGES)
    localizer: Any = make("pf_corrected", scenario, soft=0.5, **FEW)
    network = drawn(7, 0.2)
    localizer.learn(network)
    with torch.no_grad():
        run = tools.play(localizer, scenario, [0], 5)

    def value() -> Tensor:
        estimate = localizer.step(run.beliefs[4], run.observations[4])[1]
        return (
            estimate.position.double().sum() + estimate.covariance.diagonal(dim1=-2, dim2=-1).sum()
        )

    for part in (network.particle, network.cloud):
        (bias,) = (b for name, b in part.named_parameters() if name == "2.bias")
        (gradient,) = torch.autograd.grad(value(), bias)
        along, h = normal(*bias.shape, seed=2), 3e-2
        with torch.no_grad():
            bias.add_(h * along)
            above = value()
            bias.sub_(2 * h * along)
            expected = (above - value()) / (2 * h)
            bias.add_(h * along)
        found = float((gradient * along).sum())
        assert abs(found) > 1e-3
        assert found == pytest.approx(float(expected), rel=1e-2)


def test_a_later_step_feels_an_earlier_correction_through_weights_alone(
    tools: SimpleNamespace,
) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2, **RANGES)
    localizer: Any = make("pf_corrected", scenario, soft=0.5, **FEW)
    localizer.learn(drawn(7, 0.2))
    run = tools.play(localizer, scenario, [0], 4)
    assert run.beliefs[-1].log_weights.requires_grad
    assert not run.beliefs[-1].particles.requires_grad


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_corrections_are_bounded(scale: float) -> None:
    features = 10 * normal(2, 3, 50, len(FEATURES))
    with torch.no_grad():
        correction, factor = drawn(0, scale)(features, features.mean(-2))
    assert correction.shape == (2, 3, 50)
    assert correction.abs().max() <= MOST
    assert (factor >= 1 / LARGEST_SCALE - 1e-6).all()
    assert (factor <= LARGEST_SCALE + 1e-6).all()
    assert correction.std() > 0.1


# ---------------------------------------------------------------- features


def test_summaries_do_not_depend_on_how_many_are_alike() -> None:
    r, there = 3 * normal(1, 2, 5, 4, 3), torch.tensor([True, True, False, True])
    once = summary([(r, there)])
    torch.testing.assert_close(summary([(r, there), (r, there)]), once)
    kept = r[..., [0, 1, 3], :]
    torch.testing.assert_close(summary([(kept, torch.ones(3, dtype=torch.bool))]), once)
    signed = (kept.sign() * kept.abs().log1p()).mean((-2, -1))
    size = torch.log(1 + kept.square().mean(-1))
    expected = torch.stack((signed, size.mean(-1), size.amax(-1)), -1)
    torch.testing.assert_close(once, expected)
    assert not summary([(math.nan * r, torch.zeros(4, dtype=torch.bool))]).any()


def test_distances_are_norms() -> None:
    own, points = normal(2, 3, 7, 3), normal(2, 3, 4, 3, seed=1)
    expected = torch.cdist(own, points)
    torch.testing.assert_close(distances(own, points), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"weights": "pfnn"}, "kind 'pfnn': 'pf_corrected' is needed"),
        ({"soft": 1.5}, "soft=1.5 is not allowed"),
        ({"variant": "paper", "weights": "none"}, "variant=paper has the paper's own corrector"),
    ],
)
def test_options_that_cannot_be(chosen: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        make("pf_corrected", make_scenario("indoor-v0"), **chosen)
    assert "\n" not in str(error.value)


def test_landmarks_without_names_are_refused() -> None:
    with pytest.raises(NotServed):
        make("pf_corrected:weights=none", make_scenario("indoor-v0", association="unknown"))
