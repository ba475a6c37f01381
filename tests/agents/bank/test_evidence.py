"""Evidence between two filters: Student's t by scipy, and the running sum in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from agents import make
from agents.bank.evidence import LARGEST, accumulated, predictive_score
from agents.models.measurements import Block
from coloc_env.scenarios import make_scenario


def block(k: int, seed: int, scale: float = 1.0) -> tuple[Block, torch.Tensor]:
    """Four measurements of k numbers of a UAV with six errors, and their prior's covariance."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    root = draw(1, 1, 6, 6)
    made = Block(
        residual=scale * draw(1, 1, 4, k),
        jacobian=draw(1, 1, 4, k, 6),
        variance=draw(1, 1, 4, k).square() + 0.1,
        mask=torch.tensor([[[True, True, False, True]]]),
    )
    return made, root @ root.mT


@given(st.integers(1, 3), st.integers(0, 10**6), st.floats(1.0, 30.0), st.floats(0.1, 50.0))
@settings(deadline=None, max_examples=60)
def test_the_score_is_students_t(k: int, seed: int, degrees: float, scale: float) -> None:
    """That of scipy, up to what depends on ν and k alone; what is masked does not count."""
    one, covariance = block(k, seed, scale)
    constant = (
        math.lgamma((degrees + k) / 2)
        - math.lgamma(degrees / 2)
        - 0.5 * k * math.log(degrees * math.pi)
    )
    expected = 0.0
    for j in (0, 1, 3):
        h, r = one.jacobian[0, 0, j].numpy(), one.residual[0, 0, j].numpy()
        s = h @ covariance[0, 0].numpy() @ h.T + np.diag(one.variance[0, 0, j].numpy())
        t = stats.multivariate_t(np.zeros(k), s, df=degrees)
        expected += float(t.logpdf(r)) - constant
    found = float(predictive_score([one], covariance, degrees))
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)
    shared = float(predictive_score([replace(one, mutual=True)], covariance, degrees))
    assert shared == pytest.approx(0.5 * expected, rel=1e-9, abs=1e-9)


@given(st.floats(-20, 20), st.integers(1, 300), st.floats(0.5, 0.999))
@settings(deadline=None, max_examples=60)
def test_evidence_is_a_geometric_sum(gain: float, steps: int, forgetting: float) -> None:
    """A_n = g (1 − λⁿ) / (1 − λ), g within ±3."""
    evidence, zero = torch.zeros(1, 1, dtype=torch.float64), torch.zeros(1, 1)
    for _ in range(steps):
        evidence = accumulated(evidence, zero + gain, zero, forgetting)
    clipped = max(-LARGEST, min(LARGEST, float(torch.tensor(gain))))
    expected = clipped * (1 - forgetting**steps) / (1 - forgetting)
    assert float(evidence) == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("broken", [math.nan, -math.inf])
def test_a_prediction_that_is_no_number_is_the_worst(broken: float) -> None:
    zero, bad = torch.zeros(1, 1, dtype=torch.float64), torch.full((1, 1), broken)
    assert float(accumulated(zero, bad, zero, 0.98)) == -LARGEST
    assert float(accumulated(zero, zero, bad, 0.98)) == LARGEST
    assert float(accumulated(zero, bad, bad, 0.98)) == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("forgetting=1", "forgetting='1' is not allowed: a number > 0 and < 1 is needed"),
        ("degrees=0", "degrees='0' is not allowed: a number > 0"),
        ("restart=1", "restart='1' is not allowed: a number"),
        ("bank=maybe", "bank='maybe' is not allowed: true or false"),
    ],
)
@pytest.mark.parametrize("name", ["ekf_trust", "pf_trust", "hpff", "nnhpff"])
def test_constants_that_cannot_be(name: str, options: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        make(f"{name}:{options}", make_scenario("indoor-v0", anchors=4))
    assert "\n" not in str(error.value)
