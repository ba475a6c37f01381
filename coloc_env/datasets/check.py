"""What is in a recording, and what of it will do harm."""

from dataclasses import dataclass

import numpy as np

from coloc_env.datasets.recording import Recording, Stamps, Table, Track
from coloc_env.datasets.residuals import (
    Link,
    best_delay,
    has_truth,
    link_delay,
    links_of,
    robust,
    true_ranges,
)

_GAPS = 10.0  # times the usual interval, and
_GAP = 1.0  # s: longer than both is a gap
_FAR = 3.0  # robust deviations beyond which a range is an outlier
_LATE = 0.05  # s
_MANY = 30  # ranges, of fewer of which a share says nothing
_G = 9.80665
_TIES = {"uav_ranges": 1, **dict.fromkeys(("uav_bearings", "arrival_angles", "uav_rssi"), 0)}


@dataclass(frozen=True)
class StreamReport:
    """One stream of one robot: how many samples, their mean rate (Hz), the longest interval (s),
    how many longer than 1 s and ten usual ones, and how many share the stamp before."""

    robot: str
    stream: str
    samples: int
    rate: float
    longest: float
    gaps: int
    repeated: int


@dataclass(frozen=True)
class LinkReport:
    """Ranges of one link against truth: bias and robust deviation (m), the share beyond three
    deviations, and by how much stamps are late (s)."""

    link: str
    samples: int
    bias: float
    std: float
    outliers: float
    delay: float


@dataclass(frozen=True)
class Report:
    """All that was found; ``warnings`` in the order of the harm they do."""

    streams: tuple[StreamReport, ...]
    links: tuple[LinkReport, ...]
    warnings: tuple[str, ...]


def check(recording: Recording) -> Report:
    """Look a recording over."""
    rows = []
    for robot, name in enumerate(recording.robots):
        rows.append(_stream(name, "truth", recording.truth[robot]))
        rows += [_stream(name, stream, team[robot]) for stream, team in recording.streams.items()]
    found = [*_about_time(recording, rows), *_about_imu(recording), *_about_reach(recording)]
    links: list[LinkReport] = []
    for stream in ("anchor_ranges", "uav_ranges"):
        known = [link for link in links_of(recording, stream) if has_truth(recording, link)]
        common = best_delay(recording, known)
        if abs(common) >= _LATE:
            found.append((2, f"{stream}: stamps are {common:+.2f} s late (calibrate)"))
        links += filter(None, (_link(recording, link, common) for link in known))
    found += _about_ranges(links)
    found += [
        (5, f"{count} of {stream} are left out: no sensor can have measured them")
        for stream, count in recording.dropped.items()
        if count
    ]
    ordered = tuple(text for _, text in sorted(found, key=lambda each: each[0]))
    return Report(tuple(row for row in rows if row.samples), tuple(links), ordered)


def _stream(robot: str, stream: str, table: Table | Track) -> StreamReport:
    step = np.diff(table.time) * 1e-9
    fresh = step[step > 0]
    usual = float(np.median(fresh)) if len(fresh) else float("nan")
    longest = float(step.max()) if len(step) else float("nan")
    gaps = int((step > max(_GAP, _GAPS * usual)).sum()) if len(fresh) else 0
    lasted = float(step.sum())
    rate = len(step) / lasted if lasted > 0 else float("nan")
    return StreamReport(robot, stream, len(table.time), rate, longest, gaps, int((step == 0).sum()))


def _link(recording: Recording, link: Link, common: float) -> LinkReport | None:
    delay = link_delay(recording, link, common)
    distance, known = true_ranges(recording, link, delay)
    error = (link.measured - distance)[known]
    if len(error) < 5:
        return None
    bias, std = robust(error)
    outliers = float((np.abs(error - bias) > _FAR * max(std, 1e-3)).mean())
    return LinkReport(link.name, len(error), bias, std, outliers, delay)


# ------------------------------------------------------------------ what does harm


def _about_time(recording: Recording, rows: list[StreamReport]) -> list[tuple[int, str]]:
    found = []
    spans = _spans(recording)
    if spans:
        whole = (min(a for a, _ in spans.values()), max(b for _, b in spans.values()))
        longest = max(b - a for a, b in spans.values())
        for (robot, stream), (a, b) in spans.items():
            others = [(c, d) for key, (c, d) in spans.items() if key != (robot, stream)]
            if others and all(b < c or a > d for c, d in others):
                found.append((0, f"{robot}: {stream} overlaps no other stream in time: clocks?"))
            elif longest and (b - a) < 0.5 * (whole[1] - whole[0]):
                seconds = (b - a) * 1e-9
                found.append((4, f"{robot}: {stream} covers only {seconds:.1f} s of the recording"))
    known = [
        robot for robot, t in zip(recording.robots, recording.truth, strict=True) if len(t.time)
    ]
    if len(known) < len(recording.robots):
        missing = ", ".join(robot for robot in recording.robots if robot not in known)
        found.append((6, f"no truth of {missing}: nothing of them is scored"))
    for row in rows:
        where = f"{row.robot}: {row.stream}"
        if row.gaps:
            found.append((2, f"{where} has {row.gaps} gaps, the longest of {row.longest:.2f} s"))
        if row.stream in ("imu", "odometry") and row.repeated:
            found.append(
                (3, f"{where} has {row.repeated} samples with the stamp of the one before")
            )
    return found


