"""Agents of another environment, sensed and localized as UAVs are."""

from collections.abc import Callable

from jaxtyping import Float64
from torch import Tensor

from coloc_env.motion import Arena, Followed
from coloc_env.network import NetworkOptions
from coloc_env.scenario import InsDriven, PriorOptions, Scenario
from coloc_env.scenarios.parts.anchors import AnchorOptions
from coloc_env.sensors import InsOptions, Ranging, Sensor, UavRangeOptions

_FOREVER = 2**31  # steps: how long an episode takes is the other environment's affair


def followed(
    arena: Arena,
    places: Callable[[], Float64[Tensor, "R N d"]],
    *,
    uwb: bool = True,
    ins: InsOptions = InsOptions(ins_std=0.2, ins_bias=0.1),
    ranges: UavRangeOptions = UavRangeOptions(),
    anchors: AnchorOptions = AnchorOptions(anchors=4),
    network: NetworkOptions = NetworkOptions(),
    prior: PriorOptions = PriorOptions(prior_std=1.0),
) -> Scenario:
    """UAVs at ``places`` (m; see ``Followed``) in an arena whose lowest corner is 0, with an INS,
    UWB between all of them and to anchors in the arena's corners.

    ``uwb=false`` leaves out the ranges between UAVs. No scenario by name: only
    ``agents.wrappers.Localized`` knows where the agents are.
    """
    true: list[Sensor] = [ins.sensor]
    believed: list[Sensor] = [ins.sensor]
    if uwb and arena.n_uavs > 1:
        true.append(Ranging(ranges.true, latency=ranges.uwb_delay))
        believed.append(Ranging(ranges.believed, latency=ranges.uwb_delay))
    if anchors.anchors:
        true.append(anchors.true(arena.high, ranges.true))
        believed.append(anchors.believed(arena.high, ranges.believed))
    return Scenario(
        name="followed",
        arena=arena,
        horizon=_FOREVER,
        motion=Followed(places),
        sensors=tuple(true),
        network=network.network(max_neighbours=max(arena.n_uavs, 1)),
        prior=prior.at_start(),
        process=InsDriven(),
        believed_sensors=tuple(believed),
    )
