"""The share of learned trust's gain that a bank keeps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from training.reproduce.pfnn.bank import kept


@given(st.floats(-0.5, 1.2), st.integers(0, 10**6))
@settings(deadline=None, max_examples=20)
def test_a_share_kept_in_every_world_is_the_share(share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    huber, most = rng.uniform(0.05, 1.0, 24), rng.uniform(0.05, 0.5, 24)
    found = kept(huber, huber * np.exp(-most), huber * np.exp(-share * most))
    assert found[:3] == pytest.approx((share, share, share), abs=1e-9)
    assert found[3] == pytest.approx(most.mean())


def test_the_interval_holds_what_differs_between_worlds() -> None:
    rng = np.random.default_rng(1)
    huber = np.ones(24)
    found = kept(huber, huber * np.exp(-0.3), huber * np.exp(-rng.uniform(0.1, 0.4, 24)))
    assert found[1] < found[0] < found[2]
    assert found[2] - found[1] < 0.3
