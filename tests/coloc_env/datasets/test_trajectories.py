"""Trajectories of recordings as TUM files and bags: what other readers find there."""

from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coloc_env.datasets import DataError, Recording, Track
from coloc_env.datasets.bags import import_bag
from coloc_env.datasets.open_format import read_recording
from coloc_env.datasets.trajectories import write_bag, write_tum

EPOCH = 1_700_000_000_123_456_789


def recording(dim: int, epoch: int = EPOCH) -> Recording:
    """Two robots, of which the second has no truth."""
    rng = np.random.default_rng(0)
    time = np.cumsum(rng.integers(1, 10**9, 40))
    if dim == 3:
        turn = np.roll(Rotation.random(40, random_state=0).as_quat(), 1, 1)
    else:
        turn = rng.uniform(-3, 3, (40, 1))
    truth = (Track(time, rng.normal(size=(40, dim)), turn), Track.unknown(dim))
    none = np.empty((0, dim))
    origin, tags = (5000.0, -3000.0, 0.0)[:dim], np.empty((2, 0, dim))
    team = ("made", dim, ("ann", "bob"), truth, {}, none, none, tags, "", origin)
    return Recording(*team, epoch=epoch)


@pytest.mark.parametrize("dim", [2, 3])
def test_tum_files_have_real_stamps_and_attitudes(dim: int, tmp_path: Path) -> None:
    made = recording(dim)
    write_tum(made, tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == ["ann.txt"]
    rows = [line.split() for line in (tmp_path / "ann.txt").read_text().splitlines()]
    stamps = [int(Decimal(row[0]).scaleb(9)) for row in rows]
    assert stamps == (made.truth[0].time + EPOCH).tolist()
    numbers = np.array(rows, float)[:, 1:]
    place = made.truth[0].position + np.array(made.origin)
    np.testing.assert_array_equal(numbers[:, :dim], place)
    turn = Rotation.from_quat(numbers[:, 3:])
    if dim == 3:
        wanted = Rotation.from_quat(np.roll(made.truth[0].attitude, -1, 1))
    else:
        assert not numbers[:, 2].any()
        wanted = Rotation.from_euler("z", made.truth[0].attitude)
    assert (turn.inv() * wanted).magnitude().max() < 1e-12


@pytest.mark.parametrize("dim", [2, 3])
def test_a_bag_is_read_back_the_same(dim: int, tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    made = recording(dim)
    write_bag(made, tmp_path / "out")
    topics = tmp_path / "topics.yaml"
    topics.write_text(
        f"recording: {{dim: {dim}}}\nrobots: {{ann: {{truth: {{topic: /ann/pose}}}}}}\n"
    )
    import_bag(tmp_path / "out" / "trajectories", topics, tmp_path / "back")
    back, truth = read_recording(tmp_path / "back"), made.truth[0]
    np.testing.assert_array_equal(back.truth[0].time + back.epoch, truth.time + EPOCH)
    place = truth.position + np.array(made.origin)
    found = back.truth[0].position + np.array(back.origin or (0.0,) * dim)
    np.testing.assert_allclose(found, place, rtol=0, atol=1e-9)
    if dim == 3:
        apart = np.abs((back.truth[0].attitude * truth.attitude).sum(1))
        np.testing.assert_allclose(apart, 1.0, rtol=0, atol=1e-12)
    else:
        apart = back.truth[0].attitude[:, 0] - truth.attitude[:, 0]
        np.testing.assert_allclose(np.cos(apart), 1.0, rtol=0, atol=1e-12)


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    made = recording(3)
    blind = replace(made, truth=(Track.unknown(3), Track.unknown(3)))
    for write in (write_tum, write_bag):
        with pytest.raises(DataError, match="made has no ground truth"):
            write(blind, tmp_path / "x")
    assert not (tmp_path / "x").exists()
    early = replace(made, epoch=-(10**18))
    with pytest.raises(DataError, match="a stamp is before 1970"):
        write_bag(early, tmp_path / "x")
    write_tum(early, tmp_path / "y")
    first = (tmp_path / "y" / "ann.txt").read_text().split()[0]
    assert int(Decimal(first).scaleb(9)) == made.truth[0].time[0] - 10**18
