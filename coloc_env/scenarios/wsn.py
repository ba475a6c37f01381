"""``wsn-v0``: a robot's tag among UWB anchors in the plane (NN-HPFF paper, section 4)."""

from dataclasses import replace
from typing import Annotated, Literal

from coloc_env.motion import Arena, KidnapOptions, Square
from coloc_env.network import Network
from coloc_env.options import PositiveCount, PositiveSpeed, Quantity
from coloc_env.scenario import ConstantVelocity, Prior, Scenario, TeamOptions
from coloc_env.scenarios.parts.anchors import AnchorOptions
from coloc_env.sensors import RangeOptions

_SIDE = 10.0  # m, of the room
_R = 0.04  # m², of the ranges
CASES = {1: (_R, 1.0), 2: (_R / 25, 1.0), 3: (9 * _R, 0.06**2)}  # believed r (m²), q (m²/s⁴)


def wsn(
    *,
    case: Literal[1, 2, 3] = 1,
    q: Annotated[float, Quantity("m²/s⁴", 0.0)] | None = None,
    horizon: PositiveCount = 360,
    max_speed: PositiveSpeed = 1.0,
    team: TeamOptions = TeamOptions(n_uavs=1),
    anchors: AnchorOptions = AnchorOptions(anchors=4),
    ranges: RangeOptions = RangeOptions(uwb_std=_R**0.5),
    kidnap: KidnapOptions = KidnapOptions(),
) -> Scenario:
    """Robots around a square of 6 m at 0.6 m/s in a room of 10 × 10 m, with nothing but their
    distances to anchors in the corners, at 10 Hz.

    ``case``: what the team believes of the variances of ranges and of the acceleration (1: the
    truth; 2: a 25th of the former; 3: nine times the former, and too little of the latter), where
    ``believed_uwb_std`` and ``q`` do not say otherwise. All that robots know of their start is the
    room and that no component of their velocity exceeds ``max_speed``.
    """
    variance, acceleration = CASES[case]
    if ranges.believed_uwb_std is None:
        ranges = replace(ranges, believed_uwb_std=variance**0.5)
    acceleration = acceleration if q is None else q
    arena = Arena(2, team.n_uavs, 0.1, (0.0, 0.0), (_SIDE, _SIDE))
    motion = Square(side=6.0, corner=(2.0, 2.0), period=40.0, sharp=True)
    return Scenario(
        name="wsn-v0",
        arena=arena,
        horizon=horizon,
        motion=kidnap.of(motion, arena.dt),
        sensors=(anchors.true(arena.high, ranges.true),),
        network=Network(),
        prior=Prior(kind="uniform", max_speed=max_speed, attitude_std=3.0),
        process=ConstantVelocity(acceleration**0.5, held=True),
        believed_sensors=(anchors.believed(arena.high, ranges.believed),),
        failure_rate=team.failure_rate,
        reward=team.reward,
    )
