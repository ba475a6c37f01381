"""``swarm-v0``: two hundred UAVs over kilometres, some of which know where they are (ST-DCL paper,
section 5)."""

from typing import Literal

from coloc_env.motion import Arena, Box
from coloc_env.network import Network
from coloc_env.scenario import InsDriven, Prior, Scenario
from coloc_env.scenarios.swarm_motions import SwarmMotion, swarm_motion
from coloc_env.sensors import Ins, PositionFix, RangeNoise, Ranging, Sensor

_ARM = 0.3  # width of the arms of a U or an O, of the side


def swarm(
    *,
    n_uavs: int = 200,
    size: tuple[float, float, float] = (10_000.0, 10_000.0, 5_000.0),
    layout: Literal["random", "u", "o"] = "random",
    motion: SwarmMotion = "random",
    v_max: float = 50.0,
    dt: float = 1.0,
    horizon: int = 100,
    anchors: float = 0.15,
    anchor_std: float = 0.1,
    uwb_std: float = 10.0,
    nlos: float = 0.15,
    nlos_bias: float = 25.0,
    nlos_kind: Literal["exponential", "constant"] = "constant",
    nlos_time: float | None = None,
    uwb_tail: float = 0.0,
    uwb_tail_std: float = 50.0,
    uwb_dropout: float = 0.0,
    ins_std: float = 0.5,
    ins_bias: float = 0.3,
    ins_bias_time: float = 60.0,
    comm_radius: float | None = 5_000.0,
    link_failure: float = 0.0,
    message_loss: float = 0.0,
    message_delay: int = 0,
    prior_std: float = 50.0,
    failure_rate: float = 0.0,
    reward: str = "error",
) -> Scenario:
    """A swarm in a box of 10 × 10 × 5 km, each UAV with the velocity that its INS says and, once a
    second, its distance to every other within ``comm_radius`` m; a slot for each UAV.

    ``anchors``: share of the UAVs that know where they are, to ``anchor_std`` m per axis; they are
    not scored. ``layout``: where UAVs fly, the whole box, or the arms of a ``u`` or an ``o`` around
    a hole. ``motion``: target velocities drawn anew (``random``), a ``line``, level ``circle`` or
    ``helix`` for each UAV, or a ``weave`` of ten through one point, each at speeds up to ``v_max``
    m/s. ``nlos``: share of ranges with a bias of ``nlos_bias`` m, every step anew or over
    ``nlos_time`` s; ``uwb_tail``: share with ``uwb_tail_std`` m of noise. ``link_failure``:
    probability that a link is broken in a step; ``failure_rate``: that a UAV fails in an episode.
    The team believes the Gaussian part of the ranges, and the INS as it is.
    """
    if not (dt > 0 and min(size) > 0):
        raise ValueError("dt (s) and the sides of size (m) must be > 0")
    if n_uavs < 1:
        raise ValueError(f"n_uavs={n_uavs} is not allowed: at least one UAV")
    if not 0 <= anchors < 1:
        raise ValueError(f"anchors={anchors} is not allowed: a share in [0, 1)")
    guides, boxes = round(anchors * n_uavs), _boxes(layout, size)
    error = RangeNoise(
        std=uwb_std,
        nlos=nlos,
        nlos_bias=nlos_bias,
        nlos_kind=nlos_kind,
        tail=uwb_tail,
        tail_std=uwb_tail_std,
        dropout=uwb_dropout,
        nlos_time=nlos_time,
    )
    own: tuple[Sensor, ...] = (Ins(ins_std, ins_bias, ins_bias_time),)
    if guides:
        own = (*own, PositionFix(anchor_std, guides))
    return Scenario(
        name="swarm-v0",
        arena=Arena(3, n_uavs, dt, (0.0, 0.0, 0.0), size),
        horizon=horizon,
        motion=swarm_motion(motion, v_max, boxes, size),
        sensors=(*own, Ranging(error)),
        network=Network(
            comm_radius,
            loss=message_loss,
            delay=message_delay,
            max_neighbours=n_uavs,
            failure=link_failure,
        ),
        prior=Prior(position_std=prior_std),
        process=InsDriven(),
        believed_sensors=(*own, Ranging(RangeNoise(std=uwb_std))),
        failure_rate=failure_rate,
        reward=reward,
        guides=guides,
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
