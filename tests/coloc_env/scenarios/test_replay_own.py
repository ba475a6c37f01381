"""``replay-v0``: a folder of one's own in the open format, with truth and without."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents import make
from coloc_env import make_scenario
from coloc_env.datasets.open_format import write_recording
from coloc_env.datasets.recording import Recording, Table, Track
from coloc_env.world import World
from training.evaluation.evaluate import evaluate
from training.evaluation.tables import markdown

RATE = 20


def wheeled_team(truth: bool = True, seed: int = 0) -> Recording:
    """Two robots on circles for 12 s: odometry, ranges to four anchors (too long by 0.1 m, stamped
    0.15 s late) and to each other."""
    rng = np.random.default_rng(seed)
    anchors = np.array([[-4.0, -4], [4, -4], [4, 4], [-4, 4.0]])
    time = (np.arange(12 * RATE) * (1_000_000_000 // RATE)).astype(np.int64)

    def place(robot: int, at: np.ndarray) -> np.ndarray:
        angle = 0.5 * at * 1e-9 + np.pi * robot
        return 2 * np.stack((np.cos(angle), np.sin(angle)), 1)

    tracks, odometry, to_anchors, to_robots = [], [], [], []
    for robot in (0, 1):
        heading = 0.5 * time * 1e-9 + np.pi * robot + np.pi / 2
        tracks.append(Track(time, place(robot, time), heading[:, None]))
        read = np.tile((1.0, 0.5), (len(time), 1)) + rng.normal(size=(len(time), 2)) * 0.01
        odometry.append(Table(time, read, ("v", "omega")))
        stamps, which = time[5:], np.arange(len(time) - 5) % 4
        measured = place(robot, stamps - 150_000_000) - anchors[which]
        distance = np.linalg.norm(measured, axis=1) + 0.1 + rng.normal(size=len(stamps)) * 0.05
        values = np.column_stack((np.zeros(len(stamps)), which, distance))
        to_anchors.append(Table(stamps, values, ("own_tag", "anchor", "range")))
        noise = np.random.default_rng(seed + 9).normal(size=len(time)) * 0.05
        apart = np.linalg.norm(place(0, time) - place(1, time), axis=1) + noise
        other, zero = np.full(len(time), 1.0 - robot), np.zeros(len(time))
        values = np.column_stack((zero, other, zero, apart))[::4]
        to_robots.append(Table(time[::4], values, ("own_tag", "robot", "tag", "range")))
    start = np.stack([np.append(place(i, time[:1])[0], np.pi / 2 + np.pi * i) for i in (0, 1)])
    return Recording(
        name="circles",
        dim=2,
        robots=("ann", "bob"),
        truth=tuple(tracks) if truth else (Track.unknown(2), Track.unknown(2)),
        streams={
            "odometry": tuple(odometry),
            "anchor_ranges": tuple(to_anchors),
            "uav_ranges": tuple(to_robots),
        },
        landmarks=np.empty((0, 2)),
        anchors=anchors,
        tags=np.empty((2, 0, 2)),
        source="made",
        start=np.empty((0, 0)) if truth else start,
    )


BELIEVED = """
anchor_ranges: {std: 0.1, bias: 0.1, delay: 0.15}
uav_ranges: {std: 0.1}
odometry: {forward_std: 0.03, turn_std: 0.03}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_recording(wheeled_team(), tmp_path / "circles")
    (tmp_path / "believed.yaml").write_text(BELIEVED)
    return tmp_path


def rmse(path: Path, **options: Any) -> float:
    scenario = make_scenario("replay-v0", path=str(path), **options)
    found = evaluate(scenario, ["ekf"], runs=1, bound=False).summary["agents"]["ekf"]["rmse"]
    return float(found)


def test_what_is_believed_is_used(folder: Path) -> None:
    plain = rmse(folder / "circles")
    better = rmse(folder / "circles", believed=str(folder / "believed.yaml"))
    assert better < 0.6 * plain
    assert better < 0.1


@pytest.mark.parametrize("text", ["position_fix: {bias: 1.0}", "landmark_vectors: {bias: 1.0}"])
def test_a_belief_that_would_be_ignored_is_refused(text: str, folder: Path) -> None:
    (folder / "believed.yaml").write_text(text + "\n")
    with pytest.raises(ValueError, match="bias"):
        rmse(folder / "circles", believed=str(folder / "believed.yaml"))


def test_a_recordings_own_belief_is_the_default(folder: Path) -> None:
    given = rmse(folder / "circles", believed=str(folder / "believed.yaml"))
    own = folder / "circles" / "recording.yaml"
    inner = "".join(f"  {line}\n" for line in BELIEVED.strip().splitlines())
    own.write_text(own.read_text() + "believed:\n" + inner)
    assert rmse(folder / "circles") == given


def test_without_truth_everything_runs(tmp_path: Path) -> None:
    write_recording(wheeled_team(truth=False), tmp_path / "blind")
    (tmp_path / "believed.yaml").write_text(BELIEVED)
    chosen = {"path": str(tmp_path / "blind"), "believed": str(tmp_path / "believed.yaml")}
    scenario = make_scenario("replay-v0", **chosen)
    world = World(scenario)
    localizer = make("ekf", scenario)
    belief = localizer.reset(world.reset(0))
    belief, estimate = localizer.step(belief, world.observation())
    step = world.step(estimate.action())
    assert not step.scored.any()
    assert not step.reward.any()
    found = evaluate(scenario, ["ekf", "ekf:cooperate=false", "pf500"], runs=1)
    figures = found.summary["agents"]["ekf"]
    assert found.bound is None
    assert figures["rmse"] is None
    own = figures["diagnostics"]
    assert 0.15 < own["nis_anchor_ranging"] < 0.6  # σ is 0.05, believed 0.1
    assert abs(own["whiteness_anchor_ranging"]) < 0.5
    assert own["rejected_anchor_ranging"] < 0.01
    assert 0 < own["predicted_std"] < 0.2
    assert 0 < own["disagreement"] < 0.2
    text = markdown(found)
    assert "Without ground truth" in text
    assert "| ekf | anchor_ranging |" in text


