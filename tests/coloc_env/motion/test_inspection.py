"""Fast transit, slow rounds."""

import math

import pytest
import torch

from coloc_env.motion import Inspection

ROOM = (30.0, 20.0, 5.0)


def test_two_scales_of_speed(arena, fly):
    speed = fly(Inspection(), arena(*ROOM), [0, 1], 3000).velocity.norm(dim=-1)
    assert float(speed.max()) <= 4.5
    assert float(speed.max()) > 2.5
    slow = ((speed - 0.25).abs() < 1e-9).double().mean()
    fast = (speed > 0.5).double().mean()
    assert 0.3 < float(slow) < 0.8
    assert 0.15 < float(fast) < 0.5


def test_a_round_is_a_level_circle_back_to_its_start(arena, fly):
    motion = Inspection(radius=0.8, slow_speed=0.4)
    truth = fly(motion, arena(*ROOM, n=1, dt=0.01), [3], 3200)
    place, pace = truth.position[0, :, 0], truth.velocity[0, :, 0]
    going = (pace.norm(dim=-1) - 0.4).abs() < 1e-9
    first = int(going.nonzero()[0])
    rest = (~going[first:]).nonzero()[0]
    part = slice(first, first + int(rest))
    # Curvature 1 / radius to the left, and no climb.
    turn = torch.atan2(
        pace[part][:-1, 0] * pace[part][1:, 1] - pace[part][:-1, 1] * pace[part][1:, 0],
        (pace[part][:-1, :2] * pace[part][1:, :2]).sum(-1),
    )
    torch.testing.assert_close(turn, torch.full_like(turn, 0.4 * 0.01 / 0.8), rtol=1e-6, atol=0)
    assert float((place[part][:, 2] - place[part][0, 2]).abs().max()) == 0.0
    whole = float(turn.sum()) + 0.4 * 1.0 / 0.8  # and half a ramp's way at either end
    assert whole == pytest.approx(2 * math.pi, abs=0.02)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"radius": 0.01}, "radius = 0.01 m is too small"),
        ({"radius": 9.0}, "does not fit the arena"),
        ({"max_speed": 0.0}, "max_speed must be positive"),
    ],
)
def test_what_does_not_fit_is_refused(wrong, words, arena, fly):
    with pytest.raises(ValueError, match=words):
        fly(Inspection(**wrong), arena(*ROOM), [0], 2)
