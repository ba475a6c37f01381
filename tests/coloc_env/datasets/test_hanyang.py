"""Hanyang files in miniature: exact times, horizontal distances, and what is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coloc_env.datasets import DataError, Recording, load_hanyang

HEADER = "%time,field.stamp,field.id,field.x,field.y,field.z,field.distanceFromTag,field.rssi,"
HEADER += "field.rssi_fp\n"
FILES = {
    "A12.csv": HEADER + "1734501485318454633,1734501485318213939,12,0.69,0.87,0.5,6.05,-79,-80\n",
    "A3.csv": HEADER + "1734501485317590607,1734501485317395687,3,2.5,0.87,1.9,1.0,-79,-80\n"
    "1734501485417273454,1734501485416840553,3,2.5,0.87,1.9,0.5,-79,-80\n"
    "1734501485517273454,1734501485518213940,3,2.5,0.87,1.9,1.7,-79,-80\n",
    "trajectory.csv": "timestamp,x,y,z,heading_degrees\n"
    "1.7345014855003267e+18,-2.5,-4.25,0.0,170.0\n1.7345014856253268e+18,-2.4,-4.2,0.1,190.0\n"
    "1.73450148575e+18,-2.3,-4.1,0.1,-180.0\n",
}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))


def write(folder: Path, **changes: str) -> Path:
    folder = folder / "LOS" / "Trajectory_A" / "Case_1"
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in FILES.items():
        (folder / name).write_text(changes.get(name.removesuffix(".csv"), content))
    return folder


def test_what_is_read(tmp_path: Path) -> None:
    recording = load_hanyang(write(tmp_path))
    assert recording.name == "hanyang/LOS/Trajectory_A/Case_1"
    assert (recording.dim, recording.robots) == (2, ("tag",))
    assert recording.anchors.tolist() == [[2.5, 0.87], [0.69, 0.87]]
    assert recording.tags.tolist() == [[[0, 0]]]
    track = recording.truth[0]
    assert track.time.tolist() == [0, 125_000_100, 249_673_300]
    assert track.position.tolist() == [[-2.5, -4.25], [-2.4, -4.2], [-2.3, -4.1]]
    np.testing.assert_allclose(np.rad2deg(track.attitude[:, 0]), [170, 190, 180])


def test_ranges_are_made_horizontal(tmp_path: Path) -> None:
    """The tag is 1.1 m high; a range of 0.5 m to an anchor at 1.9 m has no horizontal distance."""
    (ranges,) = load_hanyang(write(tmp_path)).streams["anchor_ranges"]
    assert ranges.columns == ("own_tag", "anchor", "range")
    zero = 1734501485500326700
    stamps = [1734501485317395687, 1734501485318213939, 1734501485518213940]
    assert ranges.time.tolist() == [stamp - zero for stamp in stamps]
    assert ranges.values[:, :2].tolist() == [[0, 0], [0, 1], [0, 0]]
    np.testing.assert_allclose(ranges.values[:, 2], [0.6, (6.05**2 - 0.36) ** 0.5, 1.5])


@pytest.mark.parametrize("value", ["", "-1", "0", "nan", "inf", "1e308", "301"])
def test_what_is_no_range_is_left_out_and_counted(tmp_path: Path, value: str) -> None:
    changed = FILES["A3.csv"].replace(",1.7,", f",{value},")
    recording = load_hanyang(write(tmp_path / "x", A3=changed))
    assert recording.dropped == {"anchor_ranges": 1}
    assert len(recording.streams["anchor_ranges"][0].time) == 2


def test_anchors_with_leading_zeros_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    folder = write(tmp_path / "x")
    (folder / "A3.csv").rename(folder / "A03.csv")
    (folder / "._A12.csv").write_bytes(b"\x00\x05")
    assert load_hanyang(folder).anchors.tolist() == [[2.5, 0.87], [0.69, 0.87]]
    (folder / "A3.csv").write_bytes((folder / "A03.csv").read_bytes())
    with pytest.raises(DataError, match=r"the anchor of A0?3\.csv again"):
        load_hanyang(folder)


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        ("A12", ",12,", ",3,", "line 2: field.id is 3, not 12"),
        ("A12", "6.05", "far", "line 2: field.distanceFromTag is 'far', not a number"),
        ("A12", "field.z", "z", "line 1: the header does not name one column 'field.z'"),
        ("A3", "0.87,1.9,1.7", "0.88,1.9,1.7", "line 4: the anchor is in another place"),
        ("A3", "1734501485416840553", "1734501485116840553", "line 3: the time is before"),
        ("A3", "1734501485416840553", "1734501485.4", "line 3: the time is 1734501485.4, not nano"),
        ("trajectory", "485625", "485425", "line 3: the time is before"),
        ("trajectory", "-2.4,-4.2,", "-2.4,nan,", "line 3: y is not a finite number"),
        ("trajectory", "0.1,190.0", "190.0", "line 3: 4 columns, not 5"),
    ],
)
def test_damage_is_located(tmp_path: Path, file: str, old: str, new: str, reason: str) -> None:
    content = FILES[f"{file}.csv"]
    assert content.count(old) == 1
    with pytest.raises(DataError) as caught:
        load_hanyang(write(tmp_path, **{file: content.replace(old, new)}))
    assert f"{file}.csv, {reason}" in str(caught.value)


def test_missing_files(tmp_path: Path) -> None:
    folder = write(tmp_path)
    (folder / "A12.csv").unlink()
    assert len(load_hanyang(folder).anchors) == 1
    (folder / "A3.csv").rename(folder / "Ax.csv")
    with pytest.raises(DataError, match=r"Case_1: no A<number>\.csv"):
        load_hanyang(folder)
    (folder / "trajectory.csv").unlink()
    with pytest.raises(DataError, match=r"trajectory\.csv: no such file"):
        load_hanyang(folder)


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_any_damage_is_read_or_a_data_error(
    tmp_path_factory: pytest.TempPathFactory,
    survives: Callable[[Callable[[], Recording]], None],
    damaged: Callable[[st.DataObject, str], str],
    data: st.DataObject,
) -> None:
    name = data.draw(st.sampled_from(sorted(FILES)))
    content = FILES[name]
    changed = damaged(data, content)
    folder = write(tmp_path_factory.mktemp("damaged"), **{name.removesuffix(".csv"): changed})
    survives(lambda: load_hanyang(folder))
