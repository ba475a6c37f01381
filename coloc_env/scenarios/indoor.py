"""``indoor-v0``: six UAVs circling in a room with landmarks and UWB (PF-NN paper, section 3.1)."""

from coloc_env.motion import MOTIONS, Arena, ControlOptions, KidnapOptions, MotionName
from coloc_env.network import WalledNetworkOptions
from coloc_env.options import PositiveCount, PositiveMetres, PositiveSeconds, PositiveSpeed
from coloc_env.scenario import (
    ConstantVelocity,
    Inertial,
    PriorOptions,
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
    Ranging,
    RssiOptions,
    Sensor,
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
    kidnap: KidnapOptions = KidnapOptions(),
    control: ControlOptions = ControlOptions(),
    prior: PriorOptions = PriorOptions(),
) -> Scenario:
    """UAVs in a room, with an IMU, landmarks seen as body-frame vectors, and UWB between all UAVs.

    ``room``: its sides; ``dt`` s and ``horizon`` steps; ``v_max``: the top speed where the team's
    commands steer; ``uwb=false`` leaves out the ranges between UAVs.
    """
    if anchors.nlos_anchor is not None and not anchors.anchors:
        raise ValueError(f"nlos_anchor={anchors.nlos_anchor} is not allowed: there are no anchors")
    arena, radio = Arena(3, team.n_uavs, dt, (0.0, 0.0, 0.0), room), network.network()
    true: list[Sensor] = []
    believed: list[Sensor] = []
    process: Process = ConstantVelocity(accel_std=0.1)
    if imu.imu:
        true.append(imu.true)
        believed.append(imu.believed)
        process = Inertial(imu.accel_bias, imu.gyro_bias) if imu.estimated else Inertial()
    true += landmarks.true
    believed += landmarks.believed
    arms = tags.arms(team.n_uavs)
    if uwb:
        true.append(Ranging(ranges.true, arms, ranges.uwb_delay))
        believed.append(Ranging(ranges.believed, arms, ranges.uwb_delay))
    if anchors.anchors:
        true.append(anchors.true(room, ranges.true, arms))
        believed.append(anchors.believed(room, ranges.believed, arms))
    true += tdoa.true(room, arms)
    believed += tdoa.believed(room, arms)
    others = (*angles.true, *gnss.true(team.n_uavs), *flow.true, *barometer.true)
    around = room, radio.walls
    senses = (*light.true(*around), *signal_strengths(rssi, *around), *ultrasonic.true(*around))
    others += (*compass.true, *senses, *magnetic.true(room))
    true += others
    believed += others
    return Scenario(
        name="indoor-v0",
        arena=arena,
        horizon=horizon,
        motion=control.of(kidnap.of(MOTIONS[motion], dt), v_max, radio.walls),
        sensors=tuple(true),
        network=radio,
        prior=prior.at_start(),
        process=process,
        believed_sensors=tuple(believed),
        failure_rate=team.failure_rate,
        reward=team.reward,
    )
