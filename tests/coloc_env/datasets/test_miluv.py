"""MILUV files in miniature: exchanges, frames, truth that jumps, and what is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coloc_env.datasets import DataError, Recording, load_miluv

EXPERIMENT = "flight_2_random_0b"
CONFIG = {
    "experiments.csv": f"experiment,num_robots,anchor_constellation\n{EXPERIMENT},2,0b\n",
    "uwb/anchors.yaml": '"0":\n    "0": "[9, 9, 9]"\n"0b":\n    "2": "[3.0, 0.0, 1.0]"\n'
    '    "10": "[1.0, 2.0, 3.0]"\n',
    "uwb/tags.yaml": 'ifo001:\n  "11": "[0.1, 0.2, 0.3]"\n  "100": "[-0.1, 0.2, 0.3]"\n'
    'ifo002:\n  "20": "[0.4, 0.5, 0.6]"\n',
    "height/bias.yaml": 'ifo001:\n  "-0.1"\n\nifo002:\n  "0.2"\n',
    **{
        f"realsense/{robot}/extrinsics_{imu}imu.yaml": f"cam0:\n  T_cam_imu:\n{matrix}"
        for robot in ("ifo001", "ifo002")
        for imu, matrix in (
            ("px4", "  - [0, -1, 0, 0]\n  - [0, 0, -1, 0]\n  - [1, 0, 0, 0]\n  - [0, 0, 0, 1]\n"),
            ("cam", "  - [1, 0, 0, 0]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n"),
        )
    },
}
MOCAP = "timestamp," + ",".join(f"pose.position.{axis}" for axis in "xyz") + ","
MOCAP += ",".join(f"pose.orientation.{axis}" for axis in "xyzw") + "\n"
IMU = "timestamp," + ",".join(f"angular_velocity.{axis}" for axis in "xyz") + ","
IMU += ",".join(f"linear_acceleration.{axis}" for axis in "xyz") + "\n"
UWB = "range,from_id,to_id,pair,range_raw,timestamp\n"
SHARED = '4.5,100,20,"(100, 20)",4.6,1.5\n'
ROBOT = {
    "mocap.csv": MOCAP + "0.5,1,2,3,0,0,0,1\n0.51,1,2,3,0,0,0.01,0.99995\n",
    "imu_px4.csv": IMU + "0.25,1,2,3,4,5,6\n",
    "imu_cam.csv": IMU + "0.125,1,2,3,4,5,6\n",
    "height.csv": "timestamp,range\n0.5,1.25\n",
    "mag.csv": "timestamp,magnetic_field.x,magnetic_field.y,magnetic_field.z\n0.5,1e-5,2e-5,3e-5\n",
}
FILES = {
    **{f"config/{name}": content for name, content in CONFIG.items()},
    **{f"{EXPERIMENT}/ifo001/{name}": content for name, content in ROBOT.items()},
    **{f"{EXPERIMENT}/ifo002/{name}": content for name, content in ROBOT.items()},
    f"{EXPERIMENT}/ifo001/uwb_range.csv": UWB + '1.5,11,10,"(11, 10)",1.6,1.0\n' + SHARED,
    f"{EXPERIMENT}/ifo002/uwb_range.csv": UWB + SHARED + '2.5,20,2,"(20, 2)",2.6,2.0\n',
}
Writer = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Writer:
    monkeypatch.setenv("COLOC_CACHE", str(tmp_path / "cache"))

    def writer(changes: dict[str, str | None] | None = None) -> Path:
        for name, content in {**FILES, **(changes or {})}.items():
            if content is not None:
                path = tmp_path / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(content, encoding="utf-8")
        return tmp_path / EXPERIMENT

    return writer


def test_what_is_read(write: Writer) -> None:
    recording = load_miluv(write())
    assert recording.name == f"miluv/{EXPERIMENT}"
    assert (recording.dim, recording.robots) == (3, ("ifo001", "ifo002"))
    assert recording.anchors.tolist() == [[3, 0, 1], [1, 2, 3]]
    assert recording.tags[0].tolist() == [[0.1, 0.2, 0.3], [-0.1, 0.2, 0.3]]
    assert recording.tags[1, 0].tolist() == [0.4, 0.5, 0.6]
    assert np.isnan(recording.tags[1, 1]).all()
    track = recording.truth[0]
    assert track.time.tolist() == [500_000_000, 510_000_000]
    assert track.position[0].tolist() == [1, 2, 3]
    np.testing.assert_allclose(track.attitude[1], [0.99995, 0, 0, 0.01], atol=1e-6)
    heights = [table.values.item() for table in recording.streams["height"]]
    np.testing.assert_allclose(heights, [1.35, 1.05])
    assert recording.streams["magnetometer"][1].values.tolist() == [[1e-5, 2e-5, 3e-5]]
    assert recording.streams["imu"][0].time.tolist() == [250_000_000]
    assert recording.streams["imu"][0].values.tolist() == [[1, 2, 3, 4, 5, 6]]


def test_camera_imu_is_turned(write: Writer) -> None:
    imu = load_miluv(write(), imu="camera").streams["imu"][0]
    assert imu.time.tolist() == [125_000_000]
    assert imu.values.tolist() == [[3, -1, -2, 6, -4, -5]]


@pytest.mark.parametrize(("ranges", "more"), [("calibrated", 0.0), ("raw", 0.1)])
def test_exchanges_enter_each_end_once(write: Writer, ranges: str, more: float) -> None:
    streams = load_miluv(write(), ranges=ranges).streams  # type: ignore[arg-type]
    first, second = streams["uav_ranges"]
    assert first.columns == ("own_tag", "robot", "tag", "range")
    assert first.time.tolist() == second.time.tolist() == [1_500_000_000]
    np.testing.assert_allclose(first.values, [[1, 1, 0, 4.5 + more]])
    np.testing.assert_allclose(second.values, [[0, 0, 1, 4.5 + more]])
    first, second = streams["anchor_ranges"]
    assert first.columns == ("own_tag", "anchor", "range")
    np.testing.assert_allclose(first.values, [[0, 1, 1.5 + more]])
    np.testing.assert_allclose(second.values, [[0, 0, 2.5 + more]])


def test_streams_that_nobody_has(write: Writer) -> None:
    away = [f"{EXPERIMENT}/{robot}/{file}" for robot in ("ifo001", "ifo002") for file in ROBOT]
    changes = dict.fromkeys(name for name in away if not name.endswith("mocap.csv"))
    changes |= {"config/height/bias.yaml": None}
    assert set(load_miluv(write(changes)).streams) == {"uav_ranges", "anchor_ranges"}


def test_truth_that_jumps_is_dropped(write: Writer) -> None:
    good, wrong = "0,0,0,1", "0.9,0,0.3,0.3162277660168379"
    wrongs = {150, 151, 153, 154}
    rows = [f"{k / 100},1,2,3,{wrong if k in wrongs else good}\n" for k in range(300)]
    mocap = {f"{EXPERIMENT}/ifo001/mocap.csv": MOCAP + "".join(rows)}
    track = load_miluv(write(mocap)).truth[0]
    kept = [k * 10_000_000 for k in range(300) if not 150 <= k <= 154]
    assert track.time.tolist() == kept
    mocap = {f"{EXPERIMENT}/ifo001/mocap.csv": MOCAP + "".join(rows[149:151])}
    with pytest.raises(DataError, match=r"mocap\.csv: the attitude jumps"):
        load_miluv(write(mocap))


UWB_1, BIAS = f"{EXPERIMENT}/ifo001/uwb_range.csv", "config/height/bias.yaml"
TAGS, ANCHORS = "config/uwb/tags.yaml", "config/uwb/anchors.yaml"


@pytest.mark.parametrize(
    ("file", "old", "new", "reason"),
    [
        (UWB_1, "4.5,100,20", "4.5,100,21", "line 3: to_id 21 is not in the config"),
        (UWB_1, "1.5,11,10,", "1.5,2,10,", "line 2: from_id 2 is not in the config"),
        (UWB_1, "1.5,11,10,", "1.5,11.5,10,", "line 2: from_id is 11.5, not a whole number"),
        (UWB_1, "4.6,1.5", "4.6", "line 3: 5 columns, not 6"),
        (UWB_1, "range,from_id", "distance,from_id", "line 1: the header does not name one column"),
        (f"{EXPERIMENT}/ifo002/mocap.csv", "0,0,0,1\n", "0,0,0,0\n", "line 2: the quaternion has"),
        (f"{EXPERIMENT}/ifo002/mocap.csv", "0.51", "0.41", "line 3: the time is before"),
        (
            f"{EXPERIMENT}/ifo002/imu_px4.csv",
            "4,5,6",
            "4,,6",
            "line 2: linear_acceleration.y is ''",
        ),
        (
            "config/experiments.csv",
            EXPERIMENT,
            "other",
            f"no line for the experiment '{EXPERIMENT}'",
        ),
        ("config/experiments.csv", "anchor_constellation", "x", "no entry 'anchor_constellation'"),
        (ANCHORS, '"0b"', '"1"', "anchors.yaml: not a MILUV configuration: no entry '0b'"),
        (ANCHORS, "[3.0, 0.0, 1.0]", "[3.0, 0.0]", "anchors.yaml: not a MILUV configuration"),
        (ANCHORS, "[3.0, 0.0, 1.0]", "[3.0, 0.0, .nan]", "0b: (3, 0, nan) is no place"),
        (TAGS, "ifo002:", "ifo003:", "tags.yaml: not a MILUV configuration: no entry 'ifo002'"),
        (TAGS, '"20"', '"twenty"', "tags.yaml: not a MILUV configuration: invalid literal"),
        (TAGS, "ifo002:", "ifo002: {", "tags.yaml: not a MILUV configuration"),
        (BIAS, '"0.2"', '"low"', "bias.yaml: not a MILUV configuration: could not convert"),
    ],
)
def test_damage_is_located(write: Writer, file: str, old: str, new: str, reason: str) -> None:
    assert FILES[file].count(old) == 1
    with pytest.raises(DataError) as caught:
        load_miluv(write({file: FILES[file].replace(old, new)}))
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new"),
    [("T_cam_imu", "T_imu_cam"), ("[1, 0, 0, 0]\n", "[2, 0, 0, 0]\n"), ("cam0:", "cam1:")],
)
def test_extrinsics_that_are_none(write: Writer, old: str, new: str) -> None:
    file = "config/realsense/ifo002/extrinsics_camimu.yaml"
    changes = {file: FILES[file].replace(old, new)}
    with pytest.raises(DataError, match=r"ifo002/extrinsics_camimu\.yaml"):
        load_miluv(write(changes), imu="camera")


@pytest.mark.parametrize(
    "file",
    [*(f"config/{name}" for name in list(CONFIG)[:4]), UWB_1, f"{EXPERIMENT}/ifo001/mag.csv"],
)
def test_missing_file(write: Writer, file: str) -> None:
    with pytest.raises(DataError, match=f"{file}: no such file"):
        load_miluv(write({file: None}))


def test_no_experiment(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no robot's folder"):
        load_miluv(tmp_path)


def test_config_elsewhere(write: Writer, tmp_path: Path) -> None:
    folder = write()
    (tmp_path / "config").rename(tmp_path / "moved")
    assert load_miluv(folder, tmp_path / "moved").anchors.shape == (2, 3)


@pytest.mark.parametrize("option", [{"imu": "phone"}, {"ranges": "corrected"}])
def test_unknown_option(write: Writer, option: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="not one of"):
        load_miluv(write(), **option)  # type: ignore[arg-type]


@pytest.mark.parametrize("value", ["", "-1", "0", "nan", "inf", "1e308", "301"])
def test_what_is_no_range_is_left_out_and_counted(write: Writer, value: str) -> None:
    ranges, height = (f"{EXPERIMENT}/ifo001/{name}" for name in ("uwb_range.csv", "height.csv"))
    changes = {
        ranges: FILES[ranges].replace("1.5,11,10", f"{value},11,10"),
        height: FILES[height].replace("1.25", value),
    }
    recording = load_miluv(write(changes))
    assert recording.dropped == {"uav_ranges": 0, "anchor_ranges": 1, "height": 1}
    assert [len(table.time) for table in recording.streams["anchor_ranges"]] == [0, 1]
    assert [len(table.time) for table in recording.streams["height"]] == [0, 1]


def test_a_missing_robot(write: Writer) -> None:
    folder = write()
    (folder / "ifo002" / "mocap.csv").unlink()
    with pytest.raises(DataError, match=r"ifo002/mocap\.csv: no such file"):
        load_miluv(folder)
    for path in (folder / "ifo002").iterdir():
        path.unlink()
    with pytest.raises(DataError, match=r"experiments\.csv: .* has 2 robots, found are ifo001"):
        load_miluv(folder)


def test_a_robot_without_ranges(write: Writer) -> None:
    recording = load_miluv(write({f"{EXPERIMENT}/ifo002/uwb_range.csv": UWB}))
    assert [len(table.time) for table in recording.streams["anchor_ranges"]] == [1, 0]


def test_a_configuration_that_nests_without_end(write: Writer) -> None:
    deep = "ifo001: " + 5000 * "[" + 5000 * "]"
    with pytest.raises(DataError, match=r"bias\.yaml: not a MILUV configuration"):
        load_miluv(write({"config/height/bias.yaml": deep}))


@pytest.mark.slow
@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_damage_is_read_or_a_data_error(
    write: Writer,
    survives: Callable[[Callable[[], Recording]], None],
    damaged: Callable[[st.DataObject, str], str],
    data: st.DataObject,
) -> None:
    name = data.draw(st.sampled_from(sorted(FILES)))
    folder = write({name: damaged(data, FILES[name])})
    survives(lambda: load_miluv(folder))
