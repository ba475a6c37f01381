"""Events as they come: the same numbers as replay, whatever becomes of them on the way."""

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from agents.online import Located, OnlineLocalizer
from coloc_env.datasets import DataError, dataset_folder, load
from coloc_env.datasets.open_format import write_recording
from tests.agents.live_events import events_of, first_seconds, replayed, written
from tests.coloc_env.scenarios.test_replay_own import wheeled_team

Events = list[dict[str, Any]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two robots with odometry and ranges for 12 s, whose start is known."""
    out = tmp_path_factory.mktemp("live") / "team"
    write_recording(wheeled_team(), out)
    about = yaml.safe_load((out / "recording.yaml").read_text())
    about["start"] = {
        name: {"position": [2.0 * (-1) ** i, 0.0], "heading": np.pi / 2 + np.pi * i}
        for i, name in enumerate(about["robots"])
    }
    (out / "recording.yaml").write_text(yaml.safe_dump(about))
    return out


@pytest.fixture(scope="module")
def events(folder: Path) -> Events:
    return [event for event in events_of(folder) if event["stamp"] <= 3_000_000_000]


def run(online: OnlineLocalizer, events: Events) -> list[Located]:
    found = []
    for event in events:
        online.add(**event)
        found += online.steps()
    return found + list(online.steps(whole=True))


def last(online: OnlineLocalizer, events: Events) -> Located:
    run(online, events)
    found = online.estimate(3_000_000_000)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("dataset", "seconds", "skip", "agent"),
    [("tuc", 5, 0, "ekf"), ("mrclam", 4, 100, "ekf"), ("miluv", 2, 5, "ekf_trust")],
)
def test_same_numbers_as_replay(
    dataset: str, seconds: float, skip: float, agent: str, tmp_path: Path
) -> None:
    try:
        dataset_folder(dataset)
    except DataError as error:
        pytest.skip(str(error))
    folder = written(first_seconds(load(dataset, None, None), seconds, skip), tmp_path / "own")
    start, prior, places, covariances = replayed(folder, agent, 0.1, int(10 * seconds) - 2)
    online = OnlineLocalizer(agent, folder, start=start, prior=prior)
    found = run(online, events_of(folder))
    assert len(found) >= len(places)
    for located, place, covariance in zip(found, places, covariances, strict=False):
        np.testing.assert_allclose(located.position, place, atol=1e-6)
        np.testing.assert_allclose(located.covariance, covariance, atol=1e-6)


def test_steps_are_as_far_apart_as_asked_and_near_the_truth(folder: Path, events: Events) -> None:
    found = run(OnlineLocalizer("ekf", folder, dt=0.2), events)
    stamps = np.array([located.stamp for located in found])
    assert (np.diff(stamps) == 200_000_000).all()
    t = stamps[-1] * 1e-9
    truth = [[2 * np.cos(0.5 * t + np.pi * i), 2 * np.sin(0.5 * t + np.pi * i)] for i in (0, 1)]
    assert np.abs(found[-1].position - truth).max() < 0.5


def test_late_events_within_the_horizon_change_nothing_in_the_end(
    folder: Path, events: Events
) -> None:
    rng = random.Random(0)
    late = sorted(events, key=lambda e: e["stamp"] + rng.uniform(0, 4e8) * (e["stamp"] > 4e8))
    online = OnlineLocalizer("ekf", folder)
    shuffled, straight = last(online, late), last(OnlineLocalizer("ekf", folder), events)
    assert online.counts["late"] > 10
    assert online.counts["run again"] > 10
    np.testing.assert_allclose(shuffled.position, straight.position, atol=1e-9)
    np.testing.assert_allclose(shuffled.covariance, straight.covariance, atol=1e-9)


def test_what_is_later_than_the_horizon_is_left_out_and_counted(
    folder: Path, events: Events
) -> None:
    late = next(e for e in events if e["sensor"] == "ranges" and e["stamp"] > 5e8)
    others = [e for e in events if e is not late]
    online = OnlineLocalizer("ekf", folder, horizon=0.5)
    run(online, [*others, late])
    assert online.counts["too late"] == 1


def test_doubled_events_count_once(folder: Path, events: Events) -> None:
    online = OnlineLocalizer("ekf", folder)
    twice = last(online, [event for event in events for _ in range(2)])
    assert online.counts["doubled"] == len(events)
    assert np.array_equal(twice.position, last(OnlineLocalizer("ekf", folder), events).position)


def test_one_robot_whose_clock_jumps_is_left_out(folder: Path, events: Events) -> None:
    jumped = [
        {**e, "stamp": e["stamp"] + 10**12} if i % 7 == 0 and i > 50 else e
        for i, e in enumerate(events)
    ]
    online = OnlineLocalizer("ekf", folder)
    found = run(online, jumped)
    assert online.counts["of another clock"] == sum(e["stamp"] > 10**12 for e in jumped)
    assert online.counts["clock set"] == 0
    assert found[-1].stamp < 10**10
    assert np.isfinite(found[-1].position).all()


def test_the_team_goes_on_where_its_clock_is_set(folder: Path, events: Events) -> None:
    half = len(events) // 2
    jumped = events[:half] + [{**e, "stamp": e["stamp"] + 10**12} for e in events[half:]]
    online = OnlineLocalizer("ekf", folder)
    found = run(online, jumped)
    assert online.counts["clock set"] == 1
    straight = run(OnlineLocalizer("ekf", folder), events)[-1]
    assert found[-1].stamp > 10**12
    assert np.abs(found[-1].position - straight.position).max() < 0.3


def test_a_silent_robot_is_named_and_less_sure(folder: Path, events: Events) -> None:
    quiet = events[0]["robot"]
    heard = [e for e in events if e["robot"] != quiet or e["stamp"] < 5e8]
    online = OnlineLocalizer("ekf", folder)
    found = last(online, heard)
    straight = last(OnlineLocalizer("ekf", folder), events)
    i = online.robots.index(quiet)
    assert online.silent() == [quiet]
    assert np.trace(found.covariance[i]) > 2 * np.trace(straight.covariance[i])


def test_goes_on_from_a_saved_belief_as_if_nothing_had_been(
    folder: Path, events: Events, tmp_path: Path
) -> None:
    half = len(events) // 2
    first = OnlineLocalizer("ekf", folder)
    for event in events[:half]:
        first.add(**event)
        list(first.steps())
    first.save(tmp_path / "belief.safetensors")
    second = OnlineLocalizer("ekf", folder)
    second.load(tmp_path / "belief.safetensors")
    found = run(second, events[half:])[-1]
    straight = run(OnlineLocalizer("ekf", folder), events)[-1]
    assert found.stamp == straight.stamp
    np.testing.assert_array_equal(found.position, straight.position)
    with pytest.raises(ValueError, match="agent is not 'ekf:iterations=3'"):
        OnlineLocalizer("ekf:iterations=3", folder).load(tmp_path / "belief.safetensors")


def test_a_damaged_belief_is_refused_and_changes_nothing(
    folder: Path, events: Events, tmp_path: Path
) -> None:
    whole, damaged = tmp_path / "belief.safetensors", tmp_path / "bad.safetensors"
    first, half = OnlineLocalizer("ekf", folder), len(events) // 2
    run(first, events[: half // 2])
    first.save(whole)
    data, rng = whole.read_bytes(), random.Random(0)
    online = OnlineLocalizer("ekf", folder)
    for event in events[:half]:
        online.add(**event)
    for _ in range(100):
        cut, at = rng.random() < 0.2, rng.randrange(len(data))
        flipped = bytes([data[at] ^ (1 << rng.randrange(8))])
        damaged.write_bytes(data[:at] if cut else data[:at] + flipped + data[at + 1 :])
        with pytest.raises(ValueError, match=r"bad\.safetensors"):
            online.load(damaged)
    found, straight = (
        run(online, events[half:])[-1],
        run(OnlineLocalizer("ekf", folder), events)[-1],
    )
    np.testing.assert_array_equal(found.position, straight.position)
    with pytest.raises(OSError, match="nothing"):
        online.load(tmp_path / "nothing")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"robot": "nobody"}, "unknown robot 'nobody'"),
        ({"sensor": "range"}, "did you mean 'ranges'"),
        ({"stamp": None}, "stamp None is not a time in ns"),
        ({"to": "anchor_9"}, "anchor_9"),
        ({"range": [1]}, "is not a number"),
        ({"range": "far"}, "is not a number"),
    ],
)
def test_malformed_events_are_refused_in_one_line(
    folder: Path, events: Events, change: dict[str, Any], said: str
) -> None:
    event = next(e for e in events if e["sensor"] == "ranges")
    with pytest.raises(DataError) as raised:
        OnlineLocalizer("ekf", folder).add(**{**event, **change})
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_setup_must_say_what_is_to_come(folder: Path, tmp_path: Path) -> None:
    about = yaml.safe_load((folder / "recording.yaml").read_text())
    for streams, said in ((None, "streams: is missing"), (["gps"], "unknown stream 'gps'")):
        setup = tmp_path / "setup.yaml"
        setup.write_text(yaml.safe_dump(about | {"streams": streams}))
        with pytest.raises(DataError, match=said):
            OnlineLocalizer("ekf", setup)


def test_memory_does_not_grow(folder: Path) -> None:
    online = OnlineLocalizer("ekf", folder, horizon=0.5)
    every = events_of(folder)
    held = []
    for event in every:
        online.add(**event)
        if list(online.steps()):
            times = online.samples.times.values()
            held.append(sum(len(own) for team in times for own in team))
    assert max(held[60:]) <= 1.3 * max(held[10:30])
