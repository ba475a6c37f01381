"""``indoor-v0``: six UAVs circling in a room with landmarks and UWB (PF-NN paper, section 3.1)."""

from typing import Literal

from coloc_env.motion import MOTIONS, Arena
from coloc_env.network import Network
from coloc_env.scenario import ConstantVelocity, Inertial, Prior, Process, Scenario
from coloc_env.scenarios.parts import anchor_places, blocked_anchors, kidnapped_at
from coloc_env.sensors import AnchorRanging, Imu, Landmarks, RangeNoise, Ranging, Sensor


def indoor(
    *,
    n_uavs: int = 6,
    room: tuple[float, float, float] = (30.0, 20.0, 5.0),
    dt: float = 0.1,
    horizon: int = 1000,
    motion: str = "circle",
    landmarks: int = 20,
    landmark_std: float = 0.15,
    landmark_radius: float = 10.0,
    false_matches: float = 0.0,
    landmark_dropout: float = 0.0,
    range_only: tuple[float, float] | None = None,
    uwb: bool = True,
    uwb_std: float = 0.2,
    nlos: float = 0.0,
    nlos_bias: float = 1.0,
    nlos_kind: Literal["exponential", "constant"] = "exponential",
    uwb_tail: float = 0.0,
    uwb_tail_std: float = 1.0,
    uwb_uniform: float = 0.0,
    uwb_impulse: float = 0.0,
    uwb_dropout: float = 0.0,
    uwb_delay: int = 0,
    anchors: int = 0,
    nlos_anchor: int | None = None,
    accel_std: float = 0.05,
    gyro_std: float = 0.01,
    imu: bool = True,
    imu_bias: bool = False,
    accel_bias: float = 0.1,
    gyro_bias: float = 0.01,
    comm_radius: float | None = None,
    max_neighbours: int = 16,
    message_loss: float = 0.0,
    message_delay: int = 0,
    walls: tuple[float, ...] | None = None,
    kidnap_at: float | None = None,
    kidnapped: tuple[int, ...] | None = None,
    prior: str = "gaussian",
    prior_std: float = 2.0,
    failure_rate: float = 0.0,
    reward: str = "error",
    believed_uwb_std: float | None = None,
    believed_imu_bias: bool | None = None,
) -> Scenario:
    """A room with landmarks seen as body-frame vectors, UWB between all UAVs, and an IMU.

    The team believes the Gaussian parts of the sensors: contamination (NLOS, tails, impulses, false
    matches) and, unless ``believed_imu_bias``, nothing of it. ``range_only="40:60"`` takes all
    landmarks away in those seconds; ``anchors`` puts that many UWB anchors into the room's corners
    and along its walls, every range to number ``nlos_anchor`` NLOS; ``walls`` are boxes
    ``x0,y0,z0,x1,y1,z1`` (several: one after the other) that block links; ``imu=false`` leaves a
    constant-velocity model; at ``kidnap_at`` s the UAVs of ``kidnapped`` (default: all) are put on
    the room's other side.
    """
    name = "indoor-v0"
    if motion not in MOTIONS:
        raise ValueError(f"{name}: motion={motion!r} is not allowed: one of {', '.join(MOTIONS)}")
    if landmarks < 0 or anchors < 0:
        raise ValueError(f"{name}: landmarks and anchors are counts ≥ 0")
    if nlos_anchor is not None and not anchors:
        raise ValueError(f"{name}: nlos_anchor={nlos_anchor} is not allowed: there are no anchors")
    if dt <= 0 or min(room) <= 0:
        raise ValueError(f"{name}: dt (s) and the room's sides (m) must be > 0")
    if n_uavs < 1:
        raise ValueError(f"{name}: n_uavs={n_uavs} is not allowed: at least one UAV")
    arena = Arena(3, n_uavs, dt, (0.0, 0.0, 0.0), room)
    true: list[Sensor] = []
    believed: list[Sensor] = []
    process: Process = ConstantVelocity(accel_std=0.1)
    if imu:
        biased = (accel_bias, gyro_bias) if imu_bias else (0.0, 0.0)
        true.append(Imu(accel_std, gyro_std, *biased))
        believed.append(Imu(accel_std, gyro_std))
        assumed = imu_bias if believed_imu_bias is None else believed_imu_bias
        process = Inertial(accel_bias, gyro_bias) if assumed else Inertial()
    if landmarks:
        true.append(
            Landmarks(
                landmarks,
                landmark_std,
                landmark_radius,
                false_matches,
                landmark_dropout,
                range_only,
            )
        )
        believed.append(Landmarks(landmarks, landmark_std, landmark_radius))
    error = RangeNoise(
        std=uwb_std,
        nlos=nlos,
        nlos_bias=nlos_bias,
        nlos_kind=nlos_kind,
        tail=uwb_tail,
        tail_std=uwb_tail_std,
        uniform=uwb_uniform,
        impulse=uwb_impulse,
        dropout=uwb_dropout,
    )
    assumed_error = RangeNoise(std=uwb_std if believed_uwb_std is None else believed_uwb_std)
    if uwb:
        true.append(Ranging(error, latency=uwb_delay))
        believed.append(Ranging(assumed_error, latency=uwb_delay))
    if anchors:
        places = anchor_places(anchors, room)
        true.append(AnchorRanging(places, error, blocked=blocked_anchors(nlos_anchor)))
        believed.append(AnchorRanging(places, assumed_error))
    return Scenario(
        name=name,
        arena=arena,
        horizon=horizon,
        motion=kidnapped_at(MOTIONS[motion], kidnap_at, kidnapped, dt),
        sensors=tuple(true),
        network=Network(comm_radius, _boxes(walls), message_loss, message_delay, max_neighbours),
        prior=Prior(position_std=prior_std, kind=prior),
        process=process,
        believed_sensors=tuple(believed),
        failure_rate=failure_rate,
        reward=reward,
    )


def _boxes(
    walls: tuple[float, ...] | None,
) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
    if walls is None:
        return ()
    if len(walls) % 6:
        raise ValueError(f"walls={walls} is not allowed: six numbers a box, x0,y0,z0,x1,y1,z1")
    return tuple((walls[i : i + 3], walls[i + 3 : i + 6]) for i in range(0, len(walls), 6))
