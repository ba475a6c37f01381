"""``replay-tiers-v0``: a recording of a team in the plane with ranges between its robots alone."""

from typing import Literal

from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.pairs import calibrated_pairs, ordered
from coloc_env.datasets.replay import arena_of, recorded_motion, recorded_ranges
from coloc_env.network import Network
from coloc_env.options import Metres, PositiveCount, Seconds, WhiteAcceleration
from coloc_env.scenario import ConstantVelocity, InsDriven, PriorOptions, Process, Reward, Scenario
from coloc_env.scenarios.parts.replays import BiasOptions, ReplayOptions
from coloc_env.sensors import InsOptions, PositionFix, Ranging, Sensor


def replay_tiers(
    *,
    anchor_robots: tuple[PositiveCount, ...] = (5, 1),
    anchor_std: Metres = 0.01,
    process: Literal["ins", "constant_velocity"] = "ins",
    velocity_accel_std: WhiteAcceleration = 0.1,
    range_std: Metres = 0.2,
    held: bool = False,
    calibrated: bool = True,
    calibration: Seconds = 60.0,
    reward: Reward = "error",
    replay: ReplayOptions = ReplayOptions(dt=0.138),
    biases: BiasOptions = BiasOptions(),
    ins: InsOptions = InsOptions(ins_std=0.05, ins_bias=0.01),
    prior: PriorOptions = PriorOptions(prior_std=0.5),
) -> Scenario:
    """Four ground robots for 208 s within 5 m, three of which drive circles (TIERS, Turku): the six
    ranges between them. Ranges and motion are real; velocities, fixes of the anchor robots and
    the prior's draw are **simulated**.

    The recording has no odometry. Each robot has its velocity in the room's frame, the true one
    with noise and bias, about a tenth of the 0.15 to 0.2 m/s that they drive: a wheeled robot's
    odometry with a compass. ``process="constant_velocity"`` does without: velocity driven by
    ``velocity_accel_std``.

    ``anchor_robots``: numbers of the robots that know where they are (to ``anchor_std`` m per axis,
    also simulated), come first and are not scored. Ranges alone never show where a team is, how it
    is turned and which of two mirror images it is. Two anchors, robot 5, which stands still, and
    another, settle the first two; the last is settled by the prior, and by robots with known
    velocities that drive curves. With one anchor the turn, too, shows only in how robots move, and
    range errors of this recording's kind, which last, hide it (on its first 60 s the joint EKF is
    off by 0.50 m RMS with one anchor, by 0.13 with two). With three anchors one place
    fits best, but methods with a prior that is metres off may settle on the other side of them.

    ``calibrated``: each pair's ranges are made shorter by their median error in the recording's
    first ``calibration`` s, by OptiTrack, whatever ``span`` is replayed; not ``calibrated``, they
    are 0.19 to 0.49 m too long. ``held``: ranges that repeat the one before are delivered too.
    Biases are believed to be those of ``replay-hanyang-v0``.
    Calibration and ``range_std`` were chosen on the first 60 s: ``span=60:208`` is what nothing was
    fitted on.
    """
    recording = replay.load("tiers", held=held)
    known = [int(robot.removeprefix("turtle")) for robot in recording.robots]
    distinct = len(set(anchor_robots)) == len(anchor_robots)
    if not (distinct and set(anchor_robots) < set(known)):
        raise ValueError(
            f"anchor_robots={anchor_robots} is not allowed: some, not all, of "
            f"{', '.join(map(str, known))}"
        )
    if calibrated:
        recording = calibrated_pairs(recording, calibration)
    first = [known.index(robot) for robot in anchor_robots]
    rest = [robot for robot in range(len(known)) if robot not in first]
    recording = ordered(recording, first + rest)
    grid = replay.cut(common_grid(recording, replay.dt, ()))
    own: tuple[Sensor, ...] = ()
    if anchor_robots:
        own = (PositionFix(anchor_std, len(anchor_robots)),)
    model: Process = ConstantVelocity(velocity_accel_std)
    if process == "ins":
        model = InsDriven()
        own = (ins.sensor, *own)
    ranging = Ranging(biases.noise(range_std))
    return Scenario(
        name="replay-tiers-v0",
        arena=arena_of(recording, grid, margin=1.0),
        horizon=grid.count - 1,
        motion=recorded_motion(recording, grid),
        sensors=(*own, recorded_ranges(recording, grid, ranging)),
        network=Network(),
        prior=prior.at_start(velocity_std=0.1, attitude_std=0.1),
        process=model,
        believed_sensors=(*own, ranging),
        reward=reward,
        anchor_uavs=len(anchor_robots),
        tuned_on=("4robots_data_01",),  # its first 60 s
    )
