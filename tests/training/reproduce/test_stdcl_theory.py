"""The theory of ST-DCL, numerically: theorem 1 against its recursion, α of known series, and how a
wrong fix spreads."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as tried
from hypothesis import strategies as st

from training.reproduce.settings import Settings
from training.reproduce.stdcl import plan, stdcl, theory
from training.reproduce.stdcl.theory import DIFFUSION
from training.reproduce.work import Piece

STEPS = 40


@given(
    st.floats(0.0, 1.3),
    st.floats(0.0, 100.0),
    st.lists(st.floats(0.0, 5.0), min_size=STEPS, max_size=STEPS),
)
@tried(max_examples=60, deadline=None)
def test_theorem_1_bounds_the_recursion(alpha: float, start: float, drive: list[float]) -> None:
    errors = theory.accumulated(alpha, start, np.array(drive))
    bound = theory.upper_bound(alpha, start, max(drive), STEPS)
    assert (errors <= bound * (1 + 1e-9) + 1e-9).all()


@pytest.mark.parametrize("alpha", [0.0, 0.8, 1.0, 1.1])
def test_theorem_1_is_tight_where_nothing_varies(alpha: float) -> None:
    errors = theory.accumulated(alpha, 3.0, np.full(STEPS, 0.5))
    assert theory.upper_bound(alpha, 3.0, 0.5, STEPS) == pytest.approx(errors)


def test_errors_stay_bounded_below_one_and_diverge_above() -> None:
    """The limit of theorem 1 is w/(1 − α) for α < 1; for α > 1 there is none."""
    assert theory.upper_bound(0.9, 50.0, 2.0, 400)[-1] == pytest.approx(20.0)
    assert theory.upper_bound(1.0, 50.0, 2.0, 400)[-1] == 850.0
    assert theory.upper_bound(1.05, 50.0, 2.0, 400)[-1] > 1e9


@pytest.mark.parametrize("alpha", [0.6, 0.95, 1.0])
def test_the_coupling_of_a_series_that_is_known(alpha: float) -> None:
    rng = np.random.default_rng(0)
    errors = np.zeros((200, 50, 3))
    errors[0] = 50 * rng.standard_normal((50, 3))
    for t in range(199):
        errors[t + 1] = alpha * errors[t] + rng.standard_normal((50, 3))
    scored = np.ones((200, 50), bool)
    scored[100:, :10] = False
    errors[101:, :10] = 1e3 * rng.standard_normal((99, 10, 3))  # not scored: not counted
    assert theory.coupling(errors, scored) == pytest.approx(alpha, abs=0.02)


def test_the_power_of_the_nlos_share() -> None:
    p, q = 0.4, 0.1
    none = np.array([2.0, 3.0])
    found = theory.power(none + 7 * p**1.5, none + 7 * q**1.5, none, p / q)
    assert found == pytest.approx([1.5, 1.5])


def test_a_wrong_fix_fades_from_hop_to_hop() -> None:
    """Of a chain-like network: the further away, the less it moves; nothing moves further than the
    fix (the weights of equation 9 are normalized)."""
    variant = plan.Worlds(60, 6).swarm("thin", "thin", comm_radius=3500.0, ins_bias=0.0)
    piece = Piece(variant, (plan.HUBER,), 1, 1, DIFFUSION)
    torch.set_num_threads(1)
    arrays, facts = theory.record_diffusion(piece, lambda *_: None)
    found = theory.load_diffusion(variant, arrays, facts)
    means = [each.mean() for _, each in sorted(found.by_hops().items())]
    assert len(means) >= 3
    assert 2 < found.degree < 20
    assert means[0] > means[1] > means[2], means
    assert max(means[3:], default=0.0) < means[1], means
    assert 0 < found.moved[np.isfinite(found.hops)].max() < 1
    assert found.moved[np.isinf(found.hops)].max(initial=0.0) < 1e-6  # in another part


def test_the_part_is_planned(tmp_path: Path) -> None:
    part = stdcl(n_uavs=30).parts["theory"]
    settings = Settings(tmp_path, 5)
    cells = list(part.cells(settings))
    planned = {(cell.variant.key, agent) for cell in cells for agent in cell.agents}
    needed = {need[:2] for claim in part.claims(settings) for need in claim.needs}
    assert {need for need in needed if need[1] != "dead_reckoning"} <= planned
