"""Ranges between each two robots of a recording: their order, and their biases by the truth."""

from dataclasses import replace

import numpy as np

from coloc_env.datasets.recording import Floats, Recording, Table, Track


def ordered(recording: Recording, order: list[int]) -> Recording:
    """The recording with its robots in another order."""
    place = np.argsort(order).astype(np.float64)
    tables = []
    for robot in order:
        table = recording.streams["uav_ranges"][robot]
        values = table.values.copy()
        values[:, 1] = place[values[:, 1].astype(np.int64)]
        tables.append(Table(table.time, values, table.columns))
    return replace(
        recording,
        robots=tuple(recording.robots[robot] for robot in order),
        truth=tuple(recording.truth[robot] for robot in order),
        streams={"uav_ranges": tuple(tables)},
        tags=recording.tags[order],
    )


def true_distances(tracks: tuple[Track, ...], table: Table, robot: int) -> Floats:
    """Distances [T] (m) by the truth, where and when a robot's table of ranges has one."""
    own, time = tracks[robot], table.time - tracks[robot].time[0]

    def place(track: Track) -> Floats:
        xp = track.time - own.time[0]
        return np.stack([np.interp(time, xp, each) for each in track.position.T], 1)

    others, there = np.stack([place(track) for track in tracks]), np.arange(len(time))
    return np.linalg.norm(others[table.values[:, 1].astype(np.int64), there] - place(own), axis=1)


def calibrated_pairs(recording: Recording, seconds: float) -> Recording:
    """Every range less its pair's median error in the first ``seconds``, by the truth."""
    tables = []
    for robot, table in enumerate(recording.streams["uav_ranges"]):
        error = table.values[:, 3] - true_distances(recording.truth, table, robot)
        early = table.time <= recording.truth[robot].time[0] + round(seconds * 1e9)
        values = table.values.copy()
        for other in np.unique(values[:, 1]):
            pair = values[:, 1] == other
            if not (pair & early).any():
                raise ValueError(
                    f"calibration={seconds:g} is not allowed: a pair has no range in so many s"
                )
            values[pair, 3] -= np.median(error[pair & early])
        tables.append(Table(table.time, values, table.columns))
    return replace(recording, streams={"uav_ranges": tuple(tables)})
