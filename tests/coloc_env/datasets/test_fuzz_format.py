"""Damage to a recording's files: refused in one line, or loaded as what then stands there.

``COLOC_FUZZ`` sets how many damaged folders are tried (2 000 in the acceptance of the format).
"""

import os
import random
import warnings
from pathlib import Path

import numpy as np
import pytest

from coloc_env.datasets import DataError, Recording
from coloc_env.datasets.open_format import read_recording
from tests.coloc_env.datasets.folders_made import FOLDERS, Folder, plainly, write

COUNT = int(os.environ.get("COLOC_FUZZ", "90"))
PIECES = (
    *("", ",", ";", "\t", "\n", "\r\n", "\n\n", '"', "#", " ", ".", "-", "0", "1", "9", "e", "e9"),
    *(
        "nan",
        "inf",
        "-1",
        "1e400",
        "_",
        "x",
        "é",
        "\ufeff",
        "\0",
        "[",
        "]",
        "{",
        "}",
        ":",
        "&a",
        "*a",
    ),
    *("stamp", "range", "ann", "north", "dim", "3", "١", "0x10", "1,5", "true", "null", "~"),
)


def damaged(files: Folder, rng: random.Random) -> Folder:
    """One to three pieces of a file replaced, cut, doubled or moved; or a file lost, or cut off."""
    files = dict(files)
    for _ in range(rng.randint(1, 3)):
        name = rng.choice(sorted(files))
        text, kind = files[name], rng.randrange(8)
        at = rng.randrange(len(text) + 1)
        lines = text.split("\n")
        if kind <= 3:
            text = text[:at] + rng.choice(PIECES) + text[at + rng.randrange(6) :]
        elif kind == 4:
            text = text[:at]
        elif kind == 5:
            i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
            lines[i], lines[j] = lines[j], lines[i]
            text = "\n".join(lines)
        elif kind == 6:
            lines.insert(rng.randrange(len(lines) + 1), rng.choice(lines))
            text = "\n".join(lines)
        elif len(files) > 1:
            del files[name]
            continue
        files[name] = text
    return files


def loaded(recording: Recording) -> dict[str, tuple[int, float]]:
    """What ``plainly`` says of a folder, of what was loaded from it."""
    found: dict[str, tuple[int, float]] = {}

    def add(robot: int, file: str, values: np.ndarray) -> None:
        if len(values):
            key = f"{recording.robots[robot]}/{file}"
            count, total = found.get(key, (0, 0.0))
            found[key] = (count + len(values), total + float(values.sum()))

    for robot in range(len(recording.robots)):
        axes = 3 if recording.dim == 3 else 2
        add(robot, "truth", recording.truth[robot].position[:, :axes])
        for stream, team in recording.streams.items():
            values = team[robot].values
            if stream in ("imu", "odometry", "height", "position_fix", "flow"):
                add(robot, stream, values)
            elif stream == "tdoa":
                add(robot, stream, values[:, 3:])
            elif stream == "arrival_angles":
                add(robot, "angles", values[:, 1:])
            elif stream.endswith("_ranges"):
                add(robot, "ranges", values[:, [0, -1]])
            elif stream.endswith("_bearings"):
                add(robot, "sightings", values[:, 1:2])
    return found


@pytest.mark.parametrize("name", FOLDERS)
def test_damage_is_refused_or_loaded_as_it_stands(name: str, tmp_path: Path) -> None:
    outcomes = {"refused": 0, "loaded": 0}
    for seed in range(COUNT // len(FOLDERS) + 1):
        rng = random.Random(f"{name} {seed}")
        files = damaged(FOLDERS[name](), rng)
        if "recording.yaml" in files and "exchanges" not in files["recording.yaml"]:
            files["recording.yaml"] = "exchanges: listed\n" + files["recording.yaml"]
        home = write(tmp_path / str(seed), files)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = read_recording(home)
        except DataError as error:
            if "\n" in str(error):
                pytest.fail(f"{name} {seed}: more than one line: {error}")
            outcomes["refused"] += 1
            continue
        outcomes["loaded"] += 1
        mine, theirs = loaded(found), plainly(home)
        if found.origin:
            continue
        assert set(mine) == set(theirs), (name, seed, mine.keys() ^ theirs.keys())
        for file, (count, total) in theirs.items():
            if file.endswith("truth"):  # of samples with one stamp the first is taken
                assert mine[file][0] <= count, (name, seed, file)
                if mine[file][0] < count:
                    continue
            assert mine[file][0] == count, (name, seed, file)
            assert mine[file][1] == pytest.approx(total, rel=1e-9, abs=1e-9), (name, seed, file)
    assert all(outcomes.values()), outcomes
