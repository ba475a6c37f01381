"""Large recordings: how long they take to load, and how much memory a bag's import needs."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coloc_env.datasets.open_format import read_recording, write_recording
from coloc_env.datasets.recording import IMU_COLUMNS, Recording, Table, Track
from tests.coloc_env.datasets.bags_made import START, Row, header, write_rows

pytestmark = pytest.mark.slow
ROBOTS = tuple(f"uav_{i}" for i in range(6))
IMPORT = """
import json, resource, sys, time
from coloc_env.datasets.bags import import_bag
begun = time.process_time()
counts = import_bag(*sys.argv[1:])
used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"rows": sum(counts.values()), "mb": used, "s": time.process_time() - begun}))
"""


def test_ten_minutes_of_six_imus_at_200_hz_load_in_3_s(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    time_ns = np.arange(600 * 200, dtype=np.int64) * 5_000_000
    imu = tuple(Table(time_ns, rng.normal(size=(len(time_ns), 6)), IMU_COLUMNS) for _ in ROBOTS)
    slow = time_ns[::20]
    ahead = np.tile((1.0, 0.0, 0.0, 0.0), (len(slow), 1))
    truth = tuple(Track(slow, rng.normal(size=(len(slow), 3)), ahead) for _ in ROBOTS)
    none, tags = np.empty((0, 3)), np.empty((6, 0, 3))
    made = Recording("made", 3, ROBOTS, truth, {"imu": imu}, none, none, tags, "")
    write_recording(made, tmp_path / "made")
    begun = time.process_time()
    found = read_recording(tmp_path / "made")
    seconds = time.process_time() - begun
    print(f"720 000 rows of IMU and 36 000 poses loaded in {seconds:.2f} s of CPU")
    np.testing.assert_array_equal(found.streams["imu"][5].values, imu[5].values)
    assert seconds < 3


def test_a_bag_of_200_mb_is_streamed(tmp_path: Path) -> None:
    """IMUs of six robots for 60 s, and a camera that nobody asks for."""
    pytest.importorskip("rosbags")
    picture = np.random.default_rng(0).integers(0, 256, 300_000, dtype=np.uint8)

    def rows(store: Any) -> Iterator[Row]:
        t = store.types
        vector, nine = t["geometry_msgs/msg/Vector3"], np.zeros(9)
        level = t["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        for i in range(60 * 200):
            time_ns = START + 5_000_000 * i
            head = header(store, time_ns, False)
            rate, force = vector(0.1 * i, 0.2, 0.3), vector(0.0, 0.1, 9.8)
            message = t["sensor_msgs/msg/Imu"](head, level, nine, rate, nine, force, nine)
            for robot in ROBOTS:
                yield f"/{robot}/imu", "sensor_msgs/msg/Imu", time_ns, message
            if i % 20 == 0:
                frame = t["sensor_msgs/msg/CompressedImage"](head, "jpeg", picture)
                yield "/camera", "sensor_msgs/msg/CompressedImage", time_ns, frame

    bag = write_rows(tmp_path / "made", "mcap", {}, rows)
    size = sum(file.stat().st_size for file in bag.iterdir()) / 1e6
    assert size > 200
    topics = tmp_path / "topics.yaml"
    lines = [f"  {robot}: {{imu: {{topic: /{robot}/imu}}}}" for robot in ROBOTS]
    topics.write_text("\n".join(("recording: {dim: 3}", "robots:", *lines)) + "\n")
    command = [sys.executable, "-c", IMPORT, str(bag), str(topics), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    print(f"{size:.0f} MB: {found}")
    assert found["rows"] == 6 * 60 * 200
    assert found["mb"] < 1000
