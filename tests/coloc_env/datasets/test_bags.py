"""Bags: what a test wrote with rosbags is what is imported."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from coloc_env.datasets import DataError
from coloc_env.datasets.bags import first_topics, import_bag
from coloc_env.datasets.open_format import read_recording
from tests.coloc_env.datasets.bags_made import TOPICS, numbers, write_bag

KINDS = {"ros1": "flight.bag", "ros2": "flight", "mcap": "flight"}


@pytest.fixture(params=KINDS)
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_bag(tmp_path / KINDS[request.param], request.param)


def test_a_bag_becomes_a_recording(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "topics.yaml").write_text(TOPICS)
    counts = import_bag(bag, tmp_path / "topics.yaml", tmp_path / "out")
    assert counts["a/imu"] == 50
    assert counts["a/ranges"] == 40
    found, made = read_recording(tmp_path / "out"), numbers()
    assert found.name == "flight"
    assert found.robots == ("a", "b")
    imu = found.streams["imu"][0]
    assert (np.diff(imu.time) >= 0).all()
    np.testing.assert_array_equal(np.sort(imu.values[:, 0]), np.sort(made["imu"][:, 0]))
    np.testing.assert_array_equal(found.truth[0].position, made["pose"])
    ranges = found.streams["anchor_ranges"][0].values
    np.testing.assert_array_equal(ranges[:, 0], [0.0, 1.0] * 20)
    np.testing.assert_array_equal(ranges[:, 1], [0.0, 1.0] * 20)
    np.testing.assert_allclose(ranges[:, 2], made["distance"][:, :2].ravel() / 1000, rtol=1e-15)
    np.testing.assert_array_equal(found.streams["height"][0].values[:, 0], made["height"])
    fix = found.streams["position_fix"][1].values
    assert (fix[0] == 0).all()
    # a degree of latitude is 111 200 m there, one of longitude 74 450 m; heights are heights
    moved = (made["fix"] - made["fix"][0])[:, [1, 0, 2]] * (74_450, 111_200, 1.0)
    np.testing.assert_allclose(fix, moved, rtol=2e-3, atol=2e-3)


def test_a_single_file_of_a_bag(tmp_path: Path) -> None:
    whole = write_bag(tmp_path / "flight", "mcap")
    (alone,) = whole.glob("*.mcap")
    moved = tmp_path / "alone.mcap"
    moved.write_bytes(alone.read_bytes())
    (tmp_path / "topics.yaml").write_text(TOPICS)
    counts = import_bag(moved, tmp_path / "topics.yaml", tmp_path / "out")
    assert counts["a/ranges"] == 40


def test_a_first_topics_file_is_one(bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "topics.yaml"
    path.write_text(first_topics(bag))
    counts = import_bag(bag, path, tmp_path / "out")
    assert counts == {
        "a/imu": 50, "a/height": 15, "a/truth": 20, "b/odometry": 20, "b/position_fix": 12
    }  # fmt: skip
    assert "my_uwb/msg/Ranging" in path.read_text()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "/a/imu",
            "/a/imus",
            r"line 8: robots.a.imu: unknown topic '/a/imus' \(did you mean '/a/im",
        ),
        (
            "distance_mm",
            "range",
            "no field 'range' in 'range'; known: responder, antenna, distance_m",
        ),
        ("exchanges", "header", "'header' is no list"),
        ("{topic: /a/laser}", "{topic: /a/uwb}", "my_uwb/msg/Ranging says nothing of height; name"),
        ("'8': eight", "'8': ate", "ranges.csv, line 3, column to: 'ate' is none of a, b, seven"),
        ("imu:", "imus:", r"line 8: robots.a.imus: unknown table 'imus' \(did you mean 'imu'"),
        ("each", "every", "unknown entry 'every'"),
        ("dim: 3", "dim: 4", "dim: 4 is not 2 or 3"),
    ],
)
def test_wrong_topics_are_named(old: str, new: str, words: str, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "flight", "mcap")
    path = tmp_path / "topics.yaml"
    assert old in TOPICS
    path.write_text(TOPICS.replace(old, new, 1))
    with pytest.raises(DataError, match=words) as caught:
        import_bag(bag, path, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_no_bag(tmp_path: Path) -> None:
    (tmp_path / "topics.yaml").write_text(TOPICS)
    with pytest.raises(DataError, match="no such bag"):
        import_bag(tmp_path / "none", tmp_path / "topics.yaml", tmp_path / "out")
    (tmp_path / "x.bag").write_bytes(b"not a bag")
    with pytest.raises(DataError, match=r"x\.bag"):
        import_bag(tmp_path / "x.bag", tmp_path / "topics.yaml", tmp_path / "out")
