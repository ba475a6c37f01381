"""PF-NN's corrector: equations 11 to 14 by hand, and what it may do to an adaptive filter."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from agents import make
from agents.layers import Linear
from agents.particle.corrector import WeightCorrector, motion_features
from coloc_env.scenarios import make_scenario


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def filter_of(name: str = "pfnn:weights=none", **chosen: Any) -> Any:
    return make(name, make_scenario("indoor-v0"), **chosen)


def saying(y: float, **chosen: Any) -> Any:
    """A filter whose network says y of every particle."""
    localizer = filter_of(**chosen)
    with torch.no_grad():
        localizer.corrector.out.weight.zero_()
        localizer.corrector.out.bias.fill_(torch.logit(torch.tensor(y)))
    return localizer


# ---------------------------------------------------------------- equations


@pytest.mark.parametrize("bounds", [(0.4, 1.0), (0.2, 1.2), (0.7, 0.7)])
def test_the_factor_is_that_of_equations_11_to_14(bounds: tuple[float, float]) -> None:
    localizer = filter_of(correction=bounds)
    corrector = localizer.corrector
    with torch.no_grad():
        for i, parameter in enumerate(corrector.parameters()):
            parameter.copy_(normal(*parameter.shape, seed=i))
    particles, last = normal(2, 3, 40, 10, seed=10), normal(2, 3, 6, seed=11)
    found = localizer.log_correction(particles, SimpleNamespace(last=last))
    w1, b1, w2, b2 = (p.detach().double().numpy() for p in corrector.parameters())
    for b, n, m in np.ndindex(2, 3, 40):
        f = (particles[b, n, m, :6] - last[b, n]).double().numpy()  # equation 11
        h = np.tanh(w1 @ f + b1)  # equation 12
        y = 1 / (1 + np.exp(-(w2 @ h + b2)[0]))  # equation 13
        c = bounds[0] + (bounds[1] - bounds[0]) * y  # equation 14
        if bounds == (0.4, 1.0):
            assert c == pytest.approx(0.7 + 0.6 * (y - 0.5))
        assert float(found[b, n, m].exp()) == pytest.approx(c, abs=1e-5)


def test_the_network_is_that_of_the_paper() -> None:
    shapes = {name: tuple(p.shape) for name, p in WeightCorrector().named_parameters()}
    assert shapes == {
        "hidden.weight": (12, 6),
        "hidden.bias": (12,),
        "out.weight": (1, 12),
        "out.bias": (1,),
    }


@pytest.mark.parametrize("m", [110, 350, 799])
def test_a_particle_is_corrected_alike_however_many_there_are(m: int) -> None:
    corrector, features = WeightCorrector(), normal(6, 7, 4, 800, seed=3).movedim(0, -1)
    with torch.no_grad():
        every = corrector(features)
        assert torch.equal(corrector(features[2:3, 1:2, :m]), every[2:3, 1:2, :m])


def test_gradients_of_what_is_far_away_are_finite() -> None:
    corrector = WeightCorrector()
    corrector(1e4 * normal(30, 6)).sum().backward()
    assert all(bool(p.grad.isfinite().all()) for p in corrector.parameters())


def test_features_of_the_plane_have_no_height() -> None:
    particles, last = normal(2, 3, 7, 5), normal(2, 3, 4, seed=1)
    found = motion_features(particles, last, 2)
    apart = particles[..., :4] - last.unsqueeze(-2)
    assert found.shape == (2, 3, 7, 6)
    assert torch.equal(found[..., [0, 1, 3, 4]], apart)
    assert not found[..., [2, 5]].any()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3, 1e9])
@pytest.mark.parametrize("bounds", [(0.4, 1.0), (0.2, 1.2)])
def test_the_factor_stays_in_its_range(scale: float, bounds: tuple[float, float]) -> None:
    localizer = filter_of(correction=bounds)
    with torch.no_grad():
        for parameter in localizer.corrector.parameters():
            parameter.mul_(scale)
    particles, last = scale * normal(2, 3, 200, 10), normal(2, 3, 6, seed=1)
    c = localizer.log_correction(particles, SimpleNamespace(last=last)).exp()
    assert c.isfinite().all()
    assert (c > bounds[0] - 1e-6).all()
    assert (c < bounds[1] + 1e-6).all()


# ---------------------------------------------------------------- in the filter


@pytest.mark.parametrize("y", [1.0, None], ids=["says 1", "range of one number"])
def test_a_factor_of_one_changes_nothing(y: float | None, tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    localizer = filter_of(correction=(1.0, 1.0)) if y is None else saying(y)
    found = tools.play(localizer, scenario, [0, 1], 10)
    plain = tools.play(make("apf", scenario), scenario, [0, 1], 10)
    tools.assert_same(found.beliefs[-1], plain.beliefs[-1])
    tools.assert_same(found.estimates[-1], plain.estimates[-1])


@pytest.mark.parametrize("y", [0.1, 0.9])
def test_a_constant_network_changes_nothing_but_rounding(y: float, tools: SimpleNamespace) -> None:
    """Each step from the same belief: over many, a last digit may choose another particle."""
    scenario = make_scenario("indoor-v0")
    plain, constant = make("apf", scenario), saying(y)
    run = tools.play(plain, scenario, [0, 1], 8)
    for k in range(3, 8):
        after, estimate = constant.step(run.beliefs[k], run.observations[k])
        expected = run.estimates[k]
        torch.testing.assert_close(estimate.position, expected.position, rtol=0, atol=1e-4)
        torch.testing.assert_close(estimate.covariance, expected.covariance, rtol=1e-2, atol=1e-6)
        assert torch.equal(after.count, run.beliefs[k + 1].count)


def test_a_network_that_prefers_particles_gets_them(tools: SimpleNamespace) -> None:
    """Or the tests above could not fail: one that likes particles far to the east moves there."""
    scenario = make_scenario("indoor-v0")
    localizer = filter_of(correction=(0.01, 1.0))
    with torch.no_grad():
        for parameter in localizer.corrector.parameters():
            parameter.zero_()
        localizer.corrector.hidden.weight[0, 0] = 20.0
        localizer.corrector.out.weight[0, 0] = 10.0
    plain = make("apf", scenario)
    run = tools.play(plain, scenario, [0, 1], 6)
    for k in (4, 5):
        belief, _ = localizer.step(run.beliefs[k], run.observations[k])
        assert (belief.last[..., 0] - run.beliefs[k + 1].last[..., 0]).mean() > 1e-3


def test_motion_is_measured_from_the_last_estimate(tools: SimpleNamespace) -> None:
    scenario = make_scenario("indoor-v0")
    run = tools.play(filter_of("pfnn"), scenario, [0], 4)
    prior = run.observations[0]["prior"][..., :6]
    assert torch.equal(run.beliefs[0].last, prior)
    for belief, estimate in zip(run.beliefs[1:], run.estimates, strict=True):
        assert torch.equal(belief.last, torch.cat((estimate.position, estimate.velocity), -1))


def test_the_shipped_weights_are_loaded() -> None:
    shipped, drawn, again = filter_of("pfnn"), filter_of(), filter_of()
    for name, parameter in drawn.corrector.named_parameters():
        assert torch.equal(parameter, again.corrector.get_parameter(name))
        assert not torch.equal(parameter, shipped.corrector.get_parameter(name))
    other = filter_of(seed=1).corrector.out.weight
    assert not torch.equal(other, drawn.corrector.out.weight)


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"correction": (0.0, 1.0)}, r"correction=\(0.0, 1.0\) is not allowed: 2 numbers > 0"),
        ({"correction": (1.0, 0.4)}, "low ≤ high"),
        ({"correction": (-0.4, 0.4)}, "2 numbers > 0"),
        ({"correction": (float("nan"), 1.0)}, "correction"),
        ({"weights": "pfn"}, "unknown checkpoint 'pfn'.*did you mean 'pfnn'"),
        ({"weights": "trust"}, "kind 'trust': 'pfnn' is needed"),
        ({"particles": 50}, "bounds"),
    ],
)
def test_options_that_cannot_be(chosen: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        make("pfnn", make_scenario("indoor-v0"), **chosen)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------- layers


@pytest.mark.parametrize("m", [1, 5, 20, 53, 800])
@pytest.mark.parametrize(("inputs", "outputs"), [(6, 12), (12, 1), (15, 32), (32, 32), (32, 2)])
def test_rows_of_a_layer_do_not_round_by_their_number(m: int, inputs: int, outputs: int) -> None:
    torch.manual_seed(0)
    layer = Linear(inputs, outputs)
    x = normal(70, 6, m, inputs)
    with torch.no_grad():
        many = layer(x)
        for b in (0, 34, 69):
            assert torch.equal(layer(x[b : b + 1].clone()), many[b : b + 1])
        expected = torch.nn.functional.linear(x, layer.weight, layer.bias)
    torch.testing.assert_close(many, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("m", [53, 800])
def test_a_uav_all_alone_does_not_round_otherwise(m: int) -> None:
    torch.manual_seed(0)
    layer, x = Linear(12, 1), normal(2, 6, m, 12)
    with torch.no_grad():
        assert torch.equal(layer(x[:1, :1].clone()), layer(x)[:1, :1])
