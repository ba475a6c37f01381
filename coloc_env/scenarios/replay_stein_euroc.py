"""``replay-stein-euroc-v0``: one real flight with landmarks of which some are mistaken for others
(CSPF paper, section 6); ``replay-stein-euroc-team-v0``: several, with poses of each other."""

from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.replay import arena_of, recorded_imu_samples, recorded_motion
from coloc_env.network import Network, NetworkOptions
from coloc_env.options import PositiveSpeed
from coloc_env.scenario import Prior, PriorOptions, Reward, Scenario
from coloc_env.scenarios.parts.euroc import euroc_bias, euroc_process
from coloc_env.scenarios.parts.replays import ReplayOptions
from coloc_env.sensors import ImuOptions, LandmarkOptions, Reference, RelativePoseOptions


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


def replay_stein_euroc_team(
    *,
    estimate_bias: bool = True,
    top_speed: PositiveSpeed = 2.0,
    reward: Reward = "error",
    replay: ReplayOptions = ReplayOptions(),
    imu: ImuOptions = ImuOptions(gyro_std=0.003),
    relative_poses: RelativePoseOptions = RelativePoseOptions(),
    network: NetworkOptions = NetworkOptions(),
) -> Scenario:
    """Real flights of one vehicle in one room "together" (EuRoC, V1: three) that know nothing of
    where they start: IMUs, biases and motion are real; random pairs measure their relative poses as
    in ``stein3d-v0``, some of them wrong, which is simulated.

    IMUs and their biases are as in ``replay-stein-euroc-v0``; ``estimate_bias=false``: the team
    believes that none is left. ``top_speed`` (m/s): what it believes of each component of a
    velocity at the start. Poses are relative to UAV 0's, which is the leaf ``reference`` and is not
    scored.
    """
    recording = replay.load("euroc")
    grid = replay.cut(common_grid(recording, replay.dt, ("imu",)))
    inertial = recorded_imu_samples(recording, grid, imu.believed, euroc_bias(recording))
    uavs = len(recording.robots)
    return Scenario(
        name="replay-stein-euroc-team-v0",
        arena=arena_of(recording, grid, margin=1.5),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=(inertial, relative_poses.true, Reference()),
        network=network.network(max_neighbours=max(16, uavs)),
        prior=Prior(kind="uniform", attitude_std=3.0, max_speed=top_speed),
        process=euroc_process(estimate_bias),
        believed_sensors=(imu.believed, relative_poses.believed, Reference()),
        reward=reward,
        anchor_uavs=min(1, uavs - 1),
    )
