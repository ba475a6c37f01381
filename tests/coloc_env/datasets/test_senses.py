"""Recorded compass, strengths, lamps, ultrasound and field: read, refused, written, replayed."""

import itertools
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
from coloc_env.sensors import Compass, Light, Magnetic, Rssi, UavRssi, Ultrasonic
from coloc_env.world import World
from tests.agents.live_events import events_of, replayed
from tests.coloc_env.datasets.folders_made import Folder, table, write

NAMES, STEPS = ("a", "b", "c"), 15
LEAVES = (
    "compass", "compass_mask", "rssi", "rssi_mask", "rssi_map", "uav_rssi", "uav_rssi_mask",
    "light", "light_direction", "light_mask", "light_map", "ultrasonic", "ultrasonic_mask",
    "magnetic", "magnetic_mask",
)  # fmt: skip
IMU = {"accel_std": 0.05, "accel_bias": 0, "gyro_bias": 0, "accel_walk": 0, "gyro_walk": 0}
KINDS = (Compass, Light, Magnetic, Rssi, UavRssi, Ultrasonic)
WALL = {"low": [14, 9, 0], "high": [16, 11, 5]}


NODES = [(x, y, z) for z in (0.5, 2.5) for x in (0.1, 1.35, 2.6) for y in (0.0,)]
MAP = table("x,y,z,bx,by,bz", [[*p, 1e-5 * p[0], 2e-5, -4e-5 * p[2]] for p in NODES])


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
                    "walls": {"thin": {"low": [2, 3, 0], "high": [2.1, 0, 3]}},
                },
            }
        ),
        "magnetic_map.csv": MAP,
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
    "magnetometer": "stamp,x,y,z\n0.1,1e-5,2e-5,-4e-5\n",
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
    assert again.walls["thin"].tolist() == [[2, 0, 0], [2.1, 3, 3]]
    known, kept = found.magnetic_map, again.magnetic_map
    assert known is not None
    assert kept is not None
    assert [axis.tolist() for axis in known.axes] == [[0.1, 1.35, 2.6], [0.0], [0.5, 2.5]]
    assert known.field[2, 0, 1].tolist() == [1e-5 * 2.6, 2e-5, -4e-5 * 2.5]
    assert kept.field.tobytes() == known.field.tobytes()
    assert [axis.tobytes() for axis in kept.axes] == [axis.tobytes() for axis in known.axes]
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
    np.testing.assert_allclose(found.walls["thin"], [[0, 0.02, -0.03], [0.03, 0.021, 0]])
    known = found.magnetic_map
    assert known is not None
    np.testing.assert_allclose(known.axes[1], [0.001, 0.0135, 0.026])
    np.testing.assert_allclose(known.field[0, 2, 0], [2e-5, 1e-5 * 2.6, 4e-5 * 2.5])
    np.testing.assert_allclose(found.streams["magnetometer"][0].values, [[1e-5, -2e-5, 4e-5]])


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


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (MAP.replace("2.6", "2.7"), "nodes are 1.25 to 1.35 m apart in x, not evenly"),
        (MAP.rsplit("\n", 2)[0] + "\n", "5 nodes, not each one of a grid of 3 × 1 × 2 once"),
        (MAP + MAP.split("\n")[1] + "\n", "7 nodes, not each one of a grid of 3 × 1 × 2 once"),
        (MAP.replace("bz", "b"), "line 1: a column 'bz' is needed, once"),
        (MAP + "1,0,0.5,1,nan,1\n", "line 8: six finite numbers are needed"),
        ("x,y,z,bx,by,bz\n", "no node"),
        (MAP + "9,0,0.5,10,20,-40\n", "line 8: a field of 40 T; tesla are needed"),
    ],
)
def test_a_map_of_no_grid_is_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=words) as error:
        read(tmp_path, small() | {"magnetic_map.csv": text})
    assert "magnetic_map.csv" in str(error.value)


@pytest.mark.parametrize(
    ("wall", "words"),
    [
        ({"low": [0, 0, 0]}, "walls.thin.high: None is not 3 finite numbers"),
        ({"low": [0, 0], "high": [1, 1, 1]}, "walls.thin.low: .* is not 3 finite numbers"),
        ({"bottom": [0, 0, 0]}, "walls.thin.bottom"),
    ],
)
def test_a_wall_has_two_corners(wall: dict[str, Any], words: str, tmp_path: Path) -> None:
    files = small(compass=TABLES["compass"])
    about = yaml.safe_load(files["recording.yaml"])
    about["map"]["walls"] = {"thin": wall}
    files["recording.yaml"] = yaml.safe_dump(about)
    with pytest.raises(DataError, match=words):
        read(tmp_path, files)


@pytest.mark.parametrize("mark", [";", "\t"])
def test_a_map_is_written_as_tables_are(mark: str, tmp_path: Path) -> None:
    text = MAP.replace(",", mark).replace("\n", "\n# measured on Monday\n\n", 1)
    found = read(tmp_path / "other", small() | {"magnetic_map.csv": text}).magnetic_map
    known = read(tmp_path / "commas", small()).magnetic_map
    assert found is not None
    assert known is not None
    np.testing.assert_array_equal(found.field, known.field)


def test_a_field_without_a_map_is_not_used(tmp_path: Path) -> None:
    files = small(magnetometer=TABLES["magnetometer"], compass=TABLES["compass"])
    with pytest.warns(UserWarning, match="does not use magnetometer"):
        make_scenario("replay-v0", path=str(write(tmp_path / "none", without_map(files))))
    known = make_scenario("replay-v0", path=str(write(tmp_path / "map", files)))
    sensor = known.believed.sensor(Magnetic)
    assert sensor is not None
    at = torch.tensor([[0.725, 0.4, 1.0]], dtype=torch.float64)
    b, slope = sensor.mapped(at)  # linear in x and z, the same for all y
    torch.testing.assert_close(b, torch.tensor([[7.25, 20.0, -40.0]], dtype=torch.float64))
    assert slope[0].diagonal().tolist() == pytest.approx([10.0, 0.0, -40.0])


def without_map(files: Folder) -> Folder:
    return {name: text for name, text in files.items() if name != "magnetic_map.csv"}


# ---------------------------------------------------------------- a recording of a simulated team


def simulated() -> tuple[Scenario, list[Observation], Folder]:
    """Three UAVs of ``indoor-v0`` that have all of these senses; and the folder of their
    recording, with numbers as they were."""
    scenario = make_scenario(
        "indoor-v0", n_uavs=3, landmarks=0, uwb=False, compass=True, rssi=True, rssi_uavs=True,
        light=True, ultrasonic=True, ultrasonic_dropout=0.0, dt=0.1, magnetic=True,
        walls=tuple(map(float, (*WALL["low"], *WALL["high"]))),
    )  # fmt: skip
    world = World(scenario)
    rssi, light = scenario.believed.sensor(Rssi), scenario.believed.sensor(Light)
    field = scenario.believed.sensor(Magnetic)
    assert rssi is not None
    assert light is not None
    assert field is not None
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
            put("magnetometer", *(1e-6 * z for z in leaf["magnetic"]))
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
        "magnetometer": "x,y,z",
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
                "walls": {"pillar": WALL},
            },
        }
    )
    nodes = torch.tensor(list(itertools.product(*map(range, field.nodes))), dtype=torch.float64)
    known = torch.cat((nodes, 1e-6 * field.mapped(nodes)[0]), 1)
    files["magnetic_map.csv"] = table("x,y,z,bx,by,bz", known.tolist())
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
