"""``campus-v0``: ten UAVs over a campus, about a building that ranges do not pass (ST-DCL paper,
section 6, simulated)."""

import math
from typing import Annotated, Literal

from coloc_env.motion import Arena, Box, Court, Motion, Patrol, Split
from coloc_env.network import NetworkOptions
from coloc_env.options import Metres, PositiveCount, PositiveSeconds, Quantity
from coloc_env.reference import SatelliteReference
from coloc_env.scenario import InsDriven, PriorOptions, Scenario, TeamOptions
from coloc_env.sensors import (
    AnchorUavOptions,
    Clock,
    InsOptions,
    Ranging,
    Sensor,
    UavRangeOptions,
)

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
    dt: PositiveSeconds = 0.1,
    horizon: PositiveCount | None = None,
    wall_loss: Annotated[float, Quantity("dB/m", 0.0, infinite=True)] = 4.3,
    wall_excess: Annotated[float, Quantity("m/m", 0.0)] = 0.08,
    clock_offset: Metres = 0.2,
    clock_skew: Metres = 0.1,
    gps_cep: Metres = 2.0,
    team: TeamOptions = TeamOptions(n_uavs=10),
    anchor_uavs: AnchorUavOptions = AnchorUavOptions(anchor_share=0.3),
    ranges: UavRangeOptions = UavRangeOptions(),
    ins: InsOptions = InsOptions(ins_std=0.3, ins_bias=0.2),
    network: NetworkOptions = NetworkOptions(comm_radius=400.0),
    prior: PriorOptions = PriorOptions(),
) -> Scenario:
    """A swarm over a campus of 320 × 120 m with a building of 100 × 24 × 20 m in it; ten times a
    second each UAV has its velocity by an INS and its distances to the others in reach.

    ``flight``: ``s1``, figure eight and breathing circle over the court (120 s); ``s2``, two
    sub-teams part, pass the building on both sides and meet again (100 s); ``s3``, pseudo-random
    patrol between court and building (900 s); ``horizon`` steps (none: the flight's).

    Three of ten UAVs know where they are: as few as fix a team in space but for a mirror. They are
    the first ones, so that in ``s2`` one sub-team has none of them. The paper names none for its
    flights, though no method there yields positions from ranges alone; it has 15 % of them
    elsewhere. Nor does it say how noisy ranges in sight are.

    ``wall_loss`` dB and ``wall_excess`` m per metre of the line of sight inside the building: of
    concrete (ITU-R P.2040, 4 GHz: ε = 5.31, σ = 0.10 S/m) 71 dB and √ε − 1 = 1.30 m, in a building
    that is 6 % walls and floors along the line. Infinite: nothing gets through; 0: what no
    shadowing takes (see ``Network``). Every range that does get through has the bias of NLOS, too:
    the first path found is seldom the direct one. ``clock_offset`` and ``clock_skew``: see
    ``Clock``. ``gps_cep``: of the reference that the paper has instead of the truth (see
    ``SatelliteReference``), for evaluation alone. The INS's bias counts over 1 s, as in
    ``swarm-v0``.
    """
    n_uavs = team.n_uavs
    if n_uavs < 2:
        raise ValueError(f"n_uavs={n_uavs} is not allowed: at least two UAVs")
    motion, duration = _FLIGHTS[flight]
    own: tuple[Sensor, ...] = (ins.sensor, *anchor_uavs.fixes(n_uavs))
    clock, latency = Clock(clock_offset, clock_skew), ranges.uwb_delay
    ranging = Ranging(ranges.true, (), latency, (BUILDING,), wall_excess, clock)
    return Scenario(
        name="campus-v0",
        arena=Arena(3, n_uavs, dt, (0.0, 0.0, 0.0), SIZE),
        horizon=math.ceil(duration / dt) if horizon is None else horizon,
        motion=motion,
        sensors=(*own, ranging),
        network=network.network(walls=(BUILDING,), max_neighbours=n_uavs, wall_loss=wall_loss),
        prior=prior.at_start(),
        process=InsDriven(2.0 / dt),
        believed_sensors=(*own, Ranging(ranges.believed, latency=latency, clock=clock)),
        failure_rate=team.failure_rate,
        reward=team.reward,
        anchor_uavs=anchor_uavs.count(n_uavs),
        reference=SatelliteReference(gps_cep),
    )
