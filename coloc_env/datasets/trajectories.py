"""A recording's trajectories for other tools: TUM files and ROS 2 bags, with attitudes and the
stamps that were recorded."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from coloc_env.datasets.open_format.stamps import seconds_text
from coloc_env.datasets.recording import DataError, Floats, Recording, Track
from coloc_env.staging import staged_folder

BAG = "trajectories"


def write_tum(recording: Recording, out: str | os.PathLike[str]) -> None:
    """``ROBOT.txt`` for each robot with ground truth, a pose a line: ``stamp x y z qx qy qz qw``,
    in s (since 1970 where that is known) to the nanosecond and m, body to world. In two dimensions
    z is 0.

    Raises:
        DataError: there is no ground truth.
    """
    known = _known(recording)
    names = [f"{recording.robots[i]}.txt" for i in known]
    with staged_folder(Path(out), names) as folder:
        for name, i in zip(names, known, strict=True):
            with (folder / name).open("w", encoding="ascii", newline="\n") as file:
                for stamp, place, turn in _poses(recording, recording.truth[i]):
                    numbers = " ".join(map(repr, (*place, *turn)))
                    file.write(f"{seconds_text(stamp)} {numbers}\n")


def write_bag(recording: Recording, out: str | os.PathLike[str]) -> None:
    """``trajectories``, a ROS 2 bag (MCAP) with a topic ``/ROBOT/pose`` of PoseStamped, frame
    ``world``, for each robot with ground truth, in the order of time.

    Raises:
        DataError: there is no ground truth, or a stamp before 1970, which ROS does not have;
            rosbags is not installed.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise DataError("bags need rosbags: pip install 'coloc-env[ros]'") from None
    store, kind = get_typestore(Stores.ROS2_HUMBLE), "geometry_msgs/msg/PoseStamped"
    types = store.types
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    point, turned = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Quaternion"]
    pose, stamped = types["geometry_msgs/msg/Pose"], types[kind]
    known = _known(recording)
    rows = [(t, i, p, q) for i in known for t, p, q in _poses(recording, recording.truth[i])]
    rows.sort(key=lambda row: row[0])
    if rows[0][0] < 0:
        raise DataError(f"{recording.name}: a stamp is before 1970")
    with staged_folder(Path(out), (BAG,)) as folder:
        bag = Writer(folder / BAG, version=9, storage_plugin=StoragePlugin.MCAP)
        with bag as writer:
            topics = {
                i: writer.add_connection(f"/{recording.robots[i]}/pose", kind, typestore=store)
                for i in known
            }
            for stamp, i, place, turn in rows:
                where = header(time(*divmod(stamp, 10**9)), "world")
                message = stamped(where, pose(point(*place), turned(*turn)))
                writer.write(topics[i], stamp, store.serialize_cdr(message, kind))


def _known(recording: Recording) -> list[int]:
    """Robots with ground truth."""
    known = [i for i, track in enumerate(recording.truth) if len(track.time)]
    if not known:
        raise DataError(f"{recording.name} has no ground truth: there is no trajectory to write")
    return known


def _poses(
    recording: Recording, track: Track
) -> Iterator[tuple[int, tuple[float, ...], tuple[float, ...]]]:
    """Stamps (ns), positions (x, y, z) m in the frame that was recorded, and quaternions x, y, z,
    w."""
    place: Floats = track.position + np.array(recording.origin or (0.0,) * recording.dim)
    place = np.pad(place, ((0, 0), (0, 3 - recording.dim)))
    if recording.dim == 3:
        turn = np.roll(track.attitude, -1, 1)
    else:
        half = 0.5 * track.attitude[:, 0]
        turn = np.stack((0 * half, 0 * half, np.sin(half), np.cos(half)), 1)
    for t, p, q in zip(track.time.tolist(), place.tolist(), turn.tolist(), strict=True):
        yield t + recording.epoch, tuple(p), tuple(q)
