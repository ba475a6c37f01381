"""``campus-v0``: ten UAVs over a campus, about a building that ranges do not pass (ST-DCL paper,
section 6, simulated)."""

import math
from typing import Literal

from coloc_env.motion import Arena, Box, Court, Motion, Patrol, Split
from coloc_env.network import Network
from coloc_env.reference import SatelliteReference
from coloc_env.scenario import InsDriven, Prior, Scenario
from coloc_env.sensors import Clock, Ins, PositionFix, RangeNoise, Ranging, Sensor

# Metres. Zone A is a court without obstacles, zone B what surrounds the building.
SIZE = (320.0, 120.0, 40.0)
COURT = (55.0, 60.0)
BUILDING: Box = ((140.0, 48.0, 0.0), (240.0, 72.0, 20.0))
_STATIONS: tuple[Box, ...] = (  # the court, and the building's corners from the far left one on
    ((20.0, 20.0, 5.0), (95.0, 100.0, 15.0)),
    ((120.0, 80.0, 5.0), (132.0, 92.0, 15.0)),
    ((248.0, 80.0, 5.0), (260.0, 92.0, 15.0)),
    ((248.0, 28.0, 5.0), (260.0, 40.0, 15.0)),
    ((120.0, 28.0, 5.0), (132.0, 40.0, 15.0)),
)
_ROUTES = (  # around one way and the other, along either side and back, and over the court alone
    (0, 1, 2, 3, 4),
    (0, 4, 3, 2, 1),
    (0, 1, 2, 1, 0),
    (0, 4, 3, 4, 0),
    (0, 0, 0, 0, 0),
)
_FLIGHTS: dict[str, tuple[Motion, int]] = {  # and how many s they take
    "s1": (Court(COURT), 120),
    "s2": (Split(BUILDING), 100),
    "s3": (Patrol(_STATIONS, _ROUTES), 900),
}


def campus(
    *,
    flight: Literal["s1", "s2", "s3"] = "s2",
    n_uavs: int = 10,
    dt: float = 0.1,
    horizon: int | None = None,
    anchors: float = 0.3,
    anchor_std: float = 0.1,
    uwb_std: float = 0.2,
    believed_uwb_std: float | None = None,
    wall_loss: float = 4.3,
    wall_excess: float = 0.08,
    nlos: float = 0.0,
    nlos_bias: float = 1.0,
    nlos_kind: Literal["exponential", "constant"] = "exponential",
    uwb_dropout: float = 0.0,
    clock_offset: float = 0.2,
    clock_skew: float = 0.1,
    ins_std: float = 0.3,
    ins_bias: float = 0.2,
    ins_bias_time: float = 60.0,
    comm_radius: float = 400.0,
    link_failure: float = 0.0,
    message_loss: float = 0.0,
    message_delay: int = 0,
    prior_std: float = 2.0,
    failure_rate: float = 0.0,
    gps_cep: float = 2.0,
    reward: str = "error",
) -> Scenario:
    """A swarm over a campus of 320 × 120 m at 10 Hz, each UAV with the velocity that its INS says
    and its distance to every other within ``comm_radius`` m, and between some of them a building,
    a box of 100 × 24 × 20 m.

    ``flight``: ``s1``, figure eight and breathing circle over the court (120 s); ``s2``, two
    sub-teams part, pass the building on both sides and meet again (100 s); ``s3``, pseudo-random
    patrol between court and building (900 s); ``horizon`` steps (default: the flight's).

    ``anchors``: share of the UAVs that know where they are, to ``anchor_std`` m per axis, and are
    not scored. Three of ten: as few as fix a team in space but for a mirror. They are the first
    ones, so that in ``s2`` one sub-team has none of them. The paper names none for its flights,
    though no method there yields positions from ranges alone; it has 15 % of them elsewhere.

    ``wall_loss`` dB and ``wall_excess`` m per metre of the line of sight inside the building: of
    concrete (ITU-R P.2040, 4 GHz: ε = 5.31, σ = 0.10 S/m) 71 dB and √ε − 1 = 1.30 m, in a building
    that is 6 % walls and floors along the line. Infinite: nothing gets through; 0: what no
    shadowing takes (see ``Network``). A range that does get through also has a bias of
    ``nlos_bias`` m on average, for the first path found is seldom the direct one; ``nlos``: share
    of the other ranges with one. ``clock_offset`` and ``clock_skew``: see ``Clock``. The paper does
    not say how noisy ranges are otherwise.

    The team believes ranges to be N(d, ``believed_uwb_std``²) (default: ``uwb_std``), and the INS
    as it is, its bias counted over 1 s as in ``swarm-v0``. ``gps_cep``: of the reference that the
    paper has instead of the truth (see ``SatelliteReference``), for evaluation alone.
    """
    if not dt > 0:
        raise ValueError(f"dt={dt} is not allowed: a time in s > 0")
    if n_uavs < 2:
        raise ValueError(f"n_uavs={n_uavs} is not allowed: at least two UAVs")
    if not 0 <= anchors < 1:
        raise ValueError(f"anchors={anchors} is not allowed: a share in [0, 1)")
    guides = round(anchors * n_uavs)
    motion, lasts = _FLIGHTS[flight]
    error = RangeNoise(uwb_std, nlos, nlos_bias, nlos_kind, dropout=uwb_dropout)
    assumed = RangeNoise(uwb_std if believed_uwb_std is None else believed_uwb_std)
    own: tuple[Sensor, ...] = (Ins(ins_std, ins_bias, ins_bias_time),)
    if guides:
        own = (*own, PositionFix(anchor_std, guides))
    clocks = Clock(clock_offset, clock_skew)
    ranging = Ranging(
        error,
        walls=(BUILDING,),
        excess=wall_excess,
        clock=clocks,
    )
    return Scenario(
        name="campus-v0",
        arena=Arena(3, n_uavs, dt, (0.0, 0.0, 0.0), SIZE),
        horizon=math.ceil(lasts / dt) if horizon is None else horizon,
        motion=motion,
        sensors=(*own, ranging),
        network=Network(
            comm_radius,
            (BUILDING,),
            message_loss,
            message_delay,
            max_neighbours=n_uavs,
            failure=link_failure,
            wall_loss=wall_loss,
        ),
        prior=Prior(position_std=prior_std),
        process=InsDriven(2.0 / dt),
        believed_sensors=(*own, Ranging(assumed, clock=clocks)),
        failure_rate=failure_rate,
        reward=reward,
        guides=guides,
        reference=SatelliteReference(gps_cep),
    )
