"""Finding sequences in the data folder."""

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from coloc_env import datasets
from coloc_env.datasets import DataError, Recording, Table, Track, load, sequences

POSE = "0,0,0,1,0,0,0,0,0,0,0,0,0,0,0,0"
FLIGHT = {"imu0.csv": "#\n1000,0,0,0,0,0,9.8\n", "groundtruth.csv": f"#\n1000,{POSE}\n"}
WALK = {
    "trajectory.csv": "timestamp,x,y,heading_degrees\n1000,0,0,0\n",
    "A3.csv": "%time,field.stamp,field.id,field.x,field.y,field.z,field.distanceFromTag\n"
    "1000,1000,3,1,2,1.1,3\n",
}
LABYRINTH = {
    f"{name}_{kind}.txt": content
    for name in ("b", "a")
    for kind, content in {
        "Input": "range2 0.5 1 0.01 0 0 105 0\nodom2diff 0.5 0 0 0 0.1 0 0 0\n",
        "GT": "point2 0.5 0 0 0 0 0 0\n",
    }.items()
}
ENDS = [f"{end}_{n}" for end in "AB" for n in ("x", "y", "z", "roll", "pitch", "yaw")]
BETWEEN = [f"{i}_{j}" for i in range(1, 7) for j in range(1, 7)]
RANGED = ",".join(("t", *ENDS, *BETWEEN)) + "\n0.0" + ",1.0" * 48 + "\n"
DRIVE = {"Barcodes.dat": "1 5\n2 6\n9 7\n", "Landmark_Groundtruth.dat": "9 0 0 0 0\n"}


def drive(robots: int) -> dict[str, str]:
    kinds = {"Groundtruth": "1.5 0 0 0\n", "Odometry": "1.5 0 0\n", "Measurement": "1.5 7 1 0\n"}
    return DRIVE | {
        f"Robot{robot}_{kind}.dat": content
        for robot in range(1, robots + 1)
        for kind, content in kinds.items()
    }


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))
    root = tmp_path / "data"
    monkeypatch.setenv("COLOC_DATA", str(root))
    contents = {f"euroc/{name}": FLIGHT for name in ("MH_01", "MH_02", "V1_01", "V1_02", "V2_01")}
    contents |= {"mrclam/a": drive(1), "mrclam/b": drive(2), "mrclam/c": drive(2)}
    contents |= {"mrclam/other": {"readme.txt": "nothing"}, "miluv": {"readme.txt": "nothing"}}
    cases = ("NLOS/Trajectory_A/Case_1", "LOS/Trajectory_B/Case_3", "LOS/Trajectory_B/Case_4")
    contents |= {f"hanyang_outdoor_uwb/{case}": WALK for case in cases}
    for trial, agents in (("02", 2), ("03", 3), ("04", 3)):
        pairs = permutations(range(1, agents + 1), 2)
        names = [f"{trial}_base-{a}_targ-{b}_win-1_step-1.csv" for a, b in pairs]
        contents[f"murp/parsed/{trial}"] = dict.fromkeys(names, RANGED)
    contents["tuc_indoor_uwb"] = LABYRINTH | {"c_GT.txt": "", "readme.txt": "nothing"}
    for folder, files in contents.items():
        (root / folder).mkdir(parents=True)
        for name, content in files.items():
            (root / folder / name).write_text(content)
    return root


def test_sequences(data: Path) -> None:
    assert sequences("mrclam") == ("a", "b", "c")
    assert sequences("euroc", data) == ("MH_01", "MH_02", "V1_01", "V1_02", "V2_01")
    assert sequences("miluv") == ()
    assert sequences("tuc") == ("a", "b")
    assert sequences("murp") == ("02", "03", "04")
    cases = ("LOS/Trajectory_B/Case_3", "LOS/Trajectory_B/Case_4", "NLOS/Trajectory_A/Case_1")
    assert sequences("hanyang") == cases


