"""TIERS arrays in miniature: what is read and what is refused."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coloc_env.datasets import DataError, Recording, load_tiers
from coloc_env.datasets.tiers import sequences_in

ARRAYS: dict[str, Any] = {
    "optitrack_turtle01_pose_np": [[0.0, 0.0], [0.0, 1.0], [0.0, 2.0], [0.0, 3.0]],
    "optitrack_turtle03_pose_np": [[3.0, 0.0]] * 4,
    "optitrack_turtle05_pose_np": [[3.0, 4.0]] * 4,
    "optitrack_turtle01_orientation_np": [3.0, 3.1, -3.1, -3.0],
    "optitrack_turtle03_orientation_np": [0.0] * 4,
    "optitrack_turtle05_orientation_np": [0.5] * 4,
    "uwb_range_3_1_np": [3.25, 3.25, 3.5, 3.25],
    "uwb_range_5_1_np": [0.0, 5.0, 5.0, 5.0],
    "uwb_range_5_3_np": [4.25, 4.0, 4.25, 4.0],
}


def write(folder: Path, **changes: Any) -> Path:
    arrays = {k: np.array(v) for k, v in {**ARRAYS, **changes}.items() if v is not None}
    np.savez(folder / "drive.npz", **arrays)
    return folder / "drive"


def test_what_is_read(tmp_path: Path) -> None:
    recording = load_tiers(write(tmp_path))
    assert (recording.name, recording.dim) == ("tiers/drive", 2)
    assert recording.robots == ("turtle01", "turtle03", "turtle05")
    assert recording.truth[0].time.tolist() == [0, 138_000_000, 276_000_000, 414_000_000]
    assert recording.truth[0].position[2].tolist() == [0.0, 2.0]
    turn = 2 * np.pi
    np.testing.assert_allclose(recording.truth[0].attitude[:, 0], [3, 3.1, turn - 3.1, turn - 3])
    assert recording.tags.tolist() == [[[0, 0]]] * 3


def test_ranges_are_in_both_ends_tables_zeros_and_repeats_are_not(tmp_path: Path) -> None:
    tables = load_tiers(write(tmp_path)).streams["uav_ranges"]
    assert tables[0].columns == ("own_tag", "robot", "tag", "range")
    first = [(t // 138_000_000, r, d) for t, (_, r, _, d) in _rows(tables[0])]
    assert first == [(0, 1, 3.25), (1, 2, 5.0), (2, 1, 3.5), (3, 1, 3.25)]
    last = [(t // 138_000_000, r, d) for t, (_, r, _, d) in _rows(tables[2])]
    assert last == [(0, 1, 4.25), (1, 0, 5.0), (1, 1, 4.0), (2, 1, 4.25), (3, 1, 4.0)]


def test_held_ranges_if_asked_for(tmp_path: Path) -> None:
    table = load_tiers(write(tmp_path), held=True).streams["uav_ranges"][0]
    assert table.values[table.values[:, 1] == 1, 3].tolist() == [3.25, 3.25, 3.5, 3.25]
    assert table.values[table.values[:, 1] == 2, 3].tolist() == [5.0, 5.0, 5.0]


def _rows(table: Any) -> Any:
    return zip(table.time.tolist(), table.values.tolist(), strict=True)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("uwb_range_5_3_np", None, "no array uwb_range_3_5_np"),
        ("uwb_range_5_3_np", [4.0, 4.0], r"has shape \[2\], not \[4\]"),
        (
            "optitrack_turtle3_pose_np",
            [[3.0, 0.0]] * 4,
            "is also turtle0?3",
        ),
        ("uwb_range_7_3_np", [4.0] * 4, "uwb_range_7_3_np, but no pose of robot 7"),
        ("uwb_range_5_3_np", ["4"] * 4, "holds <U1, not decimal numbers"),
        ("optitrack_turtle03_orientation_np", None, "no array optitrack_turtle03_orientation"),
        ("optitrack_turtle03_pose_np", [[3.0, 0.0, 1.0]] * 4, r"shape \[4, 3\], not \[n, 2\]"),
        ("optitrack_turtle03_pose_np", np.zeros((0, 2)), r"shape \[0, 2\], not \[n, 2\]"),
        ("optitrack_turtle03_pose_np", [[np.inf, 0.0]] * 4, "sample 0: not a finite number"),
    ],
)
def test_damage_is_named(tmp_path: Path, name: str, value: Any, reason: str) -> None:
    with pytest.raises(DataError, match=r"drive\.npz: .*" + reason):
        load_tiers(write(tmp_path, **{name: value}))


def test_what_is_no_range_is_left_out_and_counted(tmp_path: Path) -> None:
    ranges = [np.nan, -1.0, 4.0, 1e308]
    recording = load_tiers(write(tmp_path, uwb_range_5_3_np=ranges))
    assert recording.dropped == {"uav_ranges": 3}
    table = recording.streams["uav_ranges"][2]
    assert table.values[table.values[:, 1] == 1, 3].tolist() == [4.0]


def test_a_robot_of_two_digits(tmp_path: Path) -> None:
    changes = {
        name.replace("turtle05", "turtle12").replace("_5_", "_12_"): value
        for name, value in ARRAYS.items()
    }
    gone = {name: None for name in ARRAYS if name not in changes}
    recording = load_tiers(write(tmp_path, **gone, **changes))
    assert recording.robots == ("turtle01", "turtle03", "turtle12")
    assert recording.truth[2].position[0].tolist() == [3.0, 4.0]
    assert recording.streams["uav_ranges"][0].values[1, 1:].tolist() == [2, 0, 5.0]


def test_robots_of_different_lengths(tmp_path: Path) -> None:
    changes = {
        "optitrack_turtle03_pose_np": [[3.0, 0.0]] * 3,
        "optitrack_turtle03_orientation_np": [0.0] * 3,
    }
    with pytest.raises(DataError, match="robot 3 has 3 samples, not 4"):
        load_tiers(write(tmp_path, **changes))


def test_one_robot_is_no_team(tmp_path: Path) -> None:
    gone: dict[str, Any] = {f"optitrack_turtle0{n}_pose_np": None for n in (3, 5)}
    gone |= {name: None for name in ARRAYS if name.startswith("uwb_range")}
    with pytest.raises(DataError, match="of two robots or more"):
        load_tiers(write(tmp_path, **gone))


def test_objects_are_not_unpickled(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"cannot be read: .*allow_pickle"):
        load_tiers(write(tmp_path, other=np.array([{}, None])))


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"drive\.npz: no such file"):
        load_tiers(tmp_path / "drive")


def test_sequences(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "broken.npz").write_bytes(b"no archive")
    assert sequences_in(tmp_path) == {"broken": 0, "drive": 3}
    with pytest.raises(DataError, match=r"broken\.npz: cannot be read"):
        load_tiers(tmp_path / "broken")


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_any_damage_is_read_or_a_data_error(
    tmp_path_factory: pytest.TempPathFactory,
    survives: Callable[[Callable[[], Recording]], None],
    data: st.DataObject,
) -> None:
    stem = write(tmp_path_factory.mktemp("damaged"))
    path = stem.with_suffix(".npz")
    content = bytearray(path.read_bytes())
    start = data.draw(st.integers(0, len(content) - 1))
    content[start : start + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    path.write_bytes(content)
    survives(lambda: load_tiers(stem))
