"""A corridor with UWB anchors along its walls."""

from coloc_env.motion import Arena, RandomVelocity
from coloc_env.network import Network
from coloc_env.options import PositiveCount, PositiveMetres
from coloc_env.scenario import ConstantVelocity, Prior, Scenario
from coloc_env.sensors import AnchorRanging, RangeNoise


def corridor(
    *, n_uavs: PositiveCount = 3, length: PositiveMetres = 40.0, horizon: PositiveCount = 100
) -> Scenario:
    """UAVs in a corridor of 4 m by 3 m, with two anchors every 10 m."""
    low_high = ((0.0, 3.0), (3.0, 0.0))  # by turns: anchors in one plane leave a mirror image
    places = tuple(
        (10.0 * i, y, z)
        for i in range(int(length) // 10 + 1)
        for y, z in zip((0.0, 4.0), low_high[i % 2], strict=True)
    )
    sensors = (AnchorRanging(places, RangeNoise(std=0.1)),)
    return Scenario(
        name="corridor-v0",
        arena=Arena(3, n_uavs, 0.1, (0.0, 0.0, 0.0), (length, 4.0, 3.0)),
        horizon=horizon,
        motion=RandomVelocity(1.0),
        sensors=sensors,
        network=Network(),
        prior=Prior(position_std=1.0),
        process=ConstantVelocity(accel_std=1.0),
        believed_sensors=sensors,
    )
