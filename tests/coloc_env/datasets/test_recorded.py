"""The recordings themselves: every stream against the truth, so that frames and clocks are right.

The bounds are loose around what was measured; the loaders' docstrings state the figures.
"""

import csv
import os
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from coloc_env.datasets import DataError, Recording, Table, Track, data_root, load
from coloc_env.datasets.recording import Flags, Floats, Stamps

SECOND = 1_000_000_000
GRAVITY = np.array([0.0, 0.0, 9.81])


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLOC_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def recorded(name: str, sequence: str, **options: str) -> Recording:
    """The recording; where it is missing the test is skipped, but not in CI."""
    try:
        return load(name, sequence, **options)
    except DataError as error:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(error))


def at(stamps: Stamps, values: Floats, when: Stamps) -> Floats:
    """Linear interpolation [W, F]."""
    return np.stack([np.interp(when, stamps, column) for column in values.T], -1)


def within(track: Track, when: Stamps) -> Flags:
    """Which stamps lie on the track, not in one of its gaps."""
    after = np.clip(np.searchsorted(track.time, when), 1, len(track.time) - 1)
    inside = (when >= track.time[0]) & (when <= track.time[-1])
    return inside & (track.time[after] - track.time[after - 1] < SECOND // 10)


def turns(track: Track, when: Stamps) -> Rotation:
    return Rotation.from_quat(at(track.time, track.attitude, when), scalar_first=True)


def mean_rate(table: Table, when: Stamps, span: int) -> Floats:
    """What an imu table integrates to over ``span`` ns after each stamp, per second [W, 6]."""
    total = cumulative_trapezoid(table.values, table.time / SECOND, axis=0, initial=0)
    return (at(table.time, total, when + span) - at(table.time, total, when)) / (span / SECOND)


def turn_rate(track: Track, when: Stamps, span: int) -> Floats:
    """Mean angular velocity of the truth in the body over ``span`` ns [W, 3]."""
    between = turns(track, when).inv() * turns(track, when + span)
    return between.as_rotvec() / (span / SECOND)


def spread(errors: Floats) -> tuple[Floats, Floats]:
    """Median and robust standard deviation along the first axis."""
    middle = np.median(errors, axis=0)
    return middle, 1.4826 * np.median(np.abs(errors - middle), axis=0)


@pytest.fixture(scope="module")
def mrclam() -> Recording:
    return recorded("mrclam", "MRCLAM_Dataset6")


@pytest.fixture(scope="module")
def euroc() -> Recording:
    return recorded("euroc", "V1_01_easy,V1_02_medium,V1_03_difficult")


@pytest.fixture(scope="module")
def miluv() -> Recording:
    return recorded("miluv", "cirObstacles_3_random_0")


@pytest.mark.usefixtures("mrclam")
def test_parsing_is_done_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The second time a recording comes from the cache: its text files are not read."""
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path))
    first = recorded("mrclam", "MRCLAM_Dataset6")
    opened: list[str] = []
    plain = Path.read_bytes

    def noted(path: Path) -> bytes:
        opened.append(path.suffix)
        return plain(path)

    monkeypatch.setattr(Path, "read_bytes", noted)
    again = recorded("mrclam", "MRCLAM_Dataset6")
    assert ".dat" not in opened
    assert again.truth[0].time.tolist() == first.truth[0].time.tolist()


def test_mrclam_counts(mrclam: Recording) -> None:
    assert (len(mrclam.robots), len(mrclam.landmarks)) == (5, 15)
    seen = zip(mrclam.streams["landmark_bearings"], mrclam.streams["uav_bearings"], strict=True)
    kept = [len(landmarks.time) + len(uavs.time) for landmarks, uavs in seen]
    assert kept == [1942 - 1, 4031, 5627 - 2, 2399 - 3, 5378]
    assert mrclam.truth[0].time[-1] == 771_873_000_000
    assert [round(track.time[-1] / SECOND) for track in mrclam.truth[1:]] == [900] * 4


@pytest.mark.parametrize("robot", range(5))
@pytest.mark.parametrize("stream", ["landmark_bearings", "uav_bearings"])
def test_mrclam_sightings(mrclam: Recording, stream: str, robot: int) -> None:
    table, track = mrclam.streams[stream][robot], mrclam.truth[robot]
    index = table.values[:, 0].astype(int)
    good = within(track, table.time)
    if stream == "landmark_bearings":
        targets = mrclam.landmarks[index]
    else:
        assert robot not in index
        others = [at(other.time, other.position, table.time) for other in mrclam.truth]
        targets = np.stack(others)[index, np.arange(len(index))]
        good &= np.stack([within(other, table.time) for other in mrclam.truth])[
            index, np.arange(len(index))
        ]
    offset = targets - at(track.time, track.position, table.time)
    heading = at(track.time, track.attitude, table.time)[:, 0]
    ranges = (table.values[:, 1] - np.hypot(*offset.T))[good]
    bearings = (table.values[:, 2] - np.arctan2(offset[:, 1], offset[:, 0]) + heading)[good]
    bearings = (bearings + np.pi) % (2 * np.pi) - np.pi
    bias, deviation = spread(ranges)
    assert abs(bias) < 0.1
    assert deviation < 0.25
    assert np.mean(np.abs(ranges) > 0.5) < 0.05
    bias, deviation = spread(bearings)
    assert abs(bias) < 0.02
    assert deviation < 0.02
    assert np.mean(np.abs(bearings) > 0.1) < 0.02


@pytest.mark.parametrize("robot", range(5))
def test_mrclam_odometry(mrclam: Recording, robot: int) -> None:
    """The wheels' commands (held between samples) against what the robot did, each second."""
    table, track = mrclam.streams["odometry"][robot], mrclam.truth[robot]
    held = table.values[:-1] * np.diff(table.time)[:, None] / SECOND
    total = np.concatenate((np.zeros((1, 2)), np.cumsum(held, axis=0)))
    when = np.arange(max(track.time[0], table.time[0]), track.time[-1] - 2 * SECOND, SECOND)
    reckoned = at(table.time, total, when + SECOND) - at(table.time, total, when)
    start, end = (at(track.time, track.position, when + shift) for shift in (0, SECOND))
    headings = [at(track.time, track.attitude, when + shift)[:, 0] for shift in (0, SECOND)]
    middle = np.mean(headings, axis=0)
    done = np.sum((end - start) * np.stack((np.cos(middle), np.sin(middle)), -1), axis=1)
    turned = headings[1] - headings[0]
    for commanded, did, limit in ((reckoned[:, 0], done, 0.03), (reckoned[:, 1], turned, 0.1)):
        assert 0.85 < commanded @ did / (commanded @ commanded) < 1.0
        assert np.std(did - commanded) < limit


def test_euroc_rates(euroc: Recording) -> None:
    assert [np.median(np.diff(track.time)) for track in euroc.truth] == [50e6, 4999936, 4999936]
    assert all(np.median(np.diff(imu.time)) == 4999936 for imu in euroc.streams["imu"])
    assert all(track.time[0] == 0 for track in euroc.truth)
    first_imu = [imu.time[0] / SECOND for imu in euroc.streams["imu"]]
    np.testing.assert_allclose(first_imu, [0.0, -0.995, -1.835], atol=1e-6)


@pytest.mark.parametrize("robot", range(3))
def test_euroc_imu(euroc: Recording, robot: int) -> None:
    table, track = euroc.streams["imu"][robot], euroc.truth[robot]
    assert track.gyro_bias is not None
    assert track.accel_bias is not None
    assert track.velocity is not None
    when = np.arange(0, track.time[-1] - SECOND, SECOND // 20)
    span = SECOND // 10
    bias = at(track.time, np.hstack((track.gyro_bias, track.accel_bias)), when)
    measured = mean_rate(table, when, span) - bias
    offset, deviation = spread(measured[:, :3] - turn_rate(track, when, span))
    assert np.abs(offset).max() < 2e-3
    assert deviation.max() < 6e-3
    velocities = [at(track.time, track.velocity, when + shift) for shift in (0, span)]
    force = (velocities[1] - velocities[0]) / (span / SECOND) + GRAVITY
    force = turns(track, when + span // 2).inv().apply(force)
    offset, deviation = spread(measured[:, 3:] - force)
    assert np.abs(offset).max() < 0.1
    assert deviation.max() < 0.25
    speed = np.gradient(track.position, track.time / SECOND, axis=0)
    assert spread(speed - track.velocity)[1].max() < 0.01


def test_euroc_body_is_forward_left_up(euroc: Recording) -> None:
    for track in euroc.truth:
        up = turns(track, track.time[:10]).inv().apply([0, 0, 1]).mean(axis=0)
        np.testing.assert_allclose(up, [-0.37, 0.0, 0.93], atol=0.06)


def tag_positions(recording: Recording, robot: int, tags: Floats, when: Stamps) -> Floats:
    track = recording.truth[robot]
    arms = recording.tags[robot][tags.astype(int)]
    return at(track.time, track.position, when) + turns(track, when).apply(arms)


def anchor_errors(recording: Recording) -> Floats:
    errors = []
    for robot, table in enumerate(recording.streams["anchor_ranges"]):
        tag, anchor, distance = table.values.T
        tags = tag_positions(recording, robot, tag, table.time)
        gap = np.linalg.norm(tags - recording.anchors[anchor.astype(int)], axis=1)
        errors.append((distance - gap)[within(recording.truth[robot], table.time)])
    return np.concatenate(errors)


def uav_errors(recording: Recording) -> Floats:
    errors = []
    for robot, table in enumerate(recording.streams["uav_ranges"]):
        for (own, other, tag, distance), when in zip(table.values, table.time, strict=True):
            ends = ((robot, own), (int(other), tag))
            if all(within(recording.truth[end], when[None])[0] for end, _ in ends):
                here, there = (
                    tag_positions(recording, end, np.array([t]), when[None]) for end, t in ends
                )
                errors.append(distance - np.linalg.norm(here - there))
    return np.array(errors)


def test_miluv_ranges(miluv: Recording) -> None:
    anchors, uavs = anchor_errors(miluv), uav_errors(miluv)
    assert sum(len(table.time) for table in miluv.streams["anchor_ranges"]) == 194
    assert sum(len(table.time) for table in miluv.streams["uav_ranges"]) == 2 * 123
    for errors in (anchors, uavs):
        bias, deviation = spread(errors)
        assert abs(bias) < 0.05
        assert deviation < 0.15
        assert np.mean(np.abs(errors) > 0.5) < 0.12
    assert np.mean(anchors > 0.5) > 5 * np.mean(anchors < -0.5)
    raw = recorded("miluv", "cirObstacles_3_random_0", ranges="raw")
    assert 0.05 < np.median(anchor_errors(raw)) < 0.2
    assert 0.05 < np.median(uav_errors(raw)) < 0.2


def test_miluv_exchanges_are_in_both_tables(miluv: Recording) -> None:
    ends = {
        (time, robot, *row)
        for robot, table in enumerate(miluv.streams["uav_ranges"])
        for time, row in zip(table.time.tolist(), table.values.tolist(), strict=True)
    }
    assert ends == {(time, other, tag, me, own, gap) for time, me, own, other, tag, gap in ends}


def test_miluv_single_robots() -> None:
    for sequence, samples in (
        ("cirObstacles_1_random3_0", 954),
        ("cirObstaclesOneTag_1_static_0", 562),
    ):
        recording = recorded("miluv", sequence)
        assert set(recording.streams) == {"anchor_ranges", "height", "magnetometer"}
        bias, deviation = spread(anchor_errors(recording))
        assert len(recording.streams["anchor_ranges"][0].time) == samples
        assert abs(bias) < 0.1
        assert deviation < 0.15


@pytest.mark.parametrize(("robot", "limit"), [(0, 0.06), (1, 0.15), (2, 0.1)])
def test_miluv_height(miluv: Recording, robot: int, limit: float) -> None:
    table, track = miluv.streams["height"][robot], miluv.truth[robot]
    height = at(track.time, track.position, table.time)[:, 2]
    flying = within(track, table.time) & (height > 0.45)
    bias, deviation = spread(table.values[flying, 0] - height[flying])
    assert abs(bias) < 0.05
    assert deviation < limit
    parked = table.time < 6 * SECOND
    assert 0.15 < np.median(table.values[parked, 0] - height[parked]) < 0.3


def test_miluv_truth_has_no_flips(miluv: Recording) -> None:
    """Vicon lost ifo002 for 0.4 s; that is a gap now, and elsewhere nothing was dropped."""
    assert [len(track.time) for track in miluv.truth] == [7844, 7821 - 40, 7772]
    for track in (*miluv.truth, *recorded("miluv", "cirObstacles_1_random3_0").truth):
        cosine = np.abs(np.sum(track.attitude[1:] * track.attitude[:-1], axis=1))
        close = np.diff(track.time) < SECOND // 20
        assert np.rad2deg(2 * np.arccos(np.clip(cosine[close], 0, 1))).max() < 30
    gaps = np.diff(miluv.truth[1].time)
    assert 0.39 * SECOND < gaps.max() < 0.42 * SECOND


@pytest.mark.parametrize("robot", range(3))
def test_miluv_imu(miluv: Recording, robot: int) -> None:
    track, px4 = miluv.truth[robot], miluv.streams["imu"][robot]
    camera = recorded("miluv", "cirObstacles_3_random_0", imu="camera").streams["imu"][robot]
    span = SECOND // 5
    when = np.arange(9 * SECOND, 73 * SECOND, SECOND // 20)
    rates = {"px4": mean_rate(px4, when, span), "camera": mean_rate(camera, when, span)}
    bias, deviation = spread(rates["camera"][:, :3] - rates["px4"][:, :3])
    assert np.abs(bias).max() < 0.01
    assert deviation.max() < 0.015
    good = within(track, when) & within(track, when + span)
    for rate in rates.values():
        bias, deviation = spread((rate[:, :3] - turn_rate(track, when, span))[good])
        assert np.abs(bias).max() < 0.03
        assert deviation.max() < 0.07

    when = np.array([2 * SECOND])
    expected = turns(track, when).inv().apply(GRAVITY)[0]
    for table, norm, tilt in ((px4, 0.01, 4.0), (camera, 0.08, 6.0)):
        force = mean_rate(table, when, 4 * SECOND)[0, 3:]
        assert abs(np.linalg.norm(force) / 9.81 - 1) < norm
        cosine = force @ expected / np.linalg.norm(force) / np.linalg.norm(expected)
        assert np.rad2deg(np.arccos(cosine)) < tilt


def test_miluv_magnetometer(miluv: Recording) -> None:
    """One field in the world and one offset in the body explain most of ifo002's readings."""
    table, track = miluv.streams["magnetometer"][1], miluv.truth[1]
    good = within(track, table.time)
    body = np.swapaxes(turns(track, table.time[good]).as_matrix(), 1, 2)
    readings = 1e6 * table.values[good].ravel()
    design = np.concatenate((body, np.tile(np.eye(3), (len(body), 1, 1))), 2).reshape(-1, 6)
    fit, *_ = np.linalg.lstsq(design, readings, rcond=None)
    assert np.std(readings - design @ fit) < 8
    assert fit[2] < -20


def horizontal_errors(recording: Recording, delay: float) -> tuple[Floats, Floats]:
    """Range minus true distance of one tag in the plane, and the anchors' indices; ``delay`` s."""
    (table,), (track,) = recording.streams["anchor_ranges"], recording.truth
    when = table.time - round(delay * SECOND)
    inside = (when >= track.time[0]) & (when <= track.time[-1])
    offset = (
        at(track.time, track.position, when) - recording.anchors[table.values[:, 1].astype(int)]
    )
    return (table.values[:, 2] - np.hypot(*offset.T))[inside], table.values[inside, 1]


@pytest.fixture(scope="module")
def tuc() -> Recording:
    return recorded("tuc", "Indoor_UWB")


def test_tuc_against_its_files(tuc: Recording) -> None:
    """Read again: 233 lines of each kind, at the same stamps."""
    folder = data_root() / "tuc_indoor_uwb"
    lines = [line.split() for line in (folder / "Indoor_UWB_Input.txt").read_text().splitlines()]
    truth = [line.split() for line in (folder / "Indoor_UWB_GT.txt").read_text().splitlines()]
    ranges = [line for line in lines if line[0] == "range2"]
    stamps = [round(Decimal(line[1]) * SECOND) for line in ranges]
    (table,), (wheels,) = tuc.streams["anchor_ranges"], tuc.streams["odometry"]
    for each in (table.time, wheels.time, tuc.truth[0].time):
        assert each.tolist() == stamps
    assert len(stamps) == 233
    assert tuc.truth[0].position.tolist() == [[float(x), float(y)] for _, _, x, y, *_ in truth]
    assert table.values[:, 2].tolist() == [float(line[2]) for line in ranges]
    numbers = np.array([105, 107, 108, 109])
    assert numbers[table.values[:, 1].astype(int)].tolist() == [int(line[6]) for line in ranges]
    for line, place in zip(ranges, tuc.anchors[table.values[:, 1].astype(int)], strict=True):
        assert [float(line[4]), float(line[5])] == place.tolist()


def test_tuc_ranges(tuc: Recording) -> None:
    """The figures of NOTES.md, and ranges and truth in time."""
    errors, anchors = horizontal_errors(tuc, 0.0)
    assert np.median(errors) == pytest.approx(0.10, abs=0.01)
    assert np.std(errors) == pytest.approx(0.11, abs=0.01)
    assert np.abs(errors).max() == pytest.approx(0.66, abs=0.01)
    biases = [np.median(errors[anchors == anchor]) for anchor in range(4)]
    np.testing.assert_allclose(biases, [0.15, 0.07, 0.11, 0.08], atol=0.01)
    spreads = {lag: spread(horizontal_errors(tuc, lag)[0])[1] for lag in (-0.3, 0.0, 0.3)}
    assert spreads[0.0] < 0.8 * min(spreads[-0.3], spreads[0.3])


def test_tuc_odometry(tuc: Recording) -> None:
    """Dead reckoning of the whole recording, turned and moved onto the truth (complex plane)."""
    (table,), (track,) = tuc.streams["odometry"], tuc.truth
    step = np.diff(table.time) / SECOND
    heading = np.append(0.0, np.cumsum(table.values[:-1, 1] * step))
    way = table.values[:-1, 0] * step * np.exp(0.5j * (heading[1:] + heading[:-1]))
    reckoned = np.append(0.0, np.cumsum(way))
    true = track.position[:, 0] + 1j * track.position[:, 1]
    reckoned, true = reckoned - reckoned.mean(), true - true.mean()
    turn = np.vdot(reckoned, true)
    assert np.sqrt(np.mean(np.abs(true - reckoned * turn / abs(turn)) ** 2)) < 0.08
    assert abs(np.rad2deg(np.angle(-turn))) < 20
    assert np.sum(np.abs(way)) == pytest.approx(9.2, abs=0.2)


HANYANG = {
    "LOS/Trajectory_A/Case_1": (235, 0.184, 0.06),
    "LOS/Trajectory_B/Case_3": (185, 0.178, 0.03),
    "NLOS/Trajectory_A/Case_1": (314, 0.165, 0.13),
    "NLOS/Trajectory_B/Case_4": (178, 0.183, 0.08),
}


@pytest.mark.parametrize("sequence", HANYANG)
def test_hanyang_against_its_files(sequence: str) -> None:
    """Read again: exact stamps, ranges made horizontal, and the figures of NOTES.md."""
    recording = recorded("hanyang", sequence)
    folder = data_root() / "hanyang_outdoor_uwb" / sequence
    (table,), (track,) = recording.streams["anchor_ranges"], recording.truth
    with (folder / "trajectory.csv").open() as file:
        walked = list(csv.DictReader(file))
    stamps = [int(Decimal(row["timestamp"])) for row in walked]
    assert (track.time + stamps[0]).tolist() == stamps
    assert round(track.time[-1] / SECOND) == HANYANG[sequence][0]
    with (folder / "gnss.csv").open() as file:
        fixes = np.array([int(row["field.header.stamp"]) for row in csv.DictReader(file)])
    assert max(np.abs(fixes - stamp).min() for stamp in stamps) < 250
    places = np.array([[float(row[axis]) for axis in "xyz"] for row in walked])
    for index, number in enumerate((3, 5, 9, 12)):
        with (folder / f"A{number}.csv").open() as file:
            rows = list(csv.DictReader(file))
        x, y, z = (float(rows[0][f"field.{axis}"]) for axis in "xyz")
        distance = np.array([float(row["field.distanceFromTag"]) for row in rows])
        when = np.array([int(row["field.stamp"]) for row in rows]) - stamps[0]
        assert recording.anchors[index].tolist() == [x, y]
        own, kept = table.values[:, 1] == index, distance >= abs(z - 1.1)
        assert np.sum(~kept) <= 3
        assert table.time[own].tolist() == when[kept].tolist()
        whole = np.hypot(table.values[own, 2], z - 1.1)
        np.testing.assert_allclose(whole, distance[kept], rtol=1e-12)
        inside = (when >= 0) & (when <= track.time[-1])
        true = np.linalg.norm(at(track.time, places, when[inside]) - (x, y, z), axis=1)
        bias, deviation = spread(distance[inside] - true)
        assert -0.23 < bias < 0.17
        assert 0.13 < deviation < 0.34


@pytest.mark.parametrize("sequence", HANYANG)
def test_hanyang_ranges(sequence: str) -> None:
    """Ranges are late; what is far off is too short."""
    recording = recorded("hanyang", sequence)
    _, delay, bias = HANYANG[sequence]
    errors, anchors = horizontal_errors(recording, delay)
    middle, deviation = spread(errors)
    assert middle == pytest.approx(bias, abs=0.02)
    assert deviation < 0.13
    assert deviation < 0.75 * spread(horizontal_errors(recording, 0.0)[0])[1]
    assert deviation < 0.9 * spread(horizontal_errors(recording, 2 * delay)[0])[1]
    assert np.ptp([np.median(errors[anchors == anchor]) for anchor in range(4)]) < 0.07
    assert 0.002 < np.mean(np.abs(errors) > 1) < 0.008
    assert errors.max() < 0.9
    assert errors.min() < -10
