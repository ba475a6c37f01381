"""``coloc live``: events in, estimates out, also as MAVLink."""

import json
import socket
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from agents.online import Located
from coloc_env.datasets.open_format import write_recording
from tests.agents.live_events import events_of, lines_of
from tests.coloc_env.scenarios.test_replay_own import wheeled_team
from training.cli.command import app


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("live") / "team"
    write_recording(wheeled_team(), out)
    return out


def first_lines(folder: Path) -> str:
    return "".join(lines_of([e for e in events_of(folder) if e["stamp"] <= 1_000_000_000]))


def test_estimates_are_one_line_a_robot_and_step(folder: Path, tmp_path: Path) -> None:
    state = tmp_path / "belief.safetensors"
    text = "not json\n" + first_lines(folder) + '{"robot": 1, "sensor": "imu", "stamp": 2}\n'
    command = ["live", str(folder), "--agent", "ekf", "--state", str(state)]
    result = CliRunner().invoke(app, command, input=text)
    assert result.exit_code == 0, result.stderr
    found = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(found) >= 2 * 9
    assert np.array(found[-1]["covariance"]).shape == (2, 2)
    assert len({(each["stamp"], each["robot"]) for each in found}) == len(found)
    assert "event 1: 'not json' is no JSON object" in result.stderr
    assert "malformed 2" in result.stderr
    assert "ms a step: median" in result.stderr
    assert state.exists()


def test_mavlink_receiver_gets_ned_with_covariance(folder: Path) -> None:
    mavutil = pytest.importorskip("pymavlink.mavutil")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    receiver = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", dialect="common")
    command = ["live", str(folder), "--mavlink", f"udp:127.0.0.1:{port}"]
    result = CliRunner().invoke(app, command, input=first_lines(folder))
    assert result.exit_code == 0, result.stderr
    sent = json.loads(result.stdout.splitlines()[0])
    message = receiver.recv_match(type="VISION_POSITION_ESTIMATE", blocking=True, timeout=5)
    receiver.close()
    assert message is not None
    assert message.get_srcSystem() == 1
    assert message.usec == sent["stamp"] // 1000
    east, north = sent["position"]
    np.testing.assert_allclose((message.x, message.y), (north, east), rtol=1e-6)
    (ee, en), (_, nn) = sent["covariance"]
    np.testing.assert_allclose([message.covariance[i] for i in (0, 1, 6)], (nn, en, ee), rtol=1e-5)
    assert np.isnan(message.covariance[11])  # height: not estimated in the plane


def test_attitude_in_ned_against_the_definition() -> None:
    """A body that looks north, nose up by 0.2 rad, right side down by 0.1 rad."""
    from scipy.spatial.transform import Rotation

    from training.mavlink import in_ned

    # Forward-left-up in east-north-up: heading π/2, pitch up is a negative turn about left.
    turn = Rotation.from_euler("ZYX", (np.pi / 2, -0.2, 0.1))
    located = Located(
        stamp=0,
        position=np.array([[1.0, 2.0, 3.0]]),
        velocity=np.zeros((1, 3)),
        covariance=np.diag((1.0, 4.0, 9.0))[None],
        attitude=np.roll(turn.as_quat(), 1)[None],
    )
    place, (roll, pitch, yaw), covariance = in_ned(located, 0)
    np.testing.assert_allclose(place, (2, 1, -3))
    np.testing.assert_allclose((roll, pitch, yaw), (0.1, 0.2, 0.0), atol=1e-12)
    np.testing.assert_allclose([covariance[i] for i in (0, 6, 11)], (4, 1, 9))


def test_mavlink_address_is_checked(folder: Path) -> None:
    result = CliRunner().invoke(app, ["live", str(folder), "--mavlink", "serial"], input="")
    assert result.exit_code == 2
    assert "udp:HOST:PORT" in result.stderr