def _spans(recording: Recording) -> dict[tuple[str, str], tuple[int, int]]:
    found = {}
    for i, robot in enumerate(recording.robots):
        tables: dict[str, Table | Track] = {"truth": recording.truth[i]}
        tables |= {stream: team[i] for stream, team in recording.streams.items()}
        for stream, table in tables.items():
            if len(table.time):
                found[robot, stream] = (int(table.time[0]), int(table.time[-1]))
    return found


def _about_imu(recording: Recording) -> list[tuple[int, str]]:
    """Units and frames: at rest or on average an IMU shows 9.8 m/s² upwards."""
    found = []
    for robot, table in zip(recording.robots, recording.streams.get("imu", ()), strict=False):
        if not len(table.time):
            continue
        mean = table.values[:, 3:].mean(0)
        size = float(np.linalg.norm(mean))
        if 0.7 < size < 1.3:
            found.append((0, f"{robot}: the accelerometer seems to be in g: units.acceleration"))
        elif not 0.7 * _G < size < 1.3 * _G:
            found.append((1, f"{robot}: the mean specific force is {size:.2f} m/s², not 9.8"))
        elif mean[2] < -0.5 * size:
            found.append((0, f"{robot}: gravity is upside down: the frame seems to be ned"))
        elif mean[2] < 0.7 * size:
            shown = ", ".join(f"{value:.1f}" for value in mean)
            found.append((1, f"{robot}: the mean specific force ({shown}) is not upwards: axes?"))
        if float(np.abs(table.values[:, :3]).max()) > 35:
            found.append((1, f"{robot}: turns of more than 35 rad/s: degrees? see units.angle"))
    return found


def _about_reach(recording: Recording) -> list[tuple[int, str]]:
    """Robots whose place nothing shows, and maps that leave a mirror image."""
    fixed = {
        "anchor_ranges", "landmark_bearings", "landmark_vectors", "position_fix", "tdoa",
        "rssi", "light", "ultrasonic", *(("magnetometer",) if recording.magnetic_map else ()),
    } & recording.streams.keys()  # fmt: skip
    reached = {
        robot
        for robot in range(len(recording.robots))
        if any(len(recording.streams[stream][robot].time) for stream in fixed)
    }
    ties = [
        (robot, int(other))
        for stream, column in _TIES.items()
        for robot, table in enumerate(recording.streams.get(stream, ()))
        for other in np.unique(table.values[:, column])
    ]
    for _ in recording.robots:
        reached |= {b for a, b in ties if a in reached} | {a for a, b in ties if b in reached}
    lost = [name for i, name in enumerate(recording.robots) if i not in reached]
    found = []
    if lost:
        found.append((1, f"nothing shows where {', '.join(lost)} is: no anchor, landmark or fix"))
    anchors = recording.anchors
    if {"anchor_ranges", "tdoa"} & recording.streams.keys() and len(anchors):
        extent = np.linalg.svd(anchors - anchors.mean(0), compute_uv=False)
        if len(anchors) < recording.dim + 1 or extent[-1] < 0.05 * max(extent[0], 1e-9):
            where = "in one line" if recording.dim == 2 else "in one plane"
            found.append((3, f"the anchors are {where} or too few: a mirror image fits as well"))
    return found


def _about_ranges(links: list[LinkReport]) -> list[tuple[int, str]]:
    found = []
    for link in links:
        if abs(link.bias) > 1.0:
            found.append((1, f"{link.link}: ranges are off by {link.bias:+.2f} m: map or frame?"))
        elif abs(link.bias) > 0.1:
            found.append((3, f"{link.link}: ranges are off by {link.bias:+.2f} m (calibrate)"))
        if link.outliers > 0.05 and link.samples >= _MANY:
            share = f"{100 * link.outliers:.0f} %"
            found.append((4, f"{link.link}: {share} of ranges are beyond three deviations"))
    return found


def span_of(recording: Recording) -> tuple[int, int]:
    """First and last stamp of all (ns)."""
    spans = _spans(recording).values()
    return min(a for a, _ in spans), max(b for _, b in spans)


def seconds(time: Stamps, zero: int) -> np.ndarray:
    """Times in s since a zero."""
    return (time - zero) * 1e-9
