"""Bags of every kind of measurement: a folder, written as a bag with rosbags, comes back."""

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from coloc_env.datasets.bags import import_bag
from coloc_env.datasets.open_format import read_recording
from tests.coloc_env.datasets.bags_made import START, Row, header, uwb_types, write_rows
from tests.coloc_env.datasets.folders_made import Folder, table, write

ABOUT = """
dim: 3
robots: [a, b]
time: {unit: ns, zero: epoch}
exchanges: once
map: {anchors: {north: [0, 5, 2], south: [0, -5, 2], up: [1, 1, 4]}}
tags: {a: [[0.1, 0, 0], [-0.1, 0, 0]], b: [[0, 0.1, 0], [0, -0.1, 0]]}
"""
KINDS = {"ros1": "made.bag", "ros2": "made", "mcap": "made"}
NUMBERS = {"north": "11", "south": "12", "up": "13", "a": "1", "b": "2"}  # as the radios say
RADIO = """
std_msgs/Header header
uint16 first
uint16 second
uint8 own_antenna
uint8 their_antenna
int8 error
float64 metres
float64[] angles
"""
_MAP = [line for line in ABOUT.splitlines() if line.startswith(("dim", "map", "tags"))]
TOPICS = "\n  ".join(("recording:", *_MAP)) + "\nrobots:"
ROBOT = """
  {0}:
    truth: {{topic: /{0}/truth}}
    tdoa:
      topic: /{0}/tdoa
      fields: {{from: first, to: second, difference: metres, own_tag: own_antenna}}
      names: {{'11': north, '12': south, '13': up, '1': a, '2': b}}
      where: {{error: '0'}}
    angles:
      topic: /{0}/angles
      fields: {{robot: first, azimuth: angles.0, elevation: angles.1}}
      names: {{'11': north, '12': south, '13': up, '1': a, '2': b}}
    ranges:
      topic: /{0}/ranges
      fields: {{to: first, range: metres, own_tag: own_antenna, to_tag: their_antenna}}
      names: {{'11': north, '12': south, '13': up, '1': a, '2': b}}
    flow: {{topic: /{0}/flow}}
    height: {{topic: /{0}/height}}
    position_fix: {{topic: /{0}/position_fix}}
    magnetometer: {{topic: /{0}/magnetometer}}
"""


