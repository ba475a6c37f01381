"""Calibration finds what was put into a recording that is made for it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from coloc_env.datasets.check import check
from coloc_env.datasets.corrections import corrected
from coloc_env.datasets.noise_model import read_noise_model, write_noise_model
from coloc_env.datasets.open_format import write_recording
from coloc_env.datasets.recording import IMU_COLUMNS, DataError, Recording, Table, Track
from coloc_env.datasets.residuals import best_delay, links_of
from training.calibration.calibrate import calibrate, part_of
from training.calibration.inertial import allan, allan_of, standing
from training.calibration.noise import Noise, noise_of, shrunk, whitened
from training.calibration.smoother import smoothed
from training.calibration.wheels import calibrate_odometry

DELAY, SCALE, TURN_SCALE = 0.12, 0.93, 1.05
BIASES = (0.05, 0.15, 0.25, 0.10)


def driven(seconds: int = 120, rate: int = 20, seed: int = 0) -> Recording:
    """A robot on a winding way: ranges late, each anchor's with its own bias, one anchor 0.5 m from
    where the map says; wheels that exaggerate."""
    rng = np.random.default_rng(seed)
    time = (np.arange(seconds * rate) * (1_000_000_000 // rate)).astype(np.int64)
    anchors = np.array([[-5.0, -5], [5, -5], [5, 5], [-5, 5.0]])

    def place(at: np.ndarray) -> np.ndarray:
        s = at * 1e-9
        return np.stack((3 * np.sin(0.5 * s), 3 * np.cos(0.33 * s)), 1)

    velocity = (place(time + 10**6) - place(time - 10**6)) / 2e-3
    heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    rate_of_turn = np.gradient(heading, time * 1e-9)
    read = np.stack((np.linalg.norm(velocity, axis=1) / SCALE, rate_of_turn / TURN_SCALE), 1)
    read += rng.normal(size=read.shape) * 0.02
    which = np.arange(len(time)) % 4
    distance = np.linalg.norm(place(time - round(DELAY * 1e9)) - anchors[which], axis=1)
    distance += np.array(BIASES)[which] + rng.normal(size=len(time)) * 0.05
    values = np.column_stack((np.zeros(len(time)), which, distance))
    mapped = anchors + np.array([[0, 0], [0, 0], [0.3, -0.4], [0, 0]])
    return Recording(
        name="made",
        dim=2,
        robots=("r",),
        truth=(Track(time, place(time), heading[:, None]),),
        streams={
            "odometry": (Table(time, read, ("v", "omega")),),
            "anchor_ranges": (Table(time, values, ("own_tag", "anchor", "range")),),
        },
        landmarks=np.empty((0, 2)),
        anchors=mapped,
        tags=np.empty((1, 0, 2)),
        source="made",
    )


@pytest.fixture(scope="module")
def found() -> object:
    return calibrate(driven())


def test_biases_and_delay_of_links(found) -> None:  # type: ignore[no-untyped-def]
    model = found.model.anchor_ranges
    assert model.delay == pytest.approx(DELAY, abs=0.02)
    for i in (0, 1, 3):
        assert model.of(f"r/anchor_{i}").bias == pytest.approx(BIASES[i], abs=0.02)
        assert found.noises[f"r/anchor_{i}"].std == pytest.approx(0.05, rel=0.15)
        assert found.noises[f"r/anchor_{i}"].tail < 0.02


def test_an_anchor_that_is_elsewhere(found) -> None:  # type: ignore[no-untyped-def]
    assert set(found.model.anchors) == {"anchor_2"}
    assert np.linalg.norm(np.array(found.model.anchors["anchor_2"]) - (5, 5)) < 0.2


def test_wheels(found) -> None:  # type: ignore[no-untyped-def]
    wheels = found.model.odometry
    assert wheels.scale == pytest.approx(SCALE, abs=0.01)
    assert wheels.turn_scale == pytest.approx(TURN_SCALE, abs=0.02)
    assert wheels.delay == pytest.approx(0.0, abs=0.051)


def test_the_model_is_written_and_read_back(found, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    recording = driven()
    (tmp_path / "b.yaml").write_text(write_noise_model(found.model, "a note"))
    again = read_noise_model(tmp_path / "b.yaml", recording)
    assert again.anchor_ranges.std == pytest.approx(found.model.anchor_ranges.std, rel=1e-5)
    assert set(again.anchors) == {"anchor_2"}
    fixed = corrected(recording, again)
    (link,) = [k for k in links_of(fixed, "anchor_ranges") if k.name == "r/anchor_1"]
    assert best_delay(fixed, [link]) == pytest.approx(0.0, abs=0.02)


def test_without_truth() -> None:
    blind = replace(
        driven(),
        truth=(Track.unknown(2),),
        anchors=driven().anchors - np.array([[0, 0], [0, 0], [0.3, -0.4], [0, 0]]),
        start=np.array([[0.0, 3.0, 0.0]]),
    )
    truth = driven().truth[0]
    found = calibrate(blind)
    assert "no truth" in found.notes[0]
    # all but the delay and what biases have in common with the motion is seen
    biases = [found.model.anchor_ranges.of(f"r/anchor_{i}").bias for i in range(4)]
    assert np.mean(biases) == pytest.approx(np.mean(BIASES), abs=0.05)
    assert np.argmax(biases) == 2
    track = smoothed(blind, found.model).truth[0]
    place = np.stack([np.interp(track.time, truth.time, c) for c in truth.position.T], 1)
    # ranges are 0.12 s late, at up to 2 m/s
    assert np.sqrt(((track.position - place) ** 2).sum(1).mean()) < 0.25


def test_nothing_shows_where_anybody_is() -> None:
    blind = replace(driven(), truth=(Track.unknown(2),), anchors=np.empty((0, 2)), anchor_names=())
    blind = replace(blind, streams={"odometry": blind.streams["odometry"]})
    with pytest.raises(DataError, match="no anchor, landmark or fix shows where"):
        calibrate(blind)


def test_allan_deviation_of_white_noise_and_of_a_ramp() -> None:
    """White noise of density N: σ(τ) = N/√τ. A rate ramp R: σ(τ) = R τ/√2 (IEEE Std 952)."""
    rate, rng = 100.0, np.random.default_rng(0)
    density = 0.01
    white = rng.normal(size=(60_000, 6)) * density * rate**0.5
    found = allan(white, rate)
    near = found.tau < 10
    expected = density / np.sqrt(found.tau[near])
    np.testing.assert_allclose(found.deviation[near].mean(1), expected, rtol=0.1)
    np.testing.assert_allclose(found.white, density, rtol=0.05)
    ramp = np.tile((np.arange(20_000) / rate * 0.003)[:, None], (1, 6))
    found = allan(ramp, rate)
    np.testing.assert_allclose(found.deviation[:, 0], 0.003 * found.tau / 2**0.5, rtol=1e-6)


def imu(still: bool, seed: int = 3) -> Table:
    rng = np.random.default_rng(seed)
    time = (np.arange(4000) * 5_000_000).astype(np.int64)
    values = np.tile((0.01, -0.02, 0.005, 0, 0, 9.80665), (4000, 1))
    values = values + rng.normal(size=(4000, 6)) * ([0.002] * 3 + [0.02] * 3)
    if not still:
        values[:, :3] += 0.5 * np.sin(time * 1e-9)[:, None]
    return Table(time, values, IMU_COLUMNS)


def test_standing_still() -> None:
    assert standing(imu(False)) is None
    assert allan_of(imu(False)) is None
    first, last = standing(imu(True)) or (0, 0)
    assert (first, last) == (0, 4000)
    density = allan_of(imu(True))
    assert density is not None
    np.testing.assert_allclose(density.white[:3], 0.002 * 0.005**0.5, rtol=0.15)


def test_biases_of_an_imu_against_truth() -> None:
    """On a circle about the vertical: biases are what is left of gyro and specific force."""
    rate, seconds, rng = 200, 40, np.random.default_rng(1)
    time = (np.arange(rate * seconds) * (1_000_000_000 // rate)).astype(np.int64)
    s, turn = time * 1e-9, 0.4
    angle = turn * s
    zero = np.zeros_like(s)
    place = np.stack((2 * np.cos(angle), 2 * np.sin(angle), zero), 1)
    yaw = angle + np.pi / 2
    attitude = np.stack((np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)), 1)
    force = np.stack((zero, np.full_like(s, 2 * turn**2), np.full_like(s, 9.80665)), 1)
    gyro = np.stack((zero, zero, np.full_like(s, turn)), 1)
    bias = np.array((0.01, -0.006, 0.003, 0.1, -0.05, 0.2))
    values = np.concatenate((gyro, force), 1) + bias
    values += rng.normal(size=values.shape) * ([0.01] * 3 + [0.1] * 3)
    made = Recording(
        name="circle",
        dim=3,
        robots=("u",),
        truth=(Track(time[::2], place[::2], attitude[::2]),),
        streams={"imu": (Table(time, values, IMU_COLUMNS),)},
        landmarks=np.empty((0, 3)),
        anchors=np.empty((0, 3)),
        tags=np.empty((1, 0, 3)),
        source="made",
    )
    found = calibrate(made).model.imu.robots["u"]
    np.testing.assert_allclose(found.gyro, bias[:3], atol=1e-3)
    np.testing.assert_allclose(found.accel, bias[3:], atol=0.02)


def test_noise_that_lasts_is_inflated() -> None:
    rng = np.random.default_rng(0)
    time = (np.arange(4000) * 100_000_000).astype(np.int64)
    white = rng.normal(size=4000)
    assert whitened(time, white) == pytest.approx(1.0, rel=0.06)
    lasting = np.repeat(rng.normal(size=400), 10)  # the same for a second: ten count as one
    assert whitened(time, lasting) == pytest.approx(10**0.5, rel=0.1)
    heavy = np.where(rng.uniform(size=4000) < 0.1, 20.0, white)
    assert noise_of(time, heavy).tail == pytest.approx(0.1, abs=0.02)
    assert noise_of(time, heavy).std < 1.4


def test_few_measurements_say_little_of_a_link() -> None:
    many = [Noise(400, 0.1 * i, 0.1, 0.0, 0.1) for i in range(4)]
    np.testing.assert_allclose(shrunk(many), [0.0, 0.1, 0.2, 0.3], atol=0.01)
    few = [Noise(3, 0.03 * i, 0.1, 0.0, 0.1) for i in range(4)]
    np.testing.assert_allclose(shrunk(few), 0.045, atol=0.01)


def test_a_part_of_a_recording(tmp_path: Path) -> None:
    part = part_of(driven(), (10.0, 20.0))
    assert part.truth[0].time[0] == 10_000_000_000
    assert part.truth[0].time[-1] == 20_000_000_000
    write_recording(part, tmp_path / "part")


def circled(seed: int = 0) -> Recording:
    """Three robots on circles of constant speed, each of whose ranges to four anchors come every
    0.3 s, for 30 s, on time; wheels that read the truth."""
    rng = np.random.default_rng(seed)
    dense = (np.arange(601) * 50_000_000).astype(np.int64)
    anchors = np.array([[-5.0, -5], [5, -5], [5, 5], [-5, 5.0]])

    def place(at: np.ndarray, robot: int) -> np.ndarray:
        angle = 0.2 * at * 1e-9 + 2.1 * robot
        return 3 * np.stack((np.cos(angle), np.sin(angle)), 1)

    truth, wheels, ranges = [], [], []
    for robot in range(3):
        heading = 0.2 * dense * 1e-9 + 2.1 * robot + np.pi / 2
        truth.append(Track(dense, place(dense, robot), heading[:, None]))
        read = np.tile((0.6, 0.2), (len(dense), 1)) + rng.normal(size=(len(dense), 2)) * 0.01
        wheels.append(Table(dense, read, ("v", "omega")))
        time = np.repeat((np.arange(100) * 300_000_000).astype(np.int64), 4)
        which = np.tile(np.arange(4), 100)
        distance = np.linalg.norm(place(time, robot) - anchors[which], axis=1)
        distance += rng.normal(size=len(time)) * 0.1
        values = np.column_stack((np.zeros(len(time)), which, distance))
        ranges.append(Table(time, values, ("own_tag", "anchor", "range")))
    return Recording(
        name="made",
        dim=2,
        robots=("a", "b", "c"),
        truth=tuple(truth),
        streams={"odometry": tuple(wheels), "anchor_ranges": tuple(ranges)},
        landmarks=np.empty((0, 2)),
        anchors=anchors,
        tags=np.empty((3, 0, 2)),
        source="made",
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_is_on_time_has_no_delay(seed: int) -> None:
    """A hundred ranges a link fit best at some delay by chance; a steady circle shows none of the
    wheels'. The check and the calibration say the same."""
    recording = circled(seed)
    assert {link.delay for link in check(recording).links} == {0.0}
    wheels = calibrate_odometry(recording)
    assert wheels is not None
    assert wheels.delay == 0.0
