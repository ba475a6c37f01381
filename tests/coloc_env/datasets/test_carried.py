"""Recorded time differences, angles and flow: read, refused, delivered, and localized by."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from agents import make
from agents.online import OnlineLocalizer
from coloc_env.datasets import DataError, Recording
from coloc_env.datasets.check import check
from coloc_env.datasets.open_format import read_recording
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import ArrivalAngles, Height, OpticalFlow, PositionFix, Tdoa
from coloc_env.world import World
from tests.agents.live_events import events_of, replayed
from tests.coloc_env.datasets.folders_made import Folder, swarm, table, write
from training.calibration.calibrate import calibrate


def read(home: Path, files: Folder) -> Recording:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_recording(write(home, files))


def changed(**more: str) -> Folder:
    files = swarm()
    for name, text in more.items():
        files[f"a/{name}.csv"] = text
    return files


def test_what_is_written_is_what_is_read(tmp_path: Path) -> None:
    found = read(
        tmp_path,
        changed(
            tdoa="stamp,difference,from,to\n0.1,-1.5,up,north\n0.2,,up,north\n0.3,2e3,up,north\n",
            angles="stamp,robot,azimuth,elevation\n0.1,b,4,-0.5\n0.2,b,nan,0\n",
            flow="stamp,vy,vx\n0.1,1,-2\n0.2,inf,0\n",
        ),
    )
    tdoa, angles, flow = (found.streams[s][0] for s in ("tdoa", "arrival_angles", "flow"))
    assert tdoa.values.tolist() == [[0, 2, 0, -1.5]]
    np.testing.assert_allclose(angles.values, [[1, 4 - 2 * np.pi, -0.5]])
    assert flow.values.tolist() == [[-2, 1]]
    assert found.dropped == {"tdoa": 2, "arrival_angles": 1, "flow": 1}


def test_bodies_that_look_down_are_turned(tmp_path: Path) -> None:
    files = swarm()
    files["recording.yaml"] += "frame: ned\nunits: {angle: deg}\n"
    files["a/angles.csv"] = "stamp,robot,azimuth,elevation\n0.1,b,90,-30\n"
    files["b/angles.csv"] = files["a/angles.csv"].replace(",b,", ",a,")
    files["a/flow.csv"] = "stamp,vx,vy\n0.1,1,2\n"
    found = read(tmp_path, files)
    np.testing.assert_allclose(
        found.streams["arrival_angles"][0].values, [[1, -np.pi / 2, np.pi / 6]]
    )
    assert found.streams["flow"][0].values.tolist() == [[1, -2]]


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("tdoa", "stamp,from,to,difference\n0,up,up,1\n", "line 2, column to: 'up' is from itself"),
        ("tdoa", "stamp,from,to,difference\n0,up,b,1\n", "line 2, column to: 'b' is none of north"),
        ("tdoa", "stamp,from,to,difference,own_tag\n0,up,north,1,3\n", "3 is no tag from 0 to 0"),
        ("tdoa", "stamp,from,to\n0,up,north\n", "there is no column 'difference'"),
        ("angles", "stamp,robot,azimuth,elevation\n0,b,7,0\n", "azimuth: 7 is more than a whole"),
        ("angles", "stamp,robot,azimuth,elevation\n0,b,1,2\n", "elevation: 2 is more than upright"),
        ("angles", "stamp,robot,azimuth,elevation\n0,a,1,0\n", "'a' is the robot itself"),
        ("flow", "stamp,vx\n0,1\n", "there is no column 'vy'"),
    ],
)
def test_what_cannot_be_is_refused(name: str, text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=words) as error:
        read(tmp_path, changed(**{name: text}))
    assert f"a/{name}.csv" in str(error.value)


@pytest.mark.parametrize("name", ["angles", "flow"])
def test_what_is_of_space_is_refused_in_the_plane(name: str, tmp_path: Path) -> None:
    files = {
        "recording.yaml": "dim: 2\nrobots: [a, b]\n",
        "a/truth.csv": "stamp,x,y\n0,0,0\n1,1,0\n",
        "b/truth.csv": "stamp,x,y\n0,0,0\n1,1,0\n",
        f"a/{name}.csv": swarm()[f"a/{name}.csv"],
    }
    with pytest.raises(DataError, match="for 3 dimensions"):
        read(tmp_path, files)


def test_a_mirror_image_is_warned_of_and_no_robot_is_lost(tmp_path: Path) -> None:
    """Three anchors in space; b hears them, a only knows in which direction he is."""
    files = swarm()
    del files["a/tdoa.csv"]
    words = check(read(tmp_path / "one", files)).warnings
    assert any("a mirror image fits as well" in text for text in words)
    assert not any("nothing shows where" in text for text in words)
    for name in "ab":
        del files[f"{name}/angles.csv"]
    words = check(read(tmp_path / "two", files)).warnings
    assert any("nothing shows where a is" in text for text in words)


# ---------------------------------------------------------------- a recording of a simulated team


def simulated(home: Path) -> Path:
    """The recording of three UAVs of ``indoor-v0`` that carry everything, 8 s of it."""
    scenario = make_scenario(
        "indoor-v0", n_uavs=3, landmarks=0, uwb=False, tdoa_anchors=8, angles=True, flow=True,
        barometer=True, barometer_drift=0.3, gnss=True, dt=0.1,
    )  # fmt: skip
    (tdoa,) = (s for s in scenario.sensors if isinstance(s, Tdoa))
    world, names = World(scenario), ["a", "b", "c"]
    rows: dict[str, list[list[Any]]] = {}
    seen = world.reset(7)
    for k in range(80):
        t, truth = f"{k / 10:.1f}", world.truth
        for i, name in enumerate(names):

            def put(file: str, *cells: Any, name: str = name, t: str = t) -> None:
                rows.setdefault(f"{name}/{file}", []).append([t, *cells])

            leaf = {key: value[0, i].tolist() for key, value in seen.leaves.items()}
            q = truth.attitude[0, i].tolist()
            put("truth", *truth.position[0, i].tolist(), *q[1:], q[0])
            put("imu", *leaf["imu"][3:], *leaf["imu"][:3])
            for m, n, z in zip(*tdoa.ends, leaf["tdoa"], strict=True):
                put("tdoa", f"n{m}", f"n{n}", z)
            for j, other in enumerate(names):
                if leaf["arrival_angle_mask"][j]:
                    put("angles", other, *leaf["arrival_angles"][2 * j : 2 * j + 2])
            put("flow", *leaf["flow"])
            put("height", *leaf["height"])
            put("position_fix", *leaf["position_fix"])
        world.advance(torch.zeros(1, 3, 9))
        seen = world.observation()
    heads = {
        "truth": "x,y,z,qx,qy,qz,qw",
        "imu": "gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z",
        "tdoa": "from,to,difference",
        "angles": "robot,azimuth,elevation",
        "flow": "vx,vy",
        "height": "height",
        "position_fix": "x,y,z",
    }
    files = {f"{k}.csv": table(f"stamp,{heads[k.split('/')[1]]}", v) for k, v in rows.items()}
    about = {
        "dim": 3,
        "robots": names,
        "map": {"anchors": {f"n{m}": list(place) for m, place in enumerate(tdoa.anchors)}},
        "streams": ["imu", "tdoa", "arrival_angles", "height", "position_fix", "flow"],
        "believed": {
            "height": {"std": 0.1, "drift": 0.3, "drift_time": 300},
            "position_fix": {"std": 1.0, "vertical_std": 2.0},
        },
    }
    files["recording.yaml"] = yaml.safe_dump(about)
    return write(home, files)


@pytest.mark.slow
def test_a_recorded_team_is_believed_and_localized(tmp_path: Path) -> None:
    """What was simulated is what is replayed, and the joint filter is as good on it."""
    scenario = make_scenario("replay-v0", path=str(simulated(tmp_path)), dt=0.1)
    believed = {type(sensor): sensor for sensor in scenario.believed.sensors}
    assert believed[PositionFix] == PositionFix(1.0, 3, 2.0)
    assert believed[Height] == Height(0.1, 0.0, 0.3, 300.0, estimated=True)
    assert {Tdoa, ArrivalAngles, OpticalFlow} <= believed.keys()
    world, localizer = World(scenario), make("ekf_joint", scenario)
    seen = world.reset(0)
    pairs = believed[Tdoa].pairs
    q, ring = pairs.index((0, 7)), (7, 0)
    far = [
        (world.truth.position[0, 0] - torch.tensor(believed[Tdoa].anchors[m])).norm() for m in ring
    ]
    assert float(seen["tdoa"][0, 0, q]) == pytest.approx(float(far[0] - far[1]), abs=0.8)
    belief, squared = localizer.reset(seen), []
    for _ in range(scenario.horizon):
        belief, estimate = localizer.step(belief, seen)
        squared.append((estimate.position - world.truth.position).square().sum(-1))
        world.advance(estimate.action())
        seen = world.observation()
    assert float(torch.stack(squared)[20:].mean().sqrt()) < 0.2


@pytest.mark.slow
def test_calibration_finds_the_noise(tmp_path: Path) -> None:
    """As it was simulated: 0.15 m, 0.05 rad, 0.1 m/s."""
    found = calibrate(read_recording(simulated(tmp_path)))
    assert found.model.tdoa.std == pytest.approx(0.15, rel=0.1)
    assert found.model.arrival_angles.azimuth_std == pytest.approx(0.05, rel=0.25)
    assert found.model.arrival_angles.elevation_std == pytest.approx(0.05, rel=0.25)
    assert found.model.flow.std == pytest.approx(0.1, rel=0.2)
    for name in ("time differences", "azimuth", "elevation", "flow forward", "flow left"):
        noise = found.noises[name]
        assert abs(noise.bias) < 5 * noise.std / noise.count**0.5


@pytest.mark.slow
def test_online_the_numbers_are_those_of_the_replay(tmp_path: Path) -> None:
    folder = simulated(tmp_path)
    start, prior, places, covariances = replayed(folder, "ekf", 0.1, 30)
    online, found = OnlineLocalizer("ekf", folder, start=start, prior=prior), []
    for event in events_of(folder):
        online.add(**event)
        found += online.steps()
    assert len(found) >= len(places)
    for located, place, covariance in zip(found, places, covariances, strict=False):
        np.testing.assert_allclose(located.position, place, atol=1e-6)
        np.testing.assert_allclose(located.covariance, covariance, atol=1e-6)
