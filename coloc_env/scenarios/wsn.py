"""``wsn-v0``: a robot's tag among UWB anchors in the plane (NN-HPFF paper, section 4)."""

import math
from typing import Literal

from coloc_env.motion import Arena, Square
from coloc_env.network import Network
from coloc_env.scenario import ConstantVelocity, Prior, Scenario
from coloc_env.scenarios.parts import anchor_places, blocked_anchors, kidnapped_at
from coloc_env.sensors import AnchorRanging, RangeNoise

_SIDE = 10.0  # m, of the room
_R = 0.04  # m², of the ranges
CASES = {1: (_R, 1.0), 2: (_R / 25, 1.0), 3: (9 * _R, 0.06**2)}  # believed r (m²), q (m²/s⁴)


def wsn(
    *,
    case: Literal[1, 2, 3] = 1,
    n_uavs: int = 1,
    horizon: int = 360,
    anchors: int = 4,
    r_true: float = _R,
    r_believed: float | None = None,
    q: float | None = None,
    nlos: float = 0.0,
    nlos_anchor: int | None = None,
    nlos_bias: float = 1.0,
    nlos_kind: Literal["exponential", "constant"] = "exponential",
    dropout: float = 0.0,
    kidnap_at: float | None = None,
    max_speed: float = 1.0,
    reward: str = "error",
) -> Scenario:
    """Robots around a square of 6 m at 0.6 m/s in a room of 10 × 10 m, each with its distances to
    anchors in the corners at 10 Hz and no other sensor; all they are told of their start is the
    room and ``max_speed``.

    ``case``: what the team believes of the ranges' variance and of the acceleration's (1: the
    truth; 2: a 25th of the former; 3: nine times the former, and too little of the latter);
    ``r_believed`` (m²) and ``q`` (m²/s⁴) say otherwise, ``r_true`` is the truth. ``nlos``: share of
    ranges with a bias of ``nlos_bias`` m on average; ``nlos_anchor``: the anchor all of whose
    ranges have one. At ``kidnap_at`` s everyone is put on the room's other side.
    """
    variance, acceleration = CASES[case]
    variance = variance if r_believed is None else r_believed
    acceleration = acceleration if q is None else q
    if not 0 < min(r_true, variance) <= max(r_true, variance) < math.inf:
        raise ValueError("r_true and r_believed are variances in m² > 0")
    if not 0 <= acceleration < math.inf:
        raise ValueError(f"q={acceleration} is not allowed: a variance in m²/s⁴ ≥ 0")
    arena = Arena(2, n_uavs, 0.1, (0.0, 0.0), (_SIDE, _SIDE))
    places = anchor_places(anchors, arena.high)
    error = RangeNoise(r_true**0.5, nlos, nlos_bias, nlos_kind, dropout=dropout)
    motion = Square(side=6.0, corner=(2.0, 2.0), period=40.0, sharp=True)
    return Scenario(
        name="wsn-v0",
        arena=arena,
        horizon=horizon,
        motion=kidnapped_at(motion, kidnap_at, None, arena.dt),
        sensors=(AnchorRanging(places, error, blocked=blocked_anchors(nlos_anchor)),),
        network=Network(),
        prior=Prior(kind="uniform", max_speed=max_speed, attitude_std=3.0),
        process=ConstantVelocity(acceleration**0.5, held=True),
        believed_sensors=(AnchorRanging(places, RangeNoise(std=variance**0.5)),),
        reward=reward,
    )