@pytest.mark.parametrize(
    ("name", "sequence", "loaded"),
    [
        ("mrclam", None, "mrclam/b"),
        ("mrclam", "c", "mrclam/c"),
        ("euroc", None, "euroc/MH_01+MH_02"),
        ("euroc", "V1_02", "euroc/V1_02"),
        ("euroc", "V1_02,V1_01", "euroc/V1_02+V1_01"),
        ("tuc", None, "tuc/a"),
        ("tuc", "b", "tuc/b"),
        ("murp", None, "murp/03"),
        ("murp", "02", "murp/02"),
        ("hanyang", None, "hanyang/LOS/Trajectory_B/Case_3"),
        ("hanyang", "NLOS/Trajectory_A/Case_1", "hanyang/NLOS/Trajectory_A/Case_1"),
    ],
)
def test_which_is_loaded(data: Path, name: str, sequence: str | None, loaded: str) -> None:
    assert load(name, sequence).name == loaded
    assert load(name, sequence, data).name == loaded


@pytest.mark.parametrize(
    ("name", "sequence", "reason"),
    [
        (
            "tum",
            None,
            "no dataset 'tum', there are: mrclam, euroc, miluv, tuc, hanyang, tiers, murp",
        ),
        ("mrclam", "d", "no sequence 'd' in .*mrclam, there are: a, b, c"),
        ("mrclam", "a,b", "one sequence at a time, not a,b"),
        ("euroc", "V1_01,V9", "no sequence 'V9'"),
        ("euroc", "V1_01,V2_01", "different sequences of one room"),
        ("miluv", None, "no sequence of miluv in"),
        ("tuc", "c", "no sequence 'c' in .*tuc_indoor_uwb, there are: a, b"),
        ("hanyang", "LOS/Trajectory_B", "no sequence 'LOS/Trajectory_B' in .*, there are: LOS/Tra"),
        ("miluv", "x", "no sequence 'x' in .*miluv, there are: none"),
    ],
)
def test_what_is_not_there(data: Path, name: str, sequence: str | None, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        load(name, sequence)


def test_no_data(data: Path) -> None:
    for name in datasets.DATASETS:
        with pytest.raises(DataError, match=f"away: set COLOC_DATA or --data .*{name}.*/ \\(from"):
            load(name, data=data / "away")
    (data / "miluv" / "readme.txt").unlink()
    (data / "miluv").rmdir()
    with pytest.raises(DataError, match=r"no recordings in .*miluv: set COLOC_DATA or --data"):
        load("miluv")


def test_unknown_option(data: Path) -> None:
    with pytest.raises(TypeError, match="imu"):
        load("mrclam", imu="px4")


def test_recordings_that_contradict_themselves() -> None:
    time = np.array([0, 1])
    with pytest.raises(ValueError, match="does not increase"):
        Track(np.array([1, 1]), np.zeros((2, 2)), np.zeros((2, 1)))
    with pytest.raises(ValueError, match=r"Track\.attitude has shape \(2, 1\), not \(2, 4\)"):
        Track(time, np.zeros((2, 3)), np.zeros((2, 1)))
    with pytest.raises(ValueError, match="does not increase"):
        Table(time[::-1].copy(), np.zeros((2, 1)), ("height",))
    with pytest.raises(ValueError, match="not int64"):
        Table(time * 1.0, np.zeros((2, 1)), ("height",))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="columns"):
        Table(time, np.zeros((2, 2)), ("height",))
    track = Track(time, np.zeros((2, 2)), np.zeros((2, 1)))
    points = np.zeros((0, 2))
    with pytest.raises(ValueError, match="holds 1 robots, not 2"):
        Recording("x", 2, ("a", "b"), (track,), {}, points, points, np.zeros((2, 0, 2)), "")
    with pytest.raises(ValueError, match="tags"):
        Recording("x", 2, ("a",), (track,), {}, points, points, np.zeros((2, 0, 2)), "")
    with pytest.raises(ValueError, match="anchors"):
        Recording("x", 2, ("a",), (track,), {}, points, np.zeros((0, 3)), np.zeros((1, 0, 2)), "")
    with pytest.raises(ValueError, match="not in 3 dimensions"):
        Recording("x", 3, ("a",), (track,), {}, points, points, np.zeros((1, 0, 3)), "")
