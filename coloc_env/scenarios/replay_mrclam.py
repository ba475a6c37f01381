"""``replay-mrclam-v0``: five ground robots among landmarks (UTIAS MRCLAM)."""

from dataclasses import replace

from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.replay import (
    arena_of,
    recorded_bearings,
    recorded_motion,
    recorded_odometry,
)
from coloc_env.network import Network
from coloc_env.options import (
    AngularRate,
    Factor,
    Metres,
    PositiveSeconds,
    Radians,
    Ratio,
    Seconds,
    Speed,
)
from coloc_env.scenario import PriorOptions, Reward, Scenario, Wheeled
from coloc_env.scenarios.parts.replays import ReplayOptions
from coloc_env.sensors import (
    LandmarkBearings,
    Odometry,
    UavBearings,
)

_HELD = 1.1  # s, for which a command stands: it is repeated at least every 1.03 s


def replay_mrclam(
    *,
    forward_std: Speed = 0.03,
    turn_std: AngularRate = 0.1,
    odometry_relative: Ratio = 0.2,
    odometry_delay: Seconds = 0.0,
    odometry_scale: Factor = 1.0,
    range_std: Metres = 0.2,
    bearing_std: Radians = 0.04,
    sighting_bias: Ratio = 1.0,
    bias_time: PositiveSeconds = 100.0,
    reward: Reward = "error",
    replay: ReplayOptions = ReplayOptions(),
    prior: PriorOptions = PriorOptions(prior_std=0.1),
) -> Scenario:
    """Five ground robots for 756 s: odometry, range and bearing to 15 landmarks and to each other
    (UTIAS MRCLAM). Nothing is simulated but the prior's draw.

    Odometry is the commanded velocity, used as it is; ``odometry_delay=0.25`` (s) and
    ``odometry_scale=0.93`` correct what the first 250 s show of it. The noise settings are the
    team's belief, chosen on those 250 s. Sightings are believed to have biases ``sighting_bias``
    times as large as their noise, over ``bias_time`` s (ranges, in those 250 s: 0.15 m RMS over
    10 s).
    """
    recording = replay.load("mrclam")
    grid = replay.cut(common_grid(recording, replay.dt, ("odometry",)))
    odometry = Odometry(forward_std, 0.5 * forward_std, turn_std, odometry_relative)
    bias = sighting_bias * range_std, sighting_bias * bearing_std
    landmarks = LandmarkBearings(
        len(recording.landmarks), range_std, bearing_std, bias_std=bias, bias_time=bias_time
    )
    robots = UavBearings(range_std, bearing_std, bias_std=bias, bias_time=bias_time)
    seen, depth = recorded_bearings(recording, grid, landmarks)
    landmarks = replace(landmarks, depth=depth)
    met, depth = recorded_bearings(recording, grid, robots)
    robots = replace(robots, depth=depth)
    return Scenario(
        name="replay-mrclam-v0",
        arena=arena_of(recording, grid, margin=1.0),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=(
            recorded_odometry(recording, grid, odometry, _HELD, odometry_delay, odometry_scale),
            replace(seen, sensor=landmarks),
            replace(met, sensor=robots),
        ),
        network=Network(),
        prior=prior.at_start(velocity_std=0.05),
        process=Wheeled(),
        believed_sensors=(odometry, landmarks, robots),
        reward=reward,
        tuned_on=("MRCLAM_Dataset6",),  # its first 250 s
    )
