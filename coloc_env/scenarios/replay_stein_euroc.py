"""``replay-stein-euroc-v0``: one real flight with landmarks of which some are mistaken for others
(CSPF paper, section 6)."""

from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.replay import arena_of, recorded_imu_samples, recorded_motion
from coloc_env.network import Network
from coloc_env.scenario import Inertial, Prior, Scenario
from coloc_env.scenarios.replay import LEFT_OVER, cut, euroc_bias, loaded
from coloc_env.sensors import Imu, Landmarks


def replay_stein_euroc(
    *,
    sequence: str = "V1_01_easy",
    data: str | None = None,
    dt: float = 0.1,
    span: tuple[float, float] | None = None,
    reward: str = "error",
    prior_std: float = 0.5,
    landmarks: int = 20,
    landmark_std: float = 0.15,
    landmark_radius: float = 10.0,
    false_matches: float = 0.1,
    landmark_dropout: float = 0.0,
    blind: tuple[float, float] | None = None,
    accel_std: float = 0.05,
    gyro_std: float = 0.003,
    estimate_bias: bool = True,
) -> Scenario:
    """A flight by IMU and landmarks (EuRoC): IMU, its bias and the motion are real. Landmarks at
    known places around the path are simulated as in ``indoor-v0``, seen as position vectors, of
    which ``false_matches`` belong to another landmark; in ``blind`` (from, to, in s) none is seen.

    The IMU is told whole: every sample (``imu_samples``, ``imu_held``) beside the mean over the
    step. Its bias is calibrated on a flight in another room, as in ``replay-euroc-v0``; what is
    left of it is estimated unless ``estimate_bias=false``.
    """
    if landmarks < 1:
        raise ValueError(f"landmarks={landmarks} is not allowed: at least one")
    recording = loaded("euroc", sequence, data)
    grid = cut(common_grid(recording, dt, ("imu",)), span)
    imu = Imu(accel_std, gyro_std)
    shown = Landmarks(
        landmarks, landmark_std, landmark_radius, false_matches, landmark_dropout, blind
    )
    return Scenario(
        name="replay-stein-euroc-v0",
        arena=arena_of(recording, grid, margin=1.5),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=(recorded_imu_samples(recording, grid, imu, euroc_bias(recording)), shown),
        network=Network(),
        prior=Prior(position_std=prior_std),
        process=LEFT_OVER if estimate_bias else Inertial(),
        believed_sensors=(imu, Landmarks(landmarks, landmark_std, landmark_radius)),
        reward=reward,
    )