def everything() -> Folder:
    """Two UAVs with two tags each that sense all there is in space."""
    rng, anchors = np.random.default_rng(6), ("north", "south", "up")
    files = {"recording.yaml": ABOUT}
    for name, other in (("a", "b"), ("b", "a")):
        time = [START + 50_000_000 * i for i in range(20)]

        def put(file: str, columns: str, rows: list[Any], name: str = name) -> None:
            files[f"{name}/{file}.csv"] = table(columns, rows)

        put(
            "truth", "stamp,x,y,z,qx,qy,qz,qw", [[t, *rng.normal(size=3), 0, 0, 0, 1] for t in time]
        )
        pairs = [(anchors[i % 3], anchors[(i + 1) % 3], rng.normal(), i % 2) for i in range(20)]
        put(
            "tdoa",
            "stamp,from,to,difference,own_tag",
            [[t, *p] for t, p in zip(time, pairs, strict=True)],
        )
        angles = [[t, other, *rng.uniform(-1.5, 1.5, 2)] for t in time]
        put("angles", "stamp,robot,azimuth,elevation", angles)
        ends = [other, *anchors]
        ranges = [
            [t, ends[i % 4], rng.uniform(1, 9), i % 2, 1 - i // 4 % 2 if i % 4 == 0 else 0]
            for i, t in enumerate(time)
        ]
        put("ranges", "stamp,to,range,own_tag,to_tag", ranges)
        put("flow", "stamp,vx,vy", [[t, *rng.normal(size=2)] for t in time])
        heights = rng.uniform(1, 2, 20).astype(np.float32).tolist()
        put("height", "stamp,height", [[t, h] for t, h in zip(time, heights, strict=True)])
        put("position_fix", "stamp,x,y,z", [[t, *rng.normal(size=3)] for t in time])
        put("magnetometer", "stamp,x,y,z", [[t, *rng.normal(size=3) * 1e-5] for t in time])
    return files


def messages(home: Path, store: Any, first: bool) -> Iterator[Row]:
    """A folder's rows as messages that carry them."""
    t = store.types
    vector, point = t["geometry_msgs/msg/Vector3"], t["geometry_msgs/msg/Point"]
    for path in sorted(home.glob("*/*.csv")):
        topic, file = f"/{path.parent.name}/{path.stem}", path.stem
        with path.open() as text:
            rows = list(csv.DictReader(text))
        for row in rows:
            time = int(row["stamp"])
            head = header(store, time, first)
            v = {k: float(cell) for k, cell in row.items() if cell not in NUMBERS}
            if file in ("tdoa", "angles", "ranges"):
                kind, ends = (
                    "my_uwb/msg/Radio",
                    [int(NUMBERS[c]) for c in row.values() if c in NUMBERS],
                )
                tags = (int(v.get("own_tag", 0)), int(v.get("to_tag", 0)))
                metres = v.get("difference", v.get("range", 0.0))
                angles = np.array([v.get("azimuth", 0.0), v.get("elevation", 0.0)])
                message = t[kind](head, *(*ends, 0)[:2], *tags, 0, metres, angles)
                if file == "tdoa":  # one that failed beside each
                    yield topic, kind, time, t[kind](head, *ends, *tags, -1, 99.0, angles)
            elif file == "truth":
                kind = "geometry_msgs/msg/PoseStamped"
                level = t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
                pose = t["geometry_msgs/msg/Pose"](point(v["x"], v["y"], v["z"]), level)
                message = t[kind](head, pose)
            elif file == "flow":
                kind = "geometry_msgs/msg/TwistStamped"
                rate = t["geometry_msgs/msg/Twist"](
                    vector(v["vx"], v["vy"], 0.0), vector(0.0, 0.0, 0.0)
                )
                message = t[kind](head, rate)
            elif file == "height":
                kind = "sensor_msgs/msg/Range"
                message = t[kind](head, 1, 0.1, 0.0, 9.0, v["height"])
            elif file == "position_fix":
                kind = "geometry_msgs/msg/PointStamped"
                message = t[kind](head, point(v["x"], v["y"], v["z"]))
            else:
                kind = "sensor_msgs/msg/MagneticField"
                message = t[kind](head, vector(v["x"], v["y"], v["z"]), np.zeros(9))
            yield topic, kind, time, message


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_measurement_comes_back(kind: str, tmp_path: Path) -> None:
    home = write(tmp_path / "home", everything())
    types = uwb_types(Radio=RADIO)
    bag = write_rows(
        tmp_path / KINDS[kind], kind, types, lambda store: messages(home, store, kind == "ros1")
    )
    topics = tmp_path / "topics.yaml"
    topics.write_text(TOPICS + ROBOT.format("a") + ROBOT.format("b"))
    counts = import_bag(bag, topics, tmp_path / "out")
    assert set(counts.values()) == {20}
    found, made = read_recording(tmp_path / "out"), read_recording(home)
    assert found.streams.keys() == made.streams.keys()
    assert {"tdoa", "arrival_angles", "flow", "height", "position_fix", "uav_ranges"} <= set(
        made.streams
    )
    for name, team in made.streams.items():
        for mine, theirs in zip(found.streams[name], team, strict=True):
            assert mine.columns == theirs.columns
            np.testing.assert_array_equal(mine.time, theirs.time)
            np.testing.assert_array_equal(mine.values, theirs.values)
    np.testing.assert_array_equal(found.tags, made.tags)
    assert found.epoch == made.epoch
    for mine, theirs in zip(found.truth, made.truth, strict=True):
        np.testing.assert_array_equal(mine.position, theirs.position)


@pytest.mark.parametrize("kind", KINDS)
def test_outages_and_what_is_beyond_reach_are_left_out(kind: str, tmp_path: Path) -> None:
    """A receiver without a fix at first and then now and then, a laser beyond its reach, motion
    capture that lost its robot."""
    lost = [0, 1, 5, 6]
    fix = np.array([48.1, 11.5, 500.0]) + np.arange(10)[:, None] * (1e-5, 2e-5, 0.5)
    fix[lost] = [(np.nan,) * 3, (0.0, 0.0, 0.0), (np.nan,) * 3, (12.0, 12.0, 0.0)]

    def rows(store: Any) -> Iterator[Row]:
        t = store.types
        for i, at in enumerate(fix.tolist()):
            time = START + 100_000_000 * i
            head = header(store, time, kind == "ros1")
            status = t["sensor_msgs/msg/NavSatStatus"](status=-1 if i in lost else 0, service=1)
            message = t["sensor_msgs/msg/NavSatFix"](head, status, *at, np.zeros(9), 0)
            yield "/a/gps", "sensor_msgs/msg/NavSatFix", time, message
            laser = (12.0, np.inf, 0.01)[i % 3] if i in lost else 1.5
            beam = t["sensor_msgs/msg/Range"](head, 1, 0.1, 0.05, 9.0, laser)
            yield "/a/laser", "sensor_msgs/msg/Range", time, beam
            place = t["geometry_msgs/msg/Point"](*((np.nan,) * 3 if i in lost else (1.0, 2.0, 3.0)))
            pose = t["geometry_msgs/msg/PointStamped"](head, place)
            yield "/vicon/a", "geometry_msgs/msg/PointStamped", time, pose

    bag = write_rows(tmp_path / KINDS[kind], kind, {}, rows)
    topics = tmp_path / "topics.yaml"
    topics.write_text(
        "recording: {dim: 3}\nrobots:\n  a:\n    position_fix: {topic: /a/gps}\n"
        "    height: {topic: /a/laser}\n    truth: {topic: /vicon/a}\n"
    )
    import_bag(bag, topics, tmp_path / "out")
    found = read_recording(tmp_path / "out")
    assert found.dropped == {"position_fix": 4, "height": 4}
    assert len(found.truth[0].time) == 6
    place = found.streams["position_fix"][0].values
    assert (place[0] == 0).all()
    steps = (np.delete(np.arange(10), lost) - 2)[:, None]
    # a degree of latitude is 111 200 m there, one of longitude 74 450 m
    np.testing.assert_allclose(
        place, steps * (2e-5 * 74_450, 1e-5 * 111_200, 0.5), rtol=2e-3, atol=1e-3
    )
