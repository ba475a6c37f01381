"""Bags that the tests write with rosbags itself."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

START = 1_700_000_000_000_000_000  # ns
UWB = """
std_msgs/Header header
my_uwb/Exchange[] exchanges
"""
EXCHANGE = """
uint16 responder
uint16 antenna
uint32 distance_mm
bool valid
"""


def numbers() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {
        "imu": rng.normal(size=(50, 6)),
        "pose": rng.normal(size=(20, 3)),
        "twist": rng.normal(size=(20, 3)),
        "distance": rng.integers(1000, 9000, size=(20, 3)),
        "height": rng.uniform(1, 2, size=15).astype(np.float32),
        "fix": np.array([48.1, 11.5, 500.0]) + rng.normal(size=(12, 3)) * (1e-5, 1e-5, 1.0),
    }


Row = tuple[str, str, int, Any]
"""Topic, type, when it was written (ns), message."""


def uwb_types(**definitions: str) -> dict[str, Any]:
    """Custom types ``my_uwb/msg/NAME`` from the text of their definitions."""
    from rosbags.typesys import get_types_from_msg

    found: dict[str, Any] = {}
    for name, text in definitions.items():
        found |= get_types_from_msg(text, f"my_uwb/msg/{name}")
    return found


def write_bag(path: Path, kind: str) -> Path:
    """A bag with two robots' topics; its custom message holds a list of exchanges. Headers' stamps
    of the IMU are not in order."""
    types = uwb_types(Ranging=UWB, Exchange=EXCHANGE)
    return write_rows(path, kind, types, lambda store: _messages(store, kind == "ros1"))


def write_rows(
    path: Path, kind: str, types: dict[str, Any], rows: Callable[[Any], Iterable[Row]]
) -> Path:
    """A bag of ``kind`` ros1, ros2 or mcap with the messages that ``rows`` makes of a type store,
    which knows custom ``types``, too."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    store.register(types)
    if kind == "ros1":
        from rosbags.rosbag1 import Writer as Writer1

        writer: Any = Writer1(path)
    else:
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2

        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, time, message in sorted(rows(store), key=lambda row: row[2]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            raw = (
                store.serialize_ros1(message, msgtype)
                if kind == "ros1"
                else store.serialize_cdr(message, msgtype)
            )
            writer.write(connections[topic], time, raw)
    return path


def header(store: Any, time: int, first: bool) -> Any:
    """A header with a stamp (ns), of ROS 1 (``first``) or 2."""
    t = store.types
    stamp = t["builtin_interfaces/msg/Time"](sec=time // 10**9, nanosec=time % 10**9)
    if first:
        return t["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="")
    return t["std_msgs/msg/Header"](stamp=stamp, frame_id="")


def _messages(store: Any, first: bool) -> Iterator[Row]:
    t, made = store.types, numbers()
    vector, point = t["geometry_msgs/msg/Vector3"], t["geometry_msgs/msg/Point"]
    level = t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    nine, wide = np.zeros(9), np.zeros(36)
    for i, row in enumerate(made["imu"]):
        time = START + 10_000_000 * i
        late = time - 15_000_000 * (i % 10 == 5)  # written after one that was measured later
        yield (
            "/a/imu",
            "sensor_msgs/msg/Imu",
            time,
            t["sensor_msgs/msg/Imu"](
                header(store, late, first),
                level,
                nine,
                vector(*row[:3]),
                nine,
                vector(*row[3:]),
                nine,
            ),
        )
    pose = t["geometry_msgs/msg/Pose"]
    for i, (place, twist) in enumerate(zip(made["pose"], made["twist"], strict=True)):
        time = START + 50_000_000 * i
        stamped = t["geometry_msgs/msg/PoseStamped"](
            header(store, time, first), pose(point(*place), level)
        )
        yield "/vicon/a", "geometry_msgs/msg/PoseStamped", time, stamped
        rate = t["geometry_msgs/msg/Twist"](
            vector(twist[0], twist[1], 0.0), vector(0.0, 0.0, twist[2])
        )
        yield (
            "/b/odom",
            "nav_msgs/msg/Odometry",
            time,
            t["nav_msgs/msg/Odometry"](
                header(store, time, first),
                "base",
                t["geometry_msgs/msg/PoseWithCovariance"](pose(point(*place), level), wide),
                t["geometry_msgs/msg/TwistWithCovariance"](rate, wide),
            ),
        )
        exchange = t["my_uwb/msg/Exchange"]
        yield (
            "/a/uwb",
            "my_uwb/msg/Ranging",
            time,
            t["my_uwb/msg/Ranging"](
                header(store, time, first),
                [
                    exchange(responder=7 + k, antenna=k % 2, distance_mm=int(d), valid=k < 2)
                    for k, d in enumerate(made["distance"][i])
                ],
            ),
        )
    for i, height in enumerate(made["height"]):
        time = START + 60_000_000 * i
        fields: tuple[Any, ...] = (header(store, time, first), 1, 0.1, 0.0, 9.0, float(height))
        more = () if first or len(t["sensor_msgs/msg/Range"].__dataclass_fields__) < 8 else (0.0,)
        yield "/a/laser", "sensor_msgs/msg/Range", time, t["sensor_msgs/msg/Range"](*fields, *more)
    for i, fix in enumerate(made["fix"]):
        time = START + 80_000_000 * i
        yield (
            "/b/gps",
            "sensor_msgs/msg/NavSatFix",
            time,
            t["sensor_msgs/msg/NavSatFix"](
                header(store, time, first),
                t["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
                *fix,
                nine,
                0,
            ),
        )


TOPICS = """
recording:
  dim: 3
  map: {anchors: {seven: [0, 0, 2], eight: [5, 0, 2]}}
  tags: {a: [[0.1, 0, 0], [-0.1, 0, 0]]}
robots:
  a:
    imu: {topic: /a/imu}
    truth: {topic: /vicon/a}
    height: {topic: /a/laser}
    ranges:
      topic: /a/uwb
      each: exchanges
      where: {valid: 'True'}
      fields: {range: distance_mm, to: responder, own_tag: antenna}
      names: {'7': seven, '8': eight}
      scale: 0.001
  b:
    position_fix: {topic: /b/gps}
    truth: {topic: /b/odom}
"""
