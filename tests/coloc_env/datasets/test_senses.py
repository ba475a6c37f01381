"""Recorded compass, signal strengths, lamps and ultrasound: read, refused, written, replayed."""

import warnings
from dataclasses import replace
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
from coloc_env.datasets.open_format import read_recording, write_recording
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Compass, Light, Rssi, UavRssi, Ultrasonic
from coloc_env.world import World
from tests.agents.live_events import events_of, replayed
from tests.coloc_env.datasets.folders_made import Folder, table, write

NAMES, STEPS = ("a", "b", "c"), 15
LEAVES = (
    "compass", "compass_mask", "rssi", "rssi_mask", "rssi_map", "uav_rssi", "uav_rssi_mask",
    "light", "light_direction", "light_mask", "light_map", "ultrasonic", "ultrasonic_mask",
)  # fmt: skip
IMU = {"accel_std": 0.05, "accel_bias": 0, "gyro_bias": 0, "accel_walk": 0, "gyro_walk": 0}
KINDS = (Compass, Light, Rssi, UavRssi, Ultrasonic)


def small(**tables: str) -> Folder:
    files = {
        "recording.yaml": yaml.safe_dump(
            {
                "dim": 3,
                "robots": ["a", "b"],
                "map": {
                    "lamps": {"left": [0, 0, 3], "right": [5, 0, 3]},
                    "access_points": {"door": [1, 2, 3]},
                    "room": {"low": [0, 0, 0], "high": [6, 5, 3]},
                },
            }
        ),
        "a/truth.csv": "stamp,x,y,z\n0,1,1,1\n1,2,1,1\n",
        "b/truth.csv": "stamp,x,y,z\n0,2,2,1\n1,2,2,1\n",
    }
    return files | {f"a/{name}.csv": text for name, text in tables.items()}


def read(home: Path, files: Folder) -> Recording:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_recording(write(home, files))


TABLES = {
    "compass": "stamp,heading\n0.1,4\n0.2,\n",
    "rssi": "stamp,to,strength\n0.1,door,-50\n0.1,b,-60.5\n0.2,door,nan\n",
    "light": "stamp,lamp,intensity,x,y,z\n0.1,right,200,0,0.6,0.8\n0.2,left,1,0,0,0\n",
    "ultrasonic": "stamp,forward,back,left,right,up,down\n0.1,1,2,,-1,2.5,0.5\n",
}


def test_what_is_written_is_what_is_read(tmp_path: Path) -> None:
    found = read(tmp_path, small(**TABLES))
    values = {name: team[0].values for name, team in found.streams.items()}
    np.testing.assert_allclose(values["compass"], [[4 - 2 * np.pi]])
    assert values["rssi"].tolist() == [[0, -50]]
    assert values["uav_rssi"].tolist() == [[1, -60.5]]
    assert values["light"].tolist() == [[1, 200, 0, 0.6, 0.8]]
    np.testing.assert_array_equal(values["ultrasonic"], [[1, 2, np.nan, np.nan, 2.5, 0.5]])
    assert found.dropped == {"compass": 1, "rssi": 1, "light": 1, "ultrasonic": 1}
    write_recording(found, tmp_path / "again")
    again = read_recording(tmp_path / "again")
    for name, team in found.streams.items():
        assert again.streams[name][0].values.tobytes() == team[0].values.tobytes()
    assert {kind: list(each) for kind, each in again.places.items()} == {
        "lamps": ["left", "right"], "access_points": ["door"], "room": ["low", "high"],
    }  # fmt: skip
    assert again.places["room"]["high"].tolist() == [6, 5, 3]
    assert not any("nothing shows where" in words for words in check(again).warnings)


def test_other_frames_and_units(tmp_path: Path) -> None:
    """North, east, down, in degrees and centimetres; a room's low corner is low in ours."""
    files = small(**TABLES | {"compass": "stamp,heading\n0.1,30\n"})
    files["recording.yaml"] += "frame: ned\nunits: {angle: deg, length: cm}\n"
    found = read(tmp_path, files)
    np.testing.assert_allclose(found.streams["compass"][0].values, [[np.deg2rad(60)]])
    np.testing.assert_allclose(found.streams["light"][0].values, [[1, 200, 0, -0.6, -0.8]])
    assert found.streams["ultrasonic"][0].values[0, 0] == 0.01
    np.testing.assert_allclose(found.places["room"]["low"], [0, 0, -0.03])
    np.testing.assert_allclose(found.places["access_points"]["door"], [0.02, 0.01, -0.03])


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("rssi", "stamp,to,strength\n0,window,-50\n", "'window' is none of a, b, door"),
        ("rssi", "stamp,to,strength\n0,a,-50\n", "'a' is the robot itself"),
        ("light", "stamp,lamp,intensity,x,y,z\n0,up,1,0,0,1\n", "'up' is none of left, right"),
        ("light", "stamp,lamp,intensity,x,y\n0,left,1,0,0\n", "there is no column 'z'"),
        ("ultrasonic", "stamp,forward\n0,1\n", "there is no column 'back'"),
        ("compass", "stamp,angle\n0,1\n", "there is no column 'heading'"),
    ],
)
def test_what_cannot_be_is_refused(name: str, text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=words) as error:
        read(tmp_path, small(**{name: text}))
    assert f"a/{name}.csv" in str(error.value)


@pytest.mark.parametrize(
    ("room", "words"),
    [({}, "room: low and high corners are needed"), ({"low": [0, 0, 0]}, "has one corner")],
)
def test_a_room_has_two_corners(room: dict[str, Any], words: str, tmp_path: Path) -> None:
    files = small(ultrasonic=TABLES["ultrasonic"])
    about = yaml.safe_load(files["recording.yaml"])
    about["map"]["room"] = room
    files["recording.yaml"] = yaml.safe_dump(about)
    with pytest.raises(DataError, match=words):
        read(tmp_path, files)


