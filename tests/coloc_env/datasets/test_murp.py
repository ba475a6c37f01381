"""MURP files in miniature: who measured what, what is missing, and what is refused."""

from collections.abc import Callable
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coloc_env.datasets import DataError, Recording, load_murp

POSE = ("x", "y", "z", "roll", "pitch", "yaw")
PAIRS = [f"{own}_{other}" for own in range(1, 7) for other in range(1, 7)]
ANGLES = {1: (0.0, 0.0, 0.0), 2: (3.0, -2.0, 170.0), 3: (-1.0, 4.0, -90.0)}


def rows(base: int, target: int) -> list[dict[str, str]]:
    """Two seconds of one ordered pair; range I_J is base + target / 10 + I / 100 + J / 1000 m."""
    made = []
    for second in range(2):
        row = {"t": f"{float(second)}", "x": "0.5", "r": "1.0"}
        for end, agent in (("A", base), ("B", target)):
            place = (float(agent + second), 2.0 * agent, 0.5)
            numbers = (*place, *ANGLES[agent])
            row |= {f"{end}_{n}": str(v) for n, v in zip(POSE, numbers, strict=True)}
        for pair in PAIRS:
            own, other = map(int, pair.split("_"))
            row[pair] = f"{base + target / 10 + own / 100 + other / 1000:.3f}"
            row[f"{pair}_std"] = ""
        made.append(row)
    return made


def text(base: int, target: int) -> str:
    made = rows(base, target)
    return "\n".join([",".join(made[0]), *(",".join(row.values()) for row in made)]) + "\n"


FILES = {pair: text(*pair) for pair in permutations((1, 2, 3), 2)}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))


def write(folder: Path, files: dict[tuple[int, int], str]) -> Path:
    folder = folder / "07"
    folder.mkdir(exist_ok=True)
    for (base, target), content in files.items():
        (folder / f"07_base-{base}_targ-{target}_win-1_step-1.csv").write_text(
            content, encoding="utf-8"
        )
    return folder


def test_what_is_read(tmp_path: Path) -> None:
    recording = load_murp(write(tmp_path, FILES))
    assert recording.name == "murp/07"
    assert (recording.dim, recording.robots) == (3, ("agent1", "agent2", "agent3"))
    for agent, track in enumerate(recording.truth, 1):
        assert track.time.tolist() == [0, 1_000_000_000]
        assert track.position.tolist() == [[agent, 2 * agent, 0.5], [agent + 1, 2 * agent, 0.5]]
        roll, pitch, yaw = ANGLES[agent]
        turned = Rotation.from_euler("ZYX", (yaw, pitch, roll), degrees=True)
        stated = Rotation.from_quat(track.attitude, scalar_first=True)
        assert (turned.inv() * stated).magnitude().max() < 1e-12
    np.testing.assert_allclose(recording.tags[1, 1], (0, 0.32, 0), atol=1e-12)
    np.testing.assert_allclose(recording.tags[2, 5], (0.2771, -0.16, 0), atol=1e-4)


def test_each_agent_holds_what_it_measured_as_base(tmp_path: Path) -> None:
    recording = load_murp(write(tmp_path, FILES))
    for agent, table in enumerate(recording.streams["uav_ranges"], 1):
        assert table.columns == ("own_tag", "robot", "tag", "range")
        own, robot, tag, measured = table.values.T
        assert len(measured) == 2 * 2 * 36
        assert set(robot) == {0, 1, 2} - {agent - 1}
        expected = agent + (robot + 1) / 10 + (own + 1) / 100 + (tag + 1) / 1000
        np.testing.assert_allclose(measured, expected)
        assert table.time.tolist() == [0] * 72 + [1_000_000_000] * 72


def test_an_empty_range_is_none_and_a_zero_is_left_out(tmp_path: Path) -> None:
    content = FILES[2, 3].replace("2.344", "", 1).replace("2.355", "0.0", 1)
    recording = load_murp(write(tmp_path, FILES | {(2, 3): content}))
    table = recording.streams["uav_ranges"][1]
    assert len(table.time) == 2 * 2 * 36 - 2
    assert recording.dropped == {"uav_ranges": 1}
    missing = (table.time == 0) & (table.values[:, 0] == 3) & (table.values[:, 1] == 2)
    assert set(table.values[missing, 2]) == {0, 1, 2, 4, 5}


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("A_yaw", "yaw", "line 1: the header does not name one column 'A_yaw'"),
        (",4_4,", ",4_7,", "line 1: the header does not name one column '4_4'"),
        ("\n1.0,0.5,1.0,3.0", "\n1.0,0.5,1.0,3.5", "line 3: agent 2 is elsewhere"),
        ("\n1.0,0.5,1.0,3.0", "\n1.0,0.5,1.0,", "line 3: A_x is '', not a number"),
        ("\n1.0,0.5,1.0,3.0", "\n2.0,0.5,1.0,3.0", "its stamps are not those of 07_base-1_targ-2"),
        ("\n0.0,", "\n3.0,", "line 3: the time is before"),
        ("\n0.0,0.5,", "\n0.0,", "line 2: 86 columns, not 87"),
    ],
)
def test_damage_is_located(tmp_path: Path, old: str, new: str, reason: str) -> None:
    content = FILES[2, 3]
    assert content.count(old) == 1
    with pytest.raises(DataError) as caught:
        load_murp(write(tmp_path, FILES | {(2, 3): content.replace(old, new)}))
    assert "07_base-2_targ-3_win-1_step-1.csv" in str(caught.value)
    assert reason in str(caught.value)


def test_a_range_is_a_number(tmp_path: Path) -> None:
    content = FILES[2, 3].replace("2.344", "far", 1)
    with pytest.raises(DataError, match="line 2: 4_4 is 'far', not a number"):
        load_murp(write(tmp_path, FILES | {(2, 3): content}))


@pytest.mark.parametrize("value", ["-0.1", "inf", "1e308", "301"])
def test_what_is_no_range_is_left_out_and_counted(tmp_path: Path, value: str) -> None:
    content = FILES[2, 3].replace("2.344", value, 1)
    recording = load_murp(write(tmp_path, FILES | {(2, 3): content}))
    assert recording.dropped == {"uav_ranges": 1}
    assert len(recording.streams["uav_ranges"][1].time) == 2 * 2 * 36 - 1


def test_missing_files(tmp_path: Path) -> None:
    folder = write(tmp_path, FILES)
    (folder / "07_base-3_targ-1_win-1_step-1.csv").unlink()
    with pytest.raises(DataError, match=r"07_base-3_targ-1_win-1_step-1\.csv: no such file"):
        load_murp(folder)
    for path in folder.glob("*.csv"):
        path.unlink()
    with pytest.raises(DataError, match=r"07: no TRIAL_base-A_targ-B_win-1_step-1\.csv of two"):
        load_murp(folder)


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_any_damage_is_read_or_a_data_error(
    tmp_path_factory: pytest.TempPathFactory,
    survives: Callable[[Callable[[], Recording]], None],
    damaged: Callable[[st.DataObject, str], str],
    data: st.DataObject,
) -> None:
    content = FILES[1, 3]
    changed = damaged(data, content)
    folder = write(tmp_path_factory.mktemp("damaged"), FILES | {(1, 3): changed})
    survives(lambda: load_murp(folder))
