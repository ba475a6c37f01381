"""``replay-hanyang-v0``: a tag in the plane among four anchors that stand together (Hanyang)."""

from dataclasses import replace as replaced

from coloc_env.options import Metres, Seconds, WhiteAcceleration
from coloc_env.scenario import ConstantVelocity, PriorOptions, Reward, Scenario
from coloc_env.scenarios.parts.replays import BiasOptions, ReplayOptions
from coloc_env.scenarios.parts.tag_replays import anchor_scenario, corrected, ranging_grid


def replay_hanyang(
    *,
    range_delay: Seconds = 0.18,
    range_std: Metres = 0.2,
    velocity_accel_std: WhiteAcceleration = 0.5,
    reward: Reward = "error",
    replay: ReplayOptions = ReplayOptions(),
    biases: BiasOptions = BiasOptions(),
    prior: PriorOptions = PriorOptions(prior_std=1.0, max_speed=1.5),
) -> Scenario:
    """A tag on the ground for 3 to 5 min, up to 50 m from four anchors within 5 m of each other
    (Hanyang University): ranges alone. Nothing is simulated but the prior's draw.

    One range in 200 is too short by 1 to 19 m. Biases are believed to be of the size that medians
    over 10 s of residuals at the truth have on LOS/Trajectory_B/Case_3 (0.097 m RMS).

    Ranges are taken to be ``range_delay`` s older than their stamps, and delivered at once: a step
    has those of the last 0.1 s by that clock (0 uses them as they are stamped). The noise settings
    were chosen on LOS/Trajectory_B/Case_3, the delay is the same in all cases. On the others the
    Huber EKF is off by 0.80, 0.79 and 0.40 m RMS (LOS A, NLOS A, NLOS B), the plain EKF, which
    believes every range, by 1.9, 6.7 and 2.0. Every fifth step has no truth within 50 ms and is not
    scored.
    """
    recording = corrected(replay.load("hanyang"), range_delay, 0.0)
    grid = ranging_grid(recording, replay, margin=0.04)
    start, model = prior.at_start(0.1, 0.2), ConstantVelocity(velocity_accel_std)
    noise = biases.noise(range_std)
    built = anchor_scenario("replay-hanyang-v0", recording, grid, start, model, noise, reward)
    return replaced(built, tuned_on=("LOS/Trajectory_B/Case_3",))
