"""``recording.yaml``: what a recording's files mean."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coloc_env.datasets.folders import entries
from coloc_env.datasets.open_format.stamps import DIGITS
from coloc_env.datasets.open_format.yaml_files import Keys, YamlFile
from coloc_env.datasets.recording import FARTHEST, Floats

FILE = "recording.yaml"
FRAMES = ("enu", "ned", "utm")
LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
ANGLES = {"rad": 1.0, "deg": math.pi / 180.0}
ACCELERATIONS = {"m/s2": 1.0, "g": 9.80665}
PLACES = ("lamps", "access_points", "room")
CORNERS = ("low", "high")
KEYS = (
    "name", "dim", "robots", "frame", "units", "time", "map", "tags", "source", "licence", "origin",
    "exchanges", "start", "dropped", "believed", "streams",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Description:
    """A checked ``recording.yaml``; places in the recorded frame and in metres.

    ``unit``: of stamps; ``epoch``: whether they count from 1970; ``zero``: ns since 1970 at their
    zero, if that is known. ``once``: each exchange of two robots stands in at least one file, and
    both know of it; otherwise each robot knows what stands in its own. ``streams``: those that are
    to come live (``OnlineLocalizer``); what a folder holds shows in the folder. ``places``: what
    else is on the map, by its kind (``PLACES``). ``walls``: two opposite corners [2, d] of each.
    """

    file: YamlFile
    name: str
    dim: int
    robots: tuple[str, ...]
    frame: str
    length: float
    angle: float
    acceleration: float
    unit: str
    epoch: bool
    zero: int
    landmarks: dict[str, Floats]
    anchors: dict[str, Floats]
    tags: Floats
    source: str
    origin: tuple[float, ...]
    once: bool
    start: Floats
    dropped: dict[str, int]
    streams: tuple[str, ...]
    places: dict[str, dict[str, Floats]]
    walls: dict[str, Floats]


def read_description(path: Path) -> Description:
    """Read and check a ``recording.yaml``; its folder's name is the default of a recording's.

    Raises:
        DataError: the file is missing or damaged, or an entry is unknown, missing or no such thing.
    """
    file, folder = YamlFile(path), path.parent
    file.allow((), KEYS)
    dim = file.whole("dim", default=0)
    if dim not in (2, 3):
        file.fail(("dim",), f"{dim} is not 2 or 3")
    robots = _robots(file, folder)
    file.allow(("units",), ("length", "angle", "acceleration"))
    file.allow(("time",), ("unit", "zero"))
    file.allow(("map",), ("landmarks", "anchors", *PLACES, "walls"))
    file.allow(("map", "room"), CORNERS)
    length = LENGTHS[file.choice(("units", "length"), LENGTHS, "m")]
    angle = ANGLES[file.choice(("units", "angle"), ANGLES, "rad")]
    acceleration = ACCELERATIONS[file.choice(("units", "acceleration"), ACCELERATIONS, "m/s2")]
    unit = file.choice(("time", "unit"), DIGITS, "s")
    zero = file.get("time", "zero")
    epoch = zero == "epoch"
    if not epoch and zero != "relative":
        zero = file.whole("time", "zero", default=0)
    landmarks, anchors = (_places(file, kind, dim, length) for kind in ("landmarks", "anchors"))
    names = [*robots, *landmarks, *anchors]
    twice = next((name for name in names if names.count(name) > 1), None)
    places = {kind: _places(file, kind, dim, length) for kind in PLACES}
    twice = twice or next((name for name in places["access_points"] if name in robots), None)
    if twice is not None:
        file.fail(("map",), f"the name {twice!r} is given twice")
    if len(places["room"]) == 1:
        file.fail(("map", "room"), "has one corner: low and high are needed")
    source = file.text("source")
    if licence := file.text("licence"):
        source = f"{source}; {licence}" if source else licence
    origin = tuple(file.vector("origin", size=dim)) if file.get("origin") is not None else ()
    return Description(
        file=file,
        name=file.text("name", default=folder.resolve().name),
        dim=dim,
        robots=robots,
        frame=file.choice(("frame",), FRAMES, "enu"),
        length=length,
        angle=angle,
        acceleration=acceleration,
        unit=unit,
        epoch=epoch,
        zero=zero if isinstance(zero, int) else 0,
        landmarks=landmarks,
        anchors=anchors,
        tags=_tags(file, robots, dim, length),
        source=source,
        origin=origin,
        once=file.choice(("exchanges",), ("once", "listed"), "once") == "once",
        start=_start(file, robots, dim, length, angle),
        dropped={key: file.whole("dropped", key, default=0) for key in file.mapping("dropped")},
        streams=tuple(file.names("streams")),
        places=places,
        walls=_walls(file, dim, length),
    )


def _robots(file: YamlFile, folder: Path) -> tuple[str, ...]:
    """The robots that are named, or the folders that are there."""
    robots = file.names("robots")
    if not robots:
        robots = [path.name for path in entries(folder) if path.is_dir()]
        if not robots:
            file.fail(("robots",), f"no robots are named, and there are no folders in {folder}")
    for name in robots:
        if not name or name[0] == "." or set(name) & set('/\\:*?"<>|\n\t') or len(name) > 100:
            file.fail(("robots",), f"{name!r} cannot be the name of a folder")
    return tuple(robots)


def _places(file: YamlFile, kind: str, dim: int, length: float) -> dict[str, Floats]:
    return {
        name: _place(file, ("map", kind, name), dim, length) for name in file.mapping("map", kind)
    }


def _walls(file: YamlFile, dim: int, length: float) -> dict[str, Floats]:
    found = {}
    for name in file.mapping("map", "walls"):
        file.allow(("map", "walls", name), CORNERS)
        ends = [_place(file, ("map", "walls", name, end), dim, length) for end in CORNERS]
        found[name] = np.stack(ends)
    return found


def _place(file: YamlFile, keys: Keys, dim: int, length: float) -> Floats:
    place = np.array(file.vector(*keys, size=dim)) * length
    if (np.abs(place) > FARTHEST).any():
        file.fail(keys, f"is no place within {FARTHEST:g} m of the origin")
    return place


def _tags(file: YamlFile, robots: tuple[str, ...], dim: int, length: float) -> Floats:
    """Lever arms [N, K, d]: K = 0 where no robot has any, NaN where one has fewer."""
    file.allow(("tags",), robots, "robot")
    arms: list[list[list[float]]] = []
    for robot in robots:
        given = file.get("tags", robot)
        if given is not None and not isinstance(given, list):
            file.fail(("tags", robot), "is not a list of lever arms, as in [[0.1, 0, 0]]")
        arms.append([file.vector("tags", robot, i, size=dim) for i in range(len(given or []))])
    most = max(map(len, arms))
    table = np.full((len(robots), most, dim), np.nan)
    for i, own in enumerate(arms):
        if own:
            table[i, : len(own)] = np.array(own) * length
    return table


def _start(
    file: YamlFile, robots: tuple[str, ...], dim: int, length: float, angle: float
) -> Floats:
    """Position and attitude [N, d + a] at the start, NaN where unknown; empty without any."""
    file.allow(("start",), robots, "robot")
    if not file.mapping("start"):
        return np.empty((0, 0))
    table = np.full((len(robots), 3 if dim == 2 else 7), np.nan)
    for i, robot in enumerate(robots):
        if file.get("start", robot) is None:
            continue
        file.allow(("start", robot), ("position", "heading", "quaternion"))
        if file.get("start", robot, "position") is not None:
            table[i, :dim] = np.array(file.vector("start", robot, "position", size=dim)) * length
        if file.get("start", robot, "heading") is not None:
            heading = file.number("start", robot, "heading") * angle
            turn = (np.cos(0.5 * heading), 0.0, 0.0, np.sin(0.5 * heading))
            table[i, dim:] = heading if dim == 2 else turn
        if file.get("start", robot, "quaternion") is not None:
            if dim == 2:
                file.fail(("start", robot, "quaternion"), "is for 3 dimensions; use heading")
            x, y, z, w = file.vector("start", robot, "quaternion", size=4)
            if abs(np.linalg.norm((x, y, z, w)) - 1) > 0.01:
                file.fail(("start", robot, "quaternion"), "has not the length 1")
            table[i, dim:] = np.array((w, x, y, z)) / np.linalg.norm((x, y, z, w))
    return table