def test_a_false_belief_shows_without_truth(tmp_path: Path) -> None:
    """Ranges three times as noisy as believed: NIS is far beyond its band."""
    write_recording(wheeled_team(truth=False), tmp_path / "blind")
    (tmp_path / "believed.yaml").write_text("anchor_ranges: {std: 0.02, bias: 0.1, delay: 0.15}\n")
    chosen = {"path": str(tmp_path / "blind"), "believed": str(tmp_path / "believed.yaml")}
    found = evaluate(make_scenario("replay-v0", **chosen), ["ekf"], runs=1)
    own = found.summary["agents"]["ekf"]["diagnostics"]
    assert own["nis_anchor_ranging"] > 1.5 * own["nis_anchor_ranging_high"]


def test_marked_points_are_scored(tmp_path: Path) -> None:
    home = tmp_path / "blind"
    write_recording(wheeled_team(truth=False), home)
    true = wheeled_team().truth[0]
    rows = [f"{true.time[k]},ann,{true.position[k, 0]},{true.position[k, 1]}" for k in (100, 200)]
    (home / "points.csv").write_text("\n".join(("stamp,robot,x,y", *rows)) + "\n")
    scenario = make_scenario("replay-v0", path=str(home))
    found = evaluate(scenario, ["ekf"], runs=1, bound=False)
    assert found.worlds.scored.sum() == 2
    assert found.summary["agents"]["ekf"]["rmse"] < 0.3


def test_streams_that_nobody_uses_are_named(tmp_path: Path) -> None:
    write_recording(wheeled_team(), tmp_path / "circles")
    with pytest.warns(UserWarning, match="does not use odometry"):
        make_scenario("replay-v0", path=str(tmp_path / "circles"), process="constant_velocity")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "path=none is not allowed: the folder of a recording is needed"),
        ({"path": "/nowhere"}, "/nowhere: no such folder"),
        ({"process": "inertial"}, "process=inertial needs imu of every robot in 3 dim"),
        ({"believed": "anchor_range: {}"}, "unknown entry 'anchor_range' .did you mean 'anchor_ra"),
        (
            {"believed": "anchor_ranges: {std: -1}"},
            "line 1: anchor_ranges.std: -1 is not 0 or more",
        ),
        ({"believed": "anchor_ranges: {links: {a/b: {}}}"}, "unknown link 'a/b'"),
        ({"believed": "anchors: {x: [0, 0]}"}, "unknown anchor 'x'"),
        ({"believed": "anchors: {anchor_0: [0]}"}, "is not 2 finite numbers"),
        ({"span": (20.0, 30.0)}, "span=.* is not allowed"),
    ],
)
def test_what_is_refused(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    write_recording(wheeled_team(), tmp_path / "circles")
    if options:
        options = {"path": str(tmp_path / "circles"), **options}
    if "believed" in options:
        (tmp_path / "b.yaml").write_text(options["believed"])
        options["believed"] = str(tmp_path / "b.yaml")
    with pytest.raises(ValueError, match=words) as caught:
        make_scenario("replay-v0", **options)
    assert str(caught.value).startswith("replay-v0: ")
    assert "\n" not in str(caught.value)


def test_three_dimensions_with_imu_run_without_truth(tmp_path: Path) -> None:
    """At rest, with an IMU that shows gravity askew: the start is levelled by it."""
    time = (np.arange(600) * 10_000_000).astype(np.int64)
    tilt = np.array((0.0, np.sin(0.2), np.cos(0.2))) * 9.80665
    imu = Table(time, np.tile((0.0, 0, 0, *tilt), (600, 1)), tuple("abcdef"))
    anchors = np.array([[0.0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 3.0]])
    place = np.array((1.0, 2.0, 1.0))
    which = np.arange(60) % 4
    distance = np.linalg.norm(place - anchors[which], axis=1)
    values = np.column_stack((np.zeros(60), which, distance))
    ranges = Table(time[::10], values, ("own_tag", "anchor", "range"))
    made = Recording(
        name="still",
        dim=3,
        robots=("a",),
        truth=(Track.unknown(3),),
        streams={
            "imu": (
                Table(
                    time, imu.values, tuple(f"{s}_{x}" for s in ("gyro", "accel") for x in "xyz")
                ),
            ),
            "anchor_ranges": (ranges,),
        },
        landmarks=np.empty((0, 3)),
        anchors=anchors,
        tags=np.empty((1, 0, 3)),
        source="made",
        start=np.array([[*place, *[np.nan] * 4]]),
    )
    write_recording(made, tmp_path / "still")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenario = make_scenario("replay-v0", path=str(tmp_path / "still"), dt=0.05)
    attitude = World(scenario).reset(0)["prior"]
    assert attitude.isfinite().all()
    motion = scenario.motion
    up = torch.tensor((0.0, np.sin(0.2), np.cos(0.2)), dtype=torch.float64)
    from coloc_env.geometry import rotate

    shown = rotate(motion.attitude.values[0, 0], up)  # type: ignore[attr-defined]
    torch.testing.assert_close(shown, shown.new_tensor((0.0, 0.0, 1.0)))
