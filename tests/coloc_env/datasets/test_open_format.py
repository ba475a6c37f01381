"""The open recording format: what people write is what is loaded; what cannot be is refused."""

import warnings
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coloc_env.datasets import DATASETS, DataError, Recording, Table, load, sequences
from coloc_env.datasets.open_format import frames, read_recording, write_recording
from coloc_env.datasets.open_format.stamps import nanoseconds
from tests.coloc_env.datasets.folders_made import FOLDERS, flying, spreadsheet, wheeled, write


def same(a: Any, b: Any, where: str = "") -> None:
    """Equal to the last bit."""
    if isinstance(a, np.ndarray):
        assert (a.dtype, a.shape) == (b.dtype, b.shape), where
        assert np.array_equal(a, b, equal_nan=True), where
        assert np.array_equal(np.signbit(a), np.signbit(b)), where
    elif hasattr(a, "__dataclass_fields__"):
        for each in fields(a):
            same(getattr(a, each.name), getattr(b, each.name), f"{where}.{each.name}")
    elif isinstance(a, dict):
        assert sorted(a) == sorted(b), where
        for key in a:
            same(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for x, y in zip(a, b, strict=True):
            same(x, y, where)
    else:
        assert a == b, where


@pytest.mark.parametrize("name", FOLDERS)
def test_written_is_read_back(name: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first = read_recording(write(tmp_path / "by_hand", FOLDERS[name]()))
    write_recording(first, tmp_path / "again")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same(read_recording(tmp_path / "again"), first)


@pytest.mark.parametrize("dataset", DATASETS)
def test_every_loader_exports_to_the_bit(
    dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        found = sequences(dataset)
    except DataError as error:
        pytest.skip(str(error))
    recording = shortened(load(dataset, found[0]))
    write_recording(recording, tmp_path / "out")
    same(read_recording(tmp_path / "out"), recording)


def shortened(recording: Recording) -> Recording:
    """Its first 20 s."""
    from dataclasses import replace

    def cut(table: Table) -> Table:
        there = table.time < 20_000_000_000
        return replace(table, time=table.time[there], values=table.values[there])

    tracks = []
    for track in recording.truth:
        there = track.time < 20_000_000_000
        parts = {
            each.name: None if (x := getattr(track, each.name)) is None else x[there]
            for each in fields(track)
        }
        tracks.append(type(track)(**parts))
    streams = {name: tuple(map(cut, team)) for name, team in recording.streams.items()}
    return replace(recording, truth=tuple(tracks), streams=streams)


def test_what_a_spreadsheet_writes(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="not used: column note"):
        found = read_recording(write(tmp_path, spreadsheet()))
    assert found.robots == ("tag",)
    assert found.anchor_names == ("A 1", "B")
    np.testing.assert_array_equal(found.anchors[1], [5, 0, 1.205])
    ranges = found.streams["anchor_ranges"][0]
    assert ranges.time[:3].tolist() == [0, 100_000_000, 200_000_000]
    assert (np.abs(ranges.values[:, 2] - 3.05) < 0.06).all()


@pytest.mark.parametrize("change", ["bom", "crlf", "tabs", "case", "order", "blank", "spaces"])
@pytest.mark.parametrize("name", ["wheeled", "flying"])
def test_how_it_is_written_does_not_matter(name: str, change: str, tmp_path: Path) -> None:
    files = FOLDERS[name]()
    changed = {
        path: rewritten(text, change) if path.endswith(".csv") else text
        for path, text in files.items()
    }
    assert changed != files
    first = read_recording(write(tmp_path / "a" / "r", files))
    same(read_recording(write(tmp_path / "b" / "r", changed)), first)


def rewritten(text: str, change: str) -> str:
    if change == "order":
        rows = [line.split(",") for line in text.splitlines()]
        return "\n".join(",".join(row[::-1]) for row in rows) + "\n"
    head, _, body = text.partition("\n")
    return {
        "bom": "\ufeff" + text,
        "crlf": text.replace("\n", "\r\n"),
        "tabs": text.replace(",", "\t"),
        "case": head.upper() + "\n" + body,
        "blank": text.replace("\n", "\n\n") + ",,\n\n",
        "spaces": text.replace(",", " , "),
    }[change]


def test_parquet_is_taken(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    import pyarrow.csv as text_tables
    import pyarrow.parquet as parquet

    home = write(tmp_path / "b" / "r", flying())
    for path in (*home.glob("*/*.csv"), home / "points.csv"):
        table = text_tables.read_csv(path)
        if path.stem == "imu":  # stamps of a type of their own
            stamp = table["stamp"].cast(pyarrow.timestamp("ns"))
            table = table.set_column(0, "stamp", stamp)
        parquet.write_table(table, path.with_suffix(".parquet"))
        path.unlink()
    same(read_recording(home), read_recording(write(tmp_path / "a" / "r", flying())))


@pytest.mark.parametrize(
    ("texts", "unit", "expected"),
    [
        (
            ["0.1", "1.000000001", "-0.5", ".25"],
            "s",
            [100000000, 1000000001, -500000000, 250000000],
        ),
        (["1700000000.123456789"], "s", [1700000000123456789]),
        (["1.7e9"], "s", [1_700_000_000_000_000_000]),
        (["0.1234567894"], "s", [123456789]),
        (["12.5"], "ms", [12_500_000]),
        (["1700000000123456789"], "ns", [1700000000123456789]),
    ],
)
def test_stamps_are_exact(texts: list[str], unit: str, expected: list[int]) -> None:
    assert nanoseconds(texts, unit).tolist() == expected


@pytest.mark.parametrize(
    "text", ["", "-", ".", "x", "1_0", "1e99", "nan", "inf", "1,5", "1.2.3", "--1"]
)
def test_what_is_no_stamp(text: str) -> None:
    with pytest.raises(ValueError, match=r"^1$"):
        nanoseconds(["1", text], "s")


def test_north_east_down() -> None:
    rng = np.random.default_rng(0)
    q = rng.normal(size=(20, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    v = rng.normal(size=(20, 3))
    ned_of_frd = rotated(q, v)  # a body vector of the recording in its world
    enu = frames.world(ned_of_frd, "ned")
    same_vector = frames.body(v, "ned")
    np.testing.assert_allclose(rotated(frames.attitude(q, "ned"), same_vector), enu, atol=1e-12)
    yaw = np.array([0.3])
    north = np.array([[np.cos(yaw[0]), np.sin(yaw[0])]])
    angle = frames.heading(yaw, "ned")[0]
    np.testing.assert_allclose(frames.world(north, "ned")[0], [np.cos(angle), np.sin(angle)])


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(q, -1, 1)).apply(v)


def test_exchanges_are_known_to_both_once(tmp_path: Path) -> None:
    files = flying()
    files["b/ranges.csv"] = "stamp,to,range\n1700000000000000001,a,7.5\n"
    found = read_recording(write(tmp_path, files))
    a, b = found.streams["uav_ranges"]
    assert len(a.time) == len(b.time) == 15
    np.testing.assert_array_equal(np.sort(a.values[:, 3]), np.sort(b.values[:, 3]))
    assert 7.5 in a.values[:, 3]


def test_what_no_sensor_measures_is_counted(tmp_path: Path) -> None:
    files = wheeled()
    lines = files["ann/sightings.csv"].splitlines()
    lines[2] = "0.100,door,,,0.1"
    lines[3] = "0.200,door,,-1,0.1"
    lines[4] = "0.300,,bob,nan,0.1"
    files["ann/sightings.csv"] = "\n".join(lines)
    assert read_recording(write(tmp_path, files)).dropped == {
        "landmark_bearings": 2,
        "uav_bearings": 1,
    }


def test_far_from_the_origin_digits_are_kept(tmp_path: Path) -> None:
    files = wheeled()
    files["recording.yaml"] = files["recording.yaml"].replace("[1.0, 2.5]", "[500001, 4000002.5]")
    files["recording.yaml"] = files["recording.yaml"].replace("[-3, 0.25]", "[499997, 4000000.25]")
    for name in ("ann", "bob"):
        rows = [line.split(",") for line in files[f"{name}/truth.csv"].splitlines()]
        rows[1:] = [[r[0], str(500000 + i), "4000000.5", r[3]] for i, r in enumerate(rows[1:])]
        files[f"{name}/truth.csv"] = "\n".join(map(",".join, rows))
    found = read_recording(write(tmp_path, files))
    assert found.origin == (500000.0, 4000000.0)
    np.testing.assert_array_equal(found.landmarks, [[1, 2.5], [-3, 0.25]])


WRONG: list[tuple[str, str, str, str, str]] = [
    # folder, file, what stands there, what is put in its place, what the refusal says
    (
        "wheeled",
        "recording.yaml",
        "dim: 2",
        "dim: 4",
        r"recording.yaml, line 1: dim: 4 is not 2 or 3",
    ),
    ("wheeled", "recording.yaml", "dim: 2", "dim: two", "line 1: dim: 'two' is not a whole number"),
    ("wheeled", "recording.yaml", "robots", "robot", r"line 2: robot: unknown entry 'robot' \(did"),
    ("wheeled", "recording.yaml", "[ann, bob]", "[ann]", "line 2: robots: does not name bob"),
    ("wheeled", "recording.yaml", "bob]", "bob, cid]", "line 2: robots: names 'cid', but there is"),
    (
        "wheeled",
        "recording.yaml",
        "unit: s",
        "unit: h",
        "time.unit: 'h' is not one of s, ms, us, ns",
    ),
    (
        "wheeled",
        "recording.yaml",
        "2.5]",
        "2.5, 1]",
        r"line 6: map.landmarks.door: \[1.0, 2.5, 1\] is",
    ),
    ("wheeled", "recording.yaml", "lamp", "ann", "'ann' is given twice"),
    ("wheeled", "recording.yaml", "lamp", "door", "line 7: map.landmarks.door: stands there twice"),
    ("wheeled", "recording.yaml", "lamp: [", "lamp: {", "line 7: not YAML"),
    ("wheeled", "ann/truth.csv", "stamp", "time", "truth.csv, line 1: no column 'stamp' among"),
    ("wheeled", "ann/truth.csv", "x,y", "x,z", "truth.csv, line 1: there is no column 'y'"),
    ("wheeled", "ann/truth.csv", "x,y", "x,x", "line 1: the column 'x' stands there twice"),
    ("wheeled", "ann/truth.csv", "0.100,", "0,100,", "line 3: 5 columns, not 4"),
    (
        "wheeled",
        "ann/truth.csv",
        "0.500,",
        "0.300,",
        "line 7, column stamp: the time is 0.1 s before",
    ),
    (
        "wheeled",
        "ann/truth.csv",
        "\n0.500,",
        "\n0:500,",
        "line 7, column stamp: '0:500' is not a time",
    ),
    ("wheeled", "ann/odometry.csv", "\n0.500,", "\n0.500,oops", "line 7, column v: 'oops"),
    ("wheeled", "ann/odometry.csv", "\n0.500,", "\n0.500,1_0", "line 7, column v: '1_0"),
    ("wheeled", "ann/odometry.csv", "v,omega", "v,vx", "either v and omega are needed, or vx"),
    (
        "wheeled",
        "ann/sightings.csv",
        "door",
        "dor",
        "line 3, column of: 'dor' is none of ann, bob, d",
    ),
    ("wheeled", "ann/sightings.csv", "bob", "ann", "column robot: 'ann' is the robot itself"),
    (
        "wheeled",
        "ann/sightings.csv",
        ",0.3\n",
        ",30\n",
        "column bearing: 30 is more than a whole turn",
    ),
    ("flying", "a/imu.csv", "gyro_y", "gyro", "line 1: there is no column 'gyro_y'"),
    (
        "flying",
        "a/imu.csv",
        ",9.8\n",
        ",nan\n",
        "line 2, column accel_z: nan is not a finite number",
    ),
    ("flying", "a/imu.csv", ",9.8\n", ",2e9\n", r"line 2, column accel_z: 2e\+09 is beyond 1e\+09"),
    ("flying", "a/ranges.csv", "north", "nord", "line 3, column to: 'nord' is none of a, b, north"),
    ("flying", "a/ranges.csv", "north,1", "north,2", "column own_tag: 2 is no tag from 0 to 1"),
    ("flying", "points.csv", ",a,", ",c,", "points.csv, line 2, column robot: 'c' is none of a, b"),
    (
        "spreadsheet",
        "tag/truth.tum",
        "0 0 0 1",
        "0 0 0 2",
        "column qw: 2 makes a quaternion of length",
    ),
    ("spreadsheet", "tag/truth.tum", "0 0 0 1", "0 0 0", "line 2: 7 columns, not 8"),
]


@pytest.mark.filterwarnings("ignore:.*not used")
@pytest.mark.parametrize(("name", "file", "old", "new", "words"), WRONG)
def test_what_is_refused(
    name: str, file: str, old: str, new: str, words: str, tmp_path: Path
) -> None:
    files = FOLDERS[name]()
    assert old in files[file]
    files[file] = files[file].replace(old, new, 1)
    home = write(tmp_path, files)
    with pytest.raises(DataError, match=words) as caught:
        read_recording(home)
    assert "\n" not in str(caught.value)
    assert file.rpartition("/")[2] in str(caught.value)


def test_misspelt_tables_are_not_ignored(tmp_path: Path) -> None:
    home = write(tmp_path, wheeled())
    (home / "ann" / "odometry.csv").rename(home / "ann" / "odometrie.csv")
    with pytest.raises(DataError, match=r"unknown table 'odometrie' \(did you mean 'odometry'"):
        read_recording(home)


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        read_recording(tmp_path / "none")
    with pytest.raises(DataError, match=r"there is no recording\.yaml"):
        read_recording(tmp_path)
