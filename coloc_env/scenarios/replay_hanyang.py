"""``replay-hanyang-v0``: a tag in the plane among four anchors that stand together (Hanyang)."""

from coloc_env.scenario import ConstantVelocity, Prior, Scenario
from coloc_env.scenarios.replay import loaded
from coloc_env.scenarios.replay_anchors import anchor_scenario, corrected, ranging_grid


def replay_hanyang(
    *,
    sequence: str | None = None,
    data: str | None = None,
    dt: float = 0.1,
    span: tuple[float, float] | None = None,
    reward: str = "error",
    prior_std: float = 1.0,
    prior: str = "gaussian",
    max_speed: float = 1.5,
    range_delay: float = 0.18,
    range_std: float = 0.2,
    velocity_accel_std: float = 0.5,
) -> Scenario:
    """A tag on the ground for 3 to 5 min, up to 50 m from four anchors within 5 m of each other
    (Hanyang University): ranges, one in 200 too short by 1 to 19 m. Nothing is simulated but the
    prior's draw.

    Ranges are taken to be ``range_delay`` s older than their stamps, and delivered at once: a step
    has those of the last 0.1 s by that clock (0 uses them as they are stamped). The noise settings
    were chosen on LOS/Trajectory_B/Case_3, the delay is the same in all cases. On the others the
    Huber EKF is off by 0.80, 0.79 and 0.40 m RMS (LOS A, NLOS A, NLOS B), the plain EKF, which
    believes every range, by 1.9, 6.7 and 2.0. Every fifth step has no truth within 50 ms and is not
    scored.
    """
    if range_delay < 0:
        raise ValueError("range_delay is a time in s ≥ 0")
    recording = corrected(loaded("hanyang", sequence, data), range_delay, 0.0)
    grid = ranging_grid(recording, dt, span, margin=0.04)
    told = Prior(prior_std, 0.1, 0.2, prior, max_speed if prior == "uniform" else None)
    model = ConstantVelocity(velocity_accel_std)
    return anchor_scenario("replay-hanyang-v0", recording, grid, told, model, range_std, reward)
