"""``swarm-v0``: two hundred UAVs over kilometres, some of which know where they are (ST-DCL paper,
section 5)."""

from typing import Literal

from coloc_env.motion import Arena, Box, ControlOptions
from coloc_env.network import NetworkOptions
from coloc_env.options import PositiveCount, PositiveMetres, PositiveSeconds, PositiveSpeed
from coloc_env.scenario import InsDriven, PriorOptions, Scenario, TeamOptions
from coloc_env.scenarios.parts.swarm_motions import SwarmMotion, swarm_motion
from coloc_env.sensors import AnchorUavOptions, InsOptions, Ranging, Sensor, UavRangeOptions

_ARM = 0.3  # width of the arms of a U or an O, of the side


def swarm(
    *,
    size: tuple[PositiveMetres, PositiveMetres, PositiveMetres] = (10_000.0, 10_000.0, 5_000.0),
    layout: Literal["random", "u", "o"] = "random",
    motion: SwarmMotion = "random",
    v_max: PositiveSpeed = 50.0,
    dt: PositiveSeconds = 1.0,
    horizon: PositiveCount = 100,
    team: TeamOptions = TeamOptions(n_uavs=200),
    anchor_uavs: AnchorUavOptions = AnchorUavOptions(),
    ranges: UavRangeOptions = UavRangeOptions(
        uwb_std=10.0,
        nlos=0.15,
        nlos_bias=25.0,
        nlos_kind="constant",
        uwb_tail_std=50.0,
        uwb_impulse_size=500.0,
    ),
    ins: InsOptions = InsOptions(),
    network: NetworkOptions = NetworkOptions(comm_radius=5_000.0),
    prior: PriorOptions = PriorOptions(prior_std=50.0),
    control: ControlOptions = ControlOptions(a_max=15.0),
) -> Scenario:
    """A swarm in a box of 10 × 10 × 5 km; once a second each UAV has its velocity by an INS and its
    distances to the others in reach.

    ``size``: the box's sides; ``layout``: where in it UAVs are, anywhere, or in the arms of a ``u``
    or an ``o`` around a hole. ``motion``: target velocities that are drawn now and then
    (``random``), a ``line``, level ``circle`` or ``helix`` for each UAV, or a ``weave`` of ten
    through one point, each at speeds up to ``v_max``. Each UAV has a slot for every other.
    """
    n_uavs = team.n_uavs
    own: tuple[Sensor, ...] = (ins.sensor, *anchor_uavs.fixes(n_uavs))
    return Scenario(
        name="swarm-v0",
        arena=Arena(3, n_uavs, dt, (0.0, 0.0, 0.0), size),
        horizon=horizon,
        motion=control.of(swarm_motion(motion, v_max, _boxes(layout, size), size), v_max),
        sensors=(*own, Ranging(ranges.true, latency=ranges.uwb_delay)),
        network=network.network(max_neighbours=n_uavs),
        prior=prior.at_start(),
        process=InsDriven(),
        believed_sensors=(*own, Ranging(ranges.believed, latency=ranges.uwb_delay)),
        failure_rate=team.failure_rate,
        reward=team.reward,
        anchor_uavs=anchor_uavs.count(n_uavs),
    )


def _boxes(layout: str, size: tuple[float, float, float]) -> tuple[Box, ...]:
    """The upright boxes that make up a layout; none for the whole."""
    x, y, z = size
    left, right, front, back = _ARM * x, (1 - _ARM) * x, _ARM * y, (1 - _ARM) * y
    sides: tuple[Box, ...] = (
        ((0.0, 0.0, 0.0), (left, y, z)),
        ((right, 0.0, 0.0), (x, y, z)),
    )
    between: dict[str, tuple[Box, ...]] = {
        "u": (((left, 0.0, 0.0), (right, front, z)),),
        "o": (((left, 0.0, 0.0), (right, front, z)), ((left, back, 0.0), (right, y, z))),
    }
    return () if layout == "random" else sides + between[layout]
