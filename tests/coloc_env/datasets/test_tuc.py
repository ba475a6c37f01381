"""TU Chemnitz files in miniature: what is read and what is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coloc_env.datasets import DataError, Recording, load_tuc

FILES = {
    "Yard_Input.txt": "range2 0.127943992614746 2.5 0.01 -0.02 1.5 107 0 \n"
    "range2 0.25 1.5 0.01 3.5 1.5 105 0 \nrange2 0.375 2.75 0.01 -0.02 1.5 107 0 \n"
    "odom2diff 0.127943992614746 0.25 0.25 0 0.125 0.1 0.1 0.1 \n"
    "odom2diff 0.25 0.25 0.5 0 0.125 0.1 0.1 0.1 \n",
    "Yard_GT.txt": "".join(
        f"point2 {0.125 * k} {x} {y} 0 0 0 0 \n"
        for k, (x, y) in enumerate([(1, 1), (1, 1), (0.75, 1), (0.5, 1), (0.5, 1.25), (0.5, 1.5)])
    ),
}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))


def write(folder: Path, **changes: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name, content in FILES.items():
        kind = name.removeprefix("Yard_").removesuffix(".txt")
        (folder / name).write_text(changes.get(kind, content), encoding="utf-8")
    return folder / "Yard"


def test_what_is_read(tmp_path: Path) -> None:
    recording = load_tuc(write(tmp_path / "x"))
    assert (recording.name, recording.dim, recording.robots) == ("tuc/Yard", 2, ("robot",))
    assert recording.anchors.tolist() == [[3.5, 1.5], [-0.02, 1.5]]
    assert recording.tags.tolist() == [[[0, 0]]]
    (ranges,) = recording.streams["anchor_ranges"]
    assert ranges.columns == ("own_tag", "anchor", "range")
    assert ranges.time.tolist() == [127_943_993, 250_000_000, 375_000_000]
    assert ranges.values.tolist() == [[0, 1, 2.5], [0, 0, 1.5], [0, 1, 2.75]]
    (odometry,) = recording.streams["odometry"]
    assert odometry.columns == ("v", "omega")
    assert odometry.time.tolist() == [127_943_993, 250_000_000]
    assert odometry.values.tolist() == [[0.25, 0], [0.375, 1.0]]


def test_attitude_is_the_course(tmp_path: Path) -> None:
    track = load_tuc(write(tmp_path / "x")).truth[0]
    assert track.time.tolist() == [125_000_000 * k for k in range(6)]
    assert track.position[2].tolist() == [0.75, 1]
    courses = np.rad2deg(track.attitude[:, 0])
    np.testing.assert_allclose(courses, [180, 180, 180, 135, 90, 90])


@pytest.mark.parametrize("kept", [1, 2])
def test_a_robot_that_never_moves(tmp_path: Path, kept: int) -> None:
    lines = FILES["Yard_GT.txt"].splitlines(keepends=True)[:kept]
    track = load_tuc(write(tmp_path / "x", GT="".join(lines))).truth[0]
    assert track.attitude.tolist() == [[0.0]] * kept


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        ("Input", "odom2diff 0.25", "odom2 0.25", "line 5: begins with 'odom2', not range2 or"),
        ("Input", "2.75 0.01 -0.02", "2.75 0.01 0.02", "line 3: anchor 107 is in another place"),
        ("Input", "1.5 105", "1.5 105.5", "line 2: anchor is 105.5, not a whole number"),
        ("Input", "range2 0.25 1.5", "range2 0.25", "line 2: 7 columns, not 8"),
        ("Input", "range2 0.25", "range2 0.1", "line 2: the time is before"),
        ("Input", "0.5 0 0.125", "0.5 0 0", "line 5: the distance between the wheels is not"),
        ("Input", "0.25 0.25 0.5", "0.25 nan 0.5", "line 5: wheel_1 is not a finite number"),
        ("GT", "point2 0.25 0.75", "point2 0.25 x", "line 3: x is 'x', not a number"),
        ("GT", "point2 0.0", "point3 0.0", "line 1: begins with 'point3', not point2"),
    ],
)
def test_damage_is_located(tmp_path: Path, file: str, old: str, new: str, reason: str) -> None:
    content = FILES[f"Yard_{file}.txt"]
    assert content.count(old) == 1
    with pytest.raises(DataError) as caught:
        load_tuc(write(tmp_path / "x", **{file: content.replace(old, new)}))
    assert f"Yard_{file}.txt, {reason}" in str(caught.value)


@pytest.mark.parametrize("name", sorted(FILES))
def test_missing_file(tmp_path: Path, name: str) -> None:
    stem = write(tmp_path / "x")
    (tmp_path / "x" / name).unlink()
    with pytest.raises(DataError, match=f"{name}: no such file"):
        load_tuc(stem)


def test_no_ranges(tmp_path: Path) -> None:
    odometry = "odom2diff 0.25 0.25 0.5 0 0.125 0.1 0.1 0.1 \n"
    with pytest.raises(DataError, match=r"Yard_Input\.txt: no data"):
        load_tuc(write(tmp_path / "x", Input=odometry))


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_any_damage_is_read_or_a_data_error(
    tmp_path_factory: pytest.TempPathFactory,
    survives: Callable[[Callable[[], Recording]], None],
    damaged: Callable[[st.DataObject, str], str],
    data: st.DataObject,
) -> None:
    name = data.draw(st.sampled_from(["Input", "GT"]))
    content = FILES[f"Yard_{name}.txt"]
    changed = damaged(data, content)
    stem = write(tmp_path_factory.mktemp("damaged"), **{name: changed})
    survives(lambda: load_tuc(stem))
