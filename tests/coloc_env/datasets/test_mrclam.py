"""MRCLAM files in miniature: what is read, what is dropped, what is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coloc_env.datasets import DataError, Recording, load_mrclam
from coloc_env.datasets.grid import common_grid
from coloc_env.datasets.replay import recorded_bearings
from coloc_env.sensors import LandmarkBearings

FILES = {
    "Barcodes.dat": "# Subject # Barcode #\n 1 5\n 3 14\n 6 63\n 7 81\n",
    "Landmark_Groundtruth.dat": "# Subject x y\n 7 2.0 3.0 0.1 0.1\n 6 0.5 -4.0 0.1 0.1\n",
    "Robot1_Groundtruth.dat": "# Time x y heading\n100.100 1.0 2.0 3.1\n100.200 1.1 2.0 -3.1\n"
    "100.200 9.0 9.0 0.0\n100.300 1.2 2.0 -3.0\n",
    "Robot1_Odometry.dat": "# Time v w\n100.050 0.1 0.0\n100.150 0.2 0.1\n100.150 0.3 0.1\n",
    "Robot1_Measurement.dat": "# Time barcode range bearing\n100.100 81 1.5 0.1\n"
    "100.100 63 2.5 0.2\n100.100 14 3.5 0.3\n100.100 77 4.5 0.4\n100.100 81 1.5 0.1\n"
    "100.250 81 1.5 0.1\n",
    "Robot3_Groundtruth.dat": "# Time x y heading\n100.000 1.0 2.0 0.0\n",
    "Robot3_Odometry.dat": "# Time v w\n100.000 0.1 0.0\n",
    "Robot3_Measurement.dat": "# Time barcode range bearing\n100.100 5 1.5 0.1\n",
}
MS = 1_000_000


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))


def write(folder: Path, **changes: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name, content in FILES.items():
        (folder / name).write_text(changes.get(name.removesuffix(".dat"), content))
    return folder


def test_what_is_read(tmp_path: Path) -> None:
    recording = load_mrclam(write(tmp_path / "MRCLAM_Dataset0"))
    assert recording.name == "mrclam/MRCLAM_Dataset0"
    assert (recording.dim, recording.robots) == (2, ("Robot1", "Robot3"))
    assert recording.landmarks.tolist() == [[0.5, -4.0], [2.0, 3.0]]
    assert (recording.anchors.shape, recording.tags.shape) == ((0, 2), (2, 0, 2))
    track = recording.truth[0]
    assert track.time.tolist() == [100 * MS, 200 * MS, 300 * MS]
    assert track.position.tolist() == [[1.0, 2.0], [1.1, 2.0], [1.2, 2.0]]
    np.testing.assert_allclose(track.attitude[:, 0], [3.1, 2 * np.pi - 3.1, 2 * np.pi - 3.0])
    odometry = recording.streams["odometry"][0]
    assert odometry.columns == ("v", "omega")
    assert odometry.time.tolist() == [50 * MS, 150 * MS, 150 * MS]
    assert odometry.values[:, 0].tolist() == [0.1, 0.2, 0.3]


def test_sightings_are_sorted_out(tmp_path: Path) -> None:
    streams = load_mrclam(write(tmp_path / "x")).streams
    landmarks = streams["landmark_bearings"][0]
    assert landmarks.columns == ("landmark", "range", "bearing")
    assert landmarks.time.tolist() == [100 * MS, 100 * MS, 250 * MS]
    assert landmarks.values.tolist() == [[1, 1.5, 0.1], [0, 2.5, 0.2], [1, 1.5, 0.1]]
    assert streams["landmark_bearings"][1].values.shape == (0, 3)
    first, second = streams["uav_bearings"]
    assert first.columns == ("robot", "range", "bearing")
    assert first.values.tolist() == [[1, 3.5, 0.3]]
    assert second.values.tolist() == [[0, 1.5, 0.1]]


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        ("Barcodes", "7 81", "7 63", "line 5: barcode 63 stands there twice"),
        ("Barcodes", "7 81", "3 81", "line 5: subject 3 stands there twice"),
        ("Barcodes", "7 81", "7 81.5", "line 5: barcode is 81.5, not a whole number"),
        ("Barcodes", "7 81", "7 81\n 9 99", "line 6: subject 9 is no landmark, and has no files"),
        ("Landmark_Groundtruth", "0.5 -4.0 0.1 0.1", "0.5 -4.0", "line 3: 3 columns, not 5"),
        ("Robot1_Measurement", "63 2.5 0.2", "63 2.5", "line 3: 3 columns, not 4"),
        ("Robot1_Measurement", "63 2.5", "63 two", "line 3: range is 'two', not a number"),
        ("Robot1_Groundtruth", "2.0 -3.1", "nan -3.1", "line 3: y is not a finite number"),
        ("Robot1_Odometry", "0.3", "0.3 0.3", "line 4: 4 columns, not 3"),
        ("Robot3_Odometry", "# Time v w\n100.000 0.1 0.0\n", "", "Robot3_Odometry.dat: no data"),
    ],
)
def test_damage_is_located(tmp_path: Path, file: str, old: str, new: str, reason: str) -> None:
    content = FILES[f"{file}.dat"]
    assert content.count(old) == 1
    with pytest.raises(DataError) as caught:
        load_mrclam(write(tmp_path / "x", **{file: content.replace(old, new)}))
    assert reason in str(caught.value)
    assert f"{file}.dat" in str(caught.value)


def test_foreign_file(tmp_path: Path) -> None:
    euroc = "#timestamp,w,w,w,a,a,a\n1403715273262142976,0,0,0,0,0,9.8\n"
    with pytest.raises(DataError, match=r"Robot1_Odometry\.dat, line 2: 1 columns, not 3"):
        load_mrclam(write(tmp_path / "x", Robot1_Odometry=euroc))


@pytest.mark.parametrize("name", sorted(FILES))
def test_missing_file(tmp_path: Path, name: str) -> None:
    folder = write(tmp_path / "x")
    (folder / name).unlink()
    with pytest.raises(DataError, match=f"{name}: no such file"):
        load_mrclam(folder)


def test_a_robot_without_any_file(tmp_path: Path) -> None:
    folder = write(tmp_path / "x")
    for path in folder.glob("Robot3_*"):
        path.unlink()
    with pytest.raises(DataError, match="line 3: subject 3 is no landmark, and has"):
        load_mrclam(folder)


def test_a_robot_without_sightings(tmp_path: Path) -> None:
    changed = "100.000 1.0 2.0 0.0\n100.300 1.0 2.0 0.0\n"
    files = {"Robot3_Measurement": "# Time barcode\n", "Robot3_Groundtruth": changed}
    recording = load_mrclam(write(tmp_path / "x", **files))
    for stream in ("landmark_bearings", "uav_bearings"):
        assert recording.streams[stream][1].values.shape == (0, 3)
    grid = common_grid(recording, 0.1, ())
    seen, depth = recorded_bearings(recording, grid, LandmarkBearings(2))
    assert depth == 1
    assert seen.series["landmark_bearing_mask"].values[:, 1].sum() == 0


@pytest.mark.parametrize("value", ["-1", "0", "nan", "inf", "-inf", "1e308", "1e400", "20.5"])
def test_what_is_no_range_is_left_out_and_counted(tmp_path: Path, value: str) -> None:
    changed = FILES["Robot1_Measurement.dat"].replace("63 2.5", f"63 {value}")
    recording = load_mrclam(write(tmp_path / "x", Robot1_Measurement=changed))
    assert recording.dropped == {"landmark_bearings": 1, "uav_bearings": 0}
    assert recording.streams["landmark_bearings"][0].values[:, 1].tolist() == [1.5, 1.5]


def test_order_is_that_of_numbers_and_hidden_files_are_none(tmp_path: Path) -> None:
    folder = write(tmp_path / "x", Barcodes=FILES["Barcodes.dat"].replace(" 3 14", " 12 14"))
    for path in list(folder.glob("Robot3_*")):
        path.rename(folder / path.name.replace("Robot3", "Robot12"))
    for path in list(folder.iterdir()):
        (folder / f"._{path.name}").write_bytes(b"\x00\x05\x16\x07")
    (folder / ".DS_Store").write_bytes(b"\x00")
    assert load_mrclam(folder).robots == ("Robot1", "Robot12")


def test_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no RobotN_Groundtruth"):
        load_mrclam(tmp_path / "away")


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
    folder = write(tmp_path_factory.mktemp("damaged"), **{name.removesuffix(".dat"): changed})
    survives(lambda: load_mrclam(folder))
