"""EuRoC files in miniature: frames, teams, and what is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coloc_env.datasets import DataError, Recording, load, load_euroc

IMU = "#t,w,w,w,a,a,a\n1403715273262142976,1,2,3,9,0.5,-3\n1403715273267142912,1,2,3,9,0.5,-3\n"
POSE = "0.8,2.1,0.9,0.5,-0.5,0.1,-0.7,1,2,3,0.1,0.2,0.3,0.4,0.5,0.6"
TRUTH = (
    f"#t,p,p,p,q,q,q,q,v,v,v,b,b,b,b,b,b\n1403715273265142976,{POSE}\n1403715273267142912,"
    f"{POSE.replace('0.5,-0.5,0.1,-0.7', '-0.5,0.5,-0.1,0.7')}\n"
)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))


def write(folder: Path, imu: str = IMU, truth: str = TRUTH) -> Path:
    folder.mkdir(parents=True)
    (folder / "imu0.csv").write_text(imu, encoding="utf-8")
    (folder / "groundtruth.csv").write_text(truth, encoding="utf-8")
    return folder


def test_frames_agree(tmp_path: Path) -> None:
    recording = load_euroc(write(tmp_path / "V1_01_easy"))
    track, imu = recording.truth[0], recording.streams["imu"][0]
    assert imu.columns == ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
    assert imu.values[0].tolist() == [3, -2, 1, -3, -0.5, 9]
    world = Rotation.from_quat([-0.5, 0.1, -0.7, 0.5]).apply([9, 0.5, -3])
    body = Rotation.from_quat(track.attitude, scalar_first=True).apply(imu.values[0, 3:])
    np.testing.assert_allclose(body, [world, world])
    np.testing.assert_allclose(track.attitude[0], track.attitude[1])
    assert track.velocity is not None
    assert track.gyro_bias is not None
    assert track.accel_bias is not None
    assert track.position[0].tolist() == [0.8, 2.1, 0.9]
    assert track.velocity[0].tolist() == [1, 2, 3]
    assert track.gyro_bias[0].tolist() == [0.3, -0.2, 0.1]
    assert track.accel_bias[0].tolist() == [0.6, -0.5, 0.4]


def test_each_sequence_has_its_own_zero(tmp_path: Path) -> None:
    later = TRUTH.replace("1403715273", "1403715999")
    folders = [
        write(tmp_path / "V1_01_easy"),
        write(tmp_path / "V1_02_medium", IMU.replace("1403715273", "1403715999"), later),
    ]
    recording = load_euroc(folders)
    assert recording.name == "euroc/V1_01_easy+V1_02_medium"
    assert recording.robots == ("V1_01_easy", "V1_02_medium")
    for track, imu in zip(recording.truth, recording.streams["imu"], strict=True):
        assert track.time.tolist() == [0, 1_999_936]
        assert imu.time.tolist() == [-3_000_000, 1_999_936]


def test_layout_as_published(tmp_path: Path) -> None:
    for name, content in (("imu0", IMU), ("state_groundtruth_estimate0", TRUTH)):
        (tmp_path / "V1_01_easy" / "mav0" / name).mkdir(parents=True)
        (tmp_path / "V1_01_easy" / "mav0" / name / "data.csv").write_text(content)
    assert len(load_euroc(tmp_path / "V1_01_easy").truth[0].time) == 2


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"truth": TRUTH.replace("-0.5,0.5,-0.1,0.7", "0,0,0,0")}, "line 3: the quaternion has"),
        ({"truth": IMU}, r"groundtruth.csv, line 2: 7 columns, not 17"),
        ({"imu": TRUTH}, r"imu0.csv, line 2: 17 columns, not 7"),
        ({"imu": "# Time v w\n1248444187.156 \t 0.086 \t -0.398\n"}, "imu0.csv, line 2: 1 columns"),
        ({"imu": IMU.replace("0.5,-3\n14", "0.5,-\n14")}, "line 2: accel_z is '-', not a number"),
        ({"imu": IMU.replace("267142912", "162142912")}, "line 3: the time is before that"),
        ({"imu": IMU[:-10]}, "line 3: 4 columns, not 7"),
        ({"imu": ""}, "imu0.csv: no data"),
    ],
)
def test_damage_is_located(tmp_path: Path, change: dict[str, str], reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        load_euroc(write(tmp_path / "V1_01_easy", **change))


def test_teams_that_are_none(tmp_path: Path) -> None:
    one, other = write(tmp_path / "V1_01_easy"), write(tmp_path / "MH_04_difficult")
    for folders in ([], [one, other], [one, one]):
        with pytest.raises(DataError, match="different sequences of one room"):
            load_euroc(folders)


def test_missing_file(tmp_path: Path) -> None:
    folder = write(tmp_path / "V1_01_easy")
    (folder / "imu0.csv").unlink()
    with pytest.raises(DataError, match=r"imu0\.csv: no such file"):
        load_euroc(folder)


def test_a_missing_truth_is_no_smaller_team(tmp_path: Path) -> None:
    folders = [write(tmp_path / "euroc" / name) for name in ("V1_01_easy", "V1_02_medium")]
    assert load("euroc", data=tmp_path).robots == ("V1_01_easy", "V1_02_medium")
    (folders[1] / "groundtruth.csv").unlink()
    with pytest.raises(DataError, match=r"V1_02_medium/groundtruth\.csv: no such file"):
        load("euroc", data=tmp_path)


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_any_damage_is_read_or_a_data_error(
    tmp_path_factory: pytest.TempPathFactory,
    survives: Callable[[Callable[[], Recording]], None],
    damaged: Callable[[st.DataObject, str], str],
    data: st.DataObject,
) -> None:
    files = {"imu": IMU, "truth": TRUTH}
    name = data.draw(st.sampled_from(sorted(files)))
    files[name] = damaged(data, files[name])
    folder = write(tmp_path_factory.mktemp("damaged") / "V1_01_easy", **files)
    survives(lambda: load_euroc(folder))
