"""``replay-euroc-v0``: real flights of one vehicle in one room "together" (EuRoC)."""

from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.replay import (
    arena_of,
    recorded_imu,
    recorded_motion,
)
from coloc_env.network import Network
from coloc_env.scenario import Inertial, Prior, Scenario
from coloc_env.scenarios.replay import LEFT_OVER, cut, euroc_bias, loaded
from coloc_env.sensors import (
    Imu,
    Landmarks,
    RangeNoise,
    Ranging,
)


def replay_euroc(
    *,
    sequence: str | None = None,
    data: str | None = None,
    dt: float = 0.1,
    span: tuple[float, float] | None = None,
    reward: str = "error",
    prior_std: float = 2.0,
    prior: str = "gaussian",
    landmarks: int = 20,
    landmark_std: float = 0.15,
    landmark_radius: float = 10.0,
    false_matches: float = 0.0,
    landmark_dropout: float = 0.0,
    range_only: tuple[float, float] | None = None,
    uwb_std: float = 0.2,
    nlos: float = 0.0,
    nlos_bias: float = 1.0,
    accel_std: float = 0.05,
    gyro_std: float = 0.003,
    estimate_bias: bool = True,
) -> Scenario:
    """Three real flights of one vehicle in one room "together" (EuRoC V1): IMU, biases and motion
    are real, UWB and landmarks simulated as in ``indoor-v0``.

    The IMU's bias is calibrated on a flight in another room (MH_04, for the MH flights V1_03), what
    is left of it is estimated unless ``estimate_bias=false``.
    """
    if landmarks < 0:
        raise ValueError(f"landmarks={landmarks} is not allowed: a count ≥ 0")
    recording = loaded("euroc", sequence, data)
    grid = cut(common_grid(recording, dt, ("imu",)), span)
    imu = Imu(accel_std, gyro_std)
    uwb = Ranging(RangeNoise(std=uwb_std, nlos=nlos, nlos_bias=nlos_bias))
    sensors = [recorded_imu(recording, grid, imu, euroc_bias(recording)), uwb]
    believed = [imu, Ranging(RangeNoise(std=uwb_std))]
    if landmarks:
        sensors.append(
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
    process = LEFT_OVER if estimate_bias else Inertial()
    return Scenario(
        name="replay-euroc-v0",
        arena=arena_of(recording, grid, margin=1.5),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=tuple(sensors),
        network=Network(),
        prior=Prior(position_std=prior_std, kind=prior),
        process=process,
        believed_sensors=tuple(believed),
        reward=reward,
    )
