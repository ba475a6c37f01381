"""The semidefinite program: exact where ranges are, and as good a start as dead reckoning."""

import numpy as np
import pytest
import torch

from training.reproduce.stdcl import plan, sdp
from training.reproduce.work import Piece

pytest.importorskip("cvxpy")


def test_exact_ranges_give_the_positions() -> None:
    rng = np.random.default_rng(1)
    place = 1000 * rng.random((14, 3))
    fixed = np.arange(14) < 6
    distance = np.linalg.norm(place[:, None] - place, axis=-1)
    known = np.where(fixed[:, None], place, 0.0)  # the others' are not looked at
    linked = ~np.eye(14, dtype=bool)
    found, gap = sdp.relaxed(distance, linked, fixed, known, 0.0)
    assert np.abs(found - place).max() < 1.0
    assert gap < 1e-3


@pytest.mark.slow
def test_gauss_newton_finds_the_same_from_both_starts() -> None:
    """With everybody in reach the minimum near dead reckoning is the one that the program finds."""
    torch.set_num_threads(1)
    variant = plan.Worlds(24, 3).swarm(
        "dense", "dense", comm_radius=15000.0, anchor_share=0.4, nlos=0.0
    )
    piece = Piece(variant, ("gn:confidence=none",), 2, 1, sdp.SDP)
    arrays, facts = sdp.record_sdp(piece, lambda *_: None)
    found = sdp.load_sdp(variant, arrays, facts)
    relaxed, refined, usual = found.rmse.values()
    assert refined == pytest.approx(usual, rel=1e-3)
    assert usual < relaxed < 10 * usual
