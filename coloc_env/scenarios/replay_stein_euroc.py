"""``replay-stein-euroc-v0``: one real flight with landmarks of which some are mistaken for others
(CSPF paper, section 6)."""

from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.replay import arena_of, recorded_imu_samples, recorded_motion
from coloc_env.network import Network
from coloc_env.scenario import PriorOptions, Reward, Scenario
from coloc_env.scenarios.parts.euroc import euroc_bias, euroc_process
from coloc_env.scenarios.parts.replays import ReplayOptions
from coloc_env.sensors import ImuOptions, LandmarkOptions


def replay_stein_euroc(
    *,
    estimate_bias: bool = True,
    reward: Reward = "error",
    replay: ReplayOptions = ReplayOptions(sequence="V1_01_easy"),
    imu: ImuOptions = ImuOptions(gyro_std=0.003),
    landmarks: LandmarkOptions = LandmarkOptions(false_matches=0.1),
    prior: PriorOptions = PriorOptions(prior_std=0.5),
) -> Scenario:
    """A flight by IMU and landmarks (EuRoC): IMU, its bias and the motion are real. Landmarks at
    known places around the path are simulated as in ``indoor-v0``, some of them mistaken.

    The IMU delivers every sample (``imu_samples``, ``imu_held``) beside the mean over the step. Its
    bias is calibrated on a flight in another room, as in ``replay-euroc-v0``; what is left of it is
    estimated unless ``estimate_bias=false``.
    """
    if not landmarks.landmarks:
        raise ValueError("landmarks=0 is not allowed: at least one")
    recording = replay.load("euroc")
    grid = replay.cut(common_grid(recording, replay.dt, ("imu",)))
    inertial = recorded_imu_samples(recording, grid, imu.believed, euroc_bias(recording))
    return Scenario(
        name="replay-stein-euroc-v0",
        arena=arena_of(recording, grid, margin=1.5),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=(inertial, *landmarks.true),
        network=Network(),
        prior=prior.at_start(),
        process=euroc_process(estimate_bias),
        believed_sensors=(imu.believed, *landmarks.believed),
        reward=reward,
    )
