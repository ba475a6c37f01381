"""``indoor-v0``: six UAVs circling in a room with landmarks and UWB (PF-NN paper, section 3.1)."""

import math
from dataclasses import replace

from coloc_env.motion import (
    MOTIONS,
    Arena,
    Box,
    ControlOptions,
    GustOptions,
    KidnapOptions,
    Motion,
    MotionName,
    RandomCircles,
)
from coloc_env.network import WalledNetworkOptions
from coloc_env.options import PositiveCount, PositiveMetres, PositiveSeconds, PositiveSpeed
from coloc_env.scenario import (
    AttitudePriorOptions,
    ConstantVelocity,
    Inertial,
    Process,
    Scenario,
    TeamOptions,
)
from coloc_env.scenarios.parts.anchors import AnchorOptions, TdoaOptions, signal_strengths
from coloc_env.sensors import (
    AngleOptions,
    BarometerOptions,
    CompassOptions,
    FlowOptions,
    GnssOptions,
    LandmarkOptions,
    LightOptions,
    MagneticOptions,
    MapOptions,
    Ranging,
    RssiOptions,
    Sensor,
    SightOptions,
    SimulatedImuOptions,
    TagOptions,
    UavRangeOptions,
    UltrasonicOptions,
)


def indoor(
    *,
    room: tuple[PositiveMetres, PositiveMetres, PositiveMetres] = (30.0, 20.0, 5.0),
    dt: PositiveSeconds = 0.1,
    horizon: PositiveCount = 1000,
    motion: MotionName = "circle",
    v_max: PositiveSpeed = 3.0,
    uwb: bool = True,
    team: TeamOptions = TeamOptions(),
    landmarks: LandmarkOptions = LandmarkOptions(),
    mapping: MapOptions = MapOptions(),
    ranges: UavRangeOptions = UavRangeOptions(),
    anchors: AnchorOptions = AnchorOptions(),
    tags: TagOptions = TagOptions(),
    tdoa: TdoaOptions = TdoaOptions(),
    angles: AngleOptions = AngleOptions(),
    gnss: GnssOptions = GnssOptions(),
    flow: FlowOptions = FlowOptions(),
    barometer: BarometerOptions = BarometerOptions(),
    compass: CompassOptions = CompassOptions(),
    light: LightOptions = LightOptions(),
    rssi: RssiOptions = RssiOptions(),
    ultrasonic: UltrasonicOptions = UltrasonicOptions(),
    magnetic: MagneticOptions = MagneticOptions(),
    imu: SimulatedImuOptions = SimulatedImuOptions(),
    network: WalledNetworkOptions = WalledNetworkOptions(),
    sight: SightOptions = SightOptions(),
    gusts: GustOptions = GustOptions(),
    kidnap: KidnapOptions = KidnapOptions(),
    control: ControlOptions = ControlOptions(),
    prior: AttitudePriorOptions = AttitudePriorOptions(),
) -> Scenario:
    """UAVs in a room, with an IMU, landmarks seen as body-frame vectors, and UWB between all UAVs.

    ``room``: its sides; ``dt`` s and ``horizon`` steps; ``v_max``: the top speed where the team's
    commands steer; ``uwb=false`` leaves out the ranges between UAVs.

    Steered UAVs stop at walls, and those of ``motion=random`` circle where none is in their way;
    other motions follow their paths through walls as if there were doors.
    """
    if anchors.nlos_anchor is not None and not anchors.anchors:
        raise ValueError(f"nlos_anchor={anchors.nlos_anchor} is not allowed: there are no anchors")
    if anchors.biased_anchors and not anchors.anchors:
        raise ValueError(
            f"biased_anchors={anchors.biased_anchors} is not allowed: there are no anchors"
        )
    if landmarks.association == "unknown" and not mapping.landmarks_known:
        raise ValueError("association=unknown is not allowed with landmarks_known=false")
    arena = Arena(3, team.n_uavs, dt, (0.0, 0.0, 0.0), room)
    radio = network.network(wall_loss=math.inf if sight.wall_delay == math.inf else 0.0)
    inside, path = sight.sight(radio.walls), gusts.of(_around(MOTIONS[motion], radio.walls))
    if gusts.gust_std and control.control != "none":
        raise ValueError(f"gust_std={gusts.gust_std} is not allowed with control")
    true: list[Sensor] = []
    believed: list[Sensor] = []
    process: Process = ConstantVelocity(accel_std=0.1)
    if imu.imu:
        true.append(imu.true)
        believed.append(imu.believed)
        process = Inertial(imu.accel_bias, imu.gyro_bias) if imu.estimated else Inertial()
    seen = landmarks.named if mapping.landmarks_known else mapping.of
    true += seen(landmarks.behind(inside))
    believed += seen(landmarks.believed)
    arms = tags.arms(team.n_uavs)
    if uwb:
        true.append(Ranging(ranges.true, arms, ranges.uwb_delay, sight=inside))
        believed.append(Ranging(ranges.believed, arms, ranges.uwb_delay))
    if anchors.anchors:
        true.append(replace(anchors.true(room, ranges.true, arms), sight=inside))
        believed.append(anchors.believed(room, ranges.believed, arms))
    true += tdoa.true(room, arms)
    believed += tdoa.believed(room, arms)
    others = (*angles.true, *gnss.true(team.n_uavs), *flow.true, *barometer.true)
    senses = (*compass.true, *light.true(room, inside), *magnetic.true(room))
    others += (*senses, *signal_strengths(rssi, room, radio.walls))
    others += ultrasonic.true(room, radio.walls)
    true += others
    believed += others
    return Scenario(
        name="indoor-v0",
        arena=arena,
        horizon=horizon,
        motion=control.of(kidnap.of(path, dt), v_max, radio.walls),
        sensors=tuple(true),
        network=radio,
        prior=prior.with_attitude(),
        process=process,
        believed_sensors=tuple(believed),
        failure_rate=team.failure_rate,
        reward=team.reward,
    )


def _around(motion: Motion, walls: tuple[Box, ...]) -> Motion:
    """The motion, which keeps clear of walls if it can."""
    return replace(motion, walls=walls) if isinstance(motion, RandomCircles) else motion
