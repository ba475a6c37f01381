"""What is in a bag, and a first ``topics.yaml`` to edit."""

import os

import yaml

from coloc_env.datasets.bags.importer import opened
from coloc_env.datasets.bags.messages import FIX

_TABLES = {  # what a message's type most likely is
    "sensor_msgs/msg/Imu": "imu",
    "sensor_msgs/msg/MagneticField": "magnetometer",
    "sensor_msgs/msg/Range": "height",
    FIX: "position_fix",
    "nav_msgs/msg/Odometry": "odometry",
    "geometry_msgs/msg/PoseStamped": "truth",
    "geometry_msgs/msg/TransformStamped": "truth",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "position_fix",
}
_MOCAP = ("vicon", "optitrack", "mocap", "vrpn", "qualisys")


def first_topics(bag: str | os.PathLike[str]) -> str:
    """The text of a ``topics.yaml``: every topic as a comment, and what its types suggest.

    Raises DataError: no bag, or one that cannot be read.
    """
    robots: dict[str, dict[str, dict[str, str]]] = {}
    lines = ["# topics of this bag (type, messages); edit what is below"]
    with opened(bag) as reader:
        for connection in sorted(reader.connections, key=lambda c: c.topic):
            kind, topic = connection.msgtype, connection.topic
            lines.append(f"#   {topic}  {kind}  {connection.msgcount}")
            table = _TABLES.get(kind)
            if table is None:
                lines += [f"#     {line}" for line in _fields(reader, kind)]
            else:
                robots.setdefault(_robot(topic), {}).setdefault(table, {"topic": topic})
    lines += [
        "# a message of another type, say ranges, by the paths of its fields:",
        "#   ranges: {topic: /uwb, fields: {range: distance, to: responder}, scale: 0.001,",
        "#     names: {'7': anchor_7}, each: measurements, where: {valid: 'True'}}",
    ]
    about = {
        "recording": {"dim": 3, "map": {"anchors": {}, "landmarks": {}}},
        "robots": robots or {"uav_0": {}},
    }
    return "\n".join(lines) + "\n" + yaml.safe_dump(about, sort_keys=False)


def _robot(topic: str) -> str:
    """The namespace that a topic is in, motion capture's own aside."""
    parts = [part for part in topic.split("/") if part]
    kept = [part for part in parts[:-1] or parts if part.lower() not in _MOCAP]
    if parts[0].lower() in _MOCAP:
        kept = parts[1:2]
    return kept[0] if kept else "uav_0"


def _fields(reader: object, kind: str) -> list[str]:
    """The fields of a type, as far as its definition is there."""
    found = getattr(reader, "typestore").fielddefs.get(kind)  # noqa: B009
    return [f"field: {name}" for name, _ in found[1]] if found else []
