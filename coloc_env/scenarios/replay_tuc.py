"""``replay-tuc-v0``: one wheeled robot among four anchors in the plane (TU Chemnitz)."""

from dataclasses import replace as replaced
from typing import Literal

from coloc_env.options import AngularRate, Coordinate, Metres, Speed, WhiteAcceleration
from coloc_env.scenario import ConstantVelocity, PriorOptions, Process, Reward, Scenario, Wheeled
from coloc_env.scenarios.parts.replays import BiasOptions, ReplayOptions
from coloc_env.scenarios.parts.tag_replays import anchor_scenario, corrected, ranging_grid
from coloc_env.sensors import Odometry


def replay_tuc(
    *,
    process: Literal["wheeled", "constant_velocity"] = "wheeled",
    range_std: Metres = 0.15,
    range_bias: Coordinate = 0.11,
    velocity_accel_std: WhiteAcceleration = 0.5,
    forward_std: Speed = 0.05,
    turn_std: AngularRate = 0.2,
    reward: Reward = "error",
    replay: ReplayOptions = ReplayOptions(dt=0.128),
    biases: BiasOptions = BiasOptions(),
    prior: PriorOptions = PriorOptions(prior_std=0.5, max_speed=0.5),
) -> Scenario:
    """A wheeled robot for 30 s in a square of 2.4 m among four anchors (TU Chemnitz "Labyrinth"):
    odometry and one range a step. Nothing is simulated but the prior's draw.

    ``process="constant_velocity"`` leaves the odometry out: velocity driven by
    ``velocity_accel_std``. ``range_bias`` (m) is taken off every range. It and the noise settings
    were chosen on the first 15 s. On the rest the EKF is off by 0.099 m RMS (Huber 0.090), without
    odometry by 0.150 (0.144), without taking the bias off by 0.189 and 0.241. Biases that last are
    believed to be those of ``replay-hanyang-v0``. Stamps drift against
    the steps: from 23 s on a range is delivered 0.08 s, from 25 s on 0.05 s after it was measured,
    and a few of the last steps have no truth near enough to be scored.
    """
    recording = corrected(replay.load("tuc"), 0.0, range_bias)
    grid = ranging_grid(recording, replay, margin=0.001)
    model: Process = ConstantVelocity(velocity_accel_std)
    odometry = None
    if process == "wheeled":
        model, odometry = Wheeled(), Odometry(forward_std, 0.5 * forward_std, turn_std)
    start = prior.at_start(0.1, 0.2)
    noise = biases.noise(range_std)
    built = anchor_scenario("replay-tuc-v0", recording, grid, start, model, noise, reward, odometry)
    return replaced(built, tuned_on=("Indoor_UWB",))  # its first 15 s