# ---------------------------------------------------------------- a recording of a simulated team


def simulated() -> tuple[Scenario, list[Observation], Folder]:
    """Three UAVs of ``indoor-v0`` that have all of these senses; and the folder of their
    recording, with numbers as they were."""
    scenario = make_scenario(
        "indoor-v0", n_uavs=3, landmarks=0, uwb=False, compass=True, rssi=True, rssi_uavs=True,
        light=True, ultrasonic=True, ultrasonic_dropout=0.0, dt=0.1,
    )  # fmt: skip
    world = World(scenario)
    rssi, light = scenario.believed.sensor(Rssi), scenario.believed.sensor(Light)
    assert rssi is not None
    assert light is not None
    rows: dict[str, list[list[Any]]] = {}
    seen, observations = world.reset(7), []
    for k in range(STEPS):
        observations.append(seen)
        for i, name in enumerate(NAMES):

            def put(file: str, *cells: Any, name: str = name, t: str = f"{k / 10:.1f}") -> None:
                rows.setdefault(f"{name}/{file}", []).append([t, *cells])

            leaf = {key: value[0, i].tolist() for key, value in seen.leaves.items()}
            q = world.truth.attitude[0, i].tolist()
            put("truth", *world.truth.position[0, i].tolist(), *q[1:], q[0])
            if k:  # a sample stands until the next, that of a step for what led to it
                put("imu", *leaf["imu"][3:], *leaf["imu"][:3], t=f"{(k - 1) / 10:.1f}")
            put("compass", *leaf["compass"])
            for stem, ends in (("rssi", [f"p{m}" for m in range(4)]), ("uav_rssi", NAMES)):
                found = zip(ends, leaf[stem], leaf[f"{stem}_mask"], strict=True)
                for end, strength in ((end, strength) for end, strength, there in found if there):
                    put("rssi", end, strength)
            for m, there in enumerate(leaf["light_mask"]):
                if there:
                    way = leaf["light_direction"][3 * m : 3 * m + 3]
                    put("light", f"l{m}", leaf["light"][m], *way)
            pairs = zip(leaf["ultrasonic"], leaf["ultrasonic_mask"], strict=True)
            put("ultrasonic", *("" if not there else z for z, there in pairs))
        world.advance(torch.zeros(1, 3, 9))
        seen = world.observation()
    heads = {
        "truth": "x,y,z,qx,qy,qz,qw",
        "imu": "gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z",
        "compass": "heading",
        "rssi": "to,strength",
        "light": "lamp,intensity,x,y,z",
        "ultrasonic": "forward,back,left,right,up,down",
    }
    files = {f"{k}.csv": table(f"stamp,{heads[k.split('/')[1]]}", v) for k, v in rows.items()}
    arena = scenario.arena
    files["recording.yaml"] = yaml.safe_dump(
        {
            "dim": 3,
            "robots": list(NAMES),
            "map": {
                "lamps": {f"l{m}": list(place) for m, place in enumerate(light.lamps)},
                "access_points": {f"p{m}": list(place) for m, place in enumerate(rssi.points)},
                "room": {"low": list(arena.low), "high": list(arena.high)},
            },
        }
    )
    return scenario, observations, files


@pytest.mark.slow
def test_a_recording_is_replayed_as_it_was_simulated(tmp_path: Path) -> None:
    """The same measurements, and by them the same estimates, of an EKF that starts the same. (An
    IMU's samples are turned and averaged over each step: its leaf is taken from the simulation.)"""
    scenario, observations, files = simulated()
    write_recording(read(tmp_path / "one", files), tmp_path / "two")
    beliefs = tmp_path / "believed.yaml"
    beliefs.write_text(yaml.safe_dump({"imu": IMU}))
    folder = str(tmp_path / "two")
    replay = make_scenario("replay-v0", path=folder, believed=str(beliefs), dt=0.1)
    ours, theirs = scenario.believed, replay.believed
    for kind in KINDS:
        one, other = ours.sensor(kind), theirs.sensor(kind)
        assert one is not None
        assert other is not None
    assert theirs.process == ours.process
    world = World(replay)
    seen = world.reset(0)
    first, second = make("ekf", scenario), make("ekf", replace(theirs, prior=ours.prior))
    one = first.reset(observations[0])
    other = second.reset(Observation({**seen.leaves, "prior": observations[0]["prior"]}))
    for k in range(replay.horizon):
        for name in LEAVES:
            torch.testing.assert_close(seen[name], observations[k][name], rtol=1e-5, atol=1e-5)
        one, found = first.step(one, observations[k])
        driven = Observation({**seen.leaves, "imu": observations[k]["imu"]})
        other, again = second.step(other, driven)
        torch.testing.assert_close(again.position, found.position, rtol=0, atol=1e-4)
        world.advance(torch.zeros(1, 3, 9))
        seen = world.observation()


@pytest.mark.slow
def test_online_the_numbers_are_those_of_the_replay(tmp_path: Path) -> None:
    folder = tmp_path / "two"
    write_recording(read(tmp_path / "one", simulated()[2]), folder)
    start, prior, places, covariances = replayed(folder, "ekf", 0.1, 10)
    online, found = OnlineLocalizer("ekf", folder, start=start, prior=prior), list[Any]()
    for event in events_of(folder):
        online.add(**event)
        found += online.steps()
    assert len(found) >= len(places)
    for located, place, covariance in zip(found, places, covariances, strict=False):
        np.testing.assert_allclose(located.position, place, atol=1e-6)
        np.testing.assert_allclose(located.covariance, covariance, atol=1e-6)
