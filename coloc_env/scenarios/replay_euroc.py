"""``replay-euroc-v0``: real flights of one vehicle in one room "together" (EuRoC)."""

from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.replay import arena_of, recorded_imu, recorded_motion
from coloc_env.network import Network
from coloc_env.scenario import PriorOptions, Reward, Scenario
from coloc_env.scenarios.parts.euroc import euroc_bias, euroc_process
from coloc_env.scenarios.parts.replays import ReplayOptions
from coloc_env.sensors import ImuOptions, LandmarkOptions, Ranging, UavRangeOptions


def replay_euroc(
    *,
    estimate_bias: bool = True,
    reward: Reward = "error",
    replay: ReplayOptions = ReplayOptions(),
    imu: ImuOptions = ImuOptions(gyro_std=0.003),
    landmarks: LandmarkOptions = LandmarkOptions(),
    ranges: UavRangeOptions = UavRangeOptions(),
    prior: PriorOptions = PriorOptions(),
) -> Scenario:
    """Three real flights of one vehicle in one room "together" (EuRoC V1): IMU, biases and motion
    are real, UWB and landmarks simulated as in ``indoor-v0``.

    The IMU's bias is calibrated on a flight in another room (MH_04, for the MH flights V1_03), what
    is left of it is estimated unless ``estimate_bias=false``.
    """
    recording = replay.load("euroc")
    grid = replay.cut(common_grid(recording, replay.dt, ("imu",)))
    inertial = recorded_imu(recording, grid, imu.believed, euroc_bias(recording))
    ranging = Ranging(ranges.true, latency=ranges.uwb_delay)
    assumed = Ranging(ranges.believed, latency=ranges.uwb_delay)
    return Scenario(
        name="replay-euroc-v0",
        arena=arena_of(recording, grid, margin=1.5),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=(inertial, ranging, *landmarks.true),
        network=Network(),
        prior=prior.at_start(),
        process=euroc_process(estimate_bias),
        believed_sensors=(imu.believed, assumed, *landmarks.believed),
        reward=reward,
    )
