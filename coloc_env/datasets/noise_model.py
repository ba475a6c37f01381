"""``believed.yaml``: what a team believes of a recording's sensors."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from coloc_env.datasets.open_format.yaml_files import Keys, YamlFile
from coloc_env.datasets.recording import Recording

MODELS = ("inertial", "wheeled", "constant_velocity")
_T = TypeVar("_T")


@dataclass(frozen=True)
class LinkModel:
    """Systematic errors of one link: ``bias`` m, and ``delay`` s by which stamps are late."""

    bias: float = 0.0
    delay: float = 0.0


@dataclass(frozen=True)
class RangeModel:
    """Ranges: ``std`` m; ``links`` by ``ROBOT/OTHER`` and, where a link is not among them,
    ``bias`` and ``delay``."""

    std: float = 0.2
    bias: float = 0.0
    delay: float = 0.0
    links: Mapping[str, LinkModel] = field(default_factory=dict)

    def of(self, link: str) -> LinkModel:
        return self.links.get(link, LinkModel(self.bias, self.delay))


@dataclass(frozen=True)
class SightingBias:
    """What one robot's sightings are off by: m, rad."""

    range: float = 0.0
    bearing: float = 0.0


@dataclass(frozen=True)
class BearingModel:
    """Range and bearing: standard deviations (m, rad), and ``robots`` by name."""

    range_std: float = 0.2
    bearing_std: float = 0.04
    robots: Mapping[str, SightingBias] = field(default_factory=dict)


@dataclass(frozen=True)
class OdometryModel:
    """Wheels: what is driven is ``scale`` (turns: ``turn_scale``) times what is read, ``delay`` s
    later; noise of a step's mean speed (m/s, rad/s), and ``relative`` of what is read."""

    scale: float = 1.0
    turn_scale: float = 1.0
    delay: float = 0.0
    forward_std: float = 0.05
    left_std: float = 0.025
    turn_std: float = 0.1
    relative: float = 0.0


@dataclass(frozen=True)
class ImuBias:
    """Constant biases of one IMU, rad/s and m/s² in its own axes, and the rotation vector ``turn``
    (rad) that takes vectors in the body's axes to the IMU's."""

    gyro: tuple[float, ...] = (0.0, 0.0, 0.0)
    accel: tuple[float, ...] = (0.0, 0.0, 0.0)
    turn: tuple[float, ...] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ImuModel:
    """An IMU's mean over a step: white noise (m/s², rad/s), what is left of biases, their walks
    (per √s), and ``robots`` by name."""

    accel_std: float = 0.2
    gyro_std: float = 0.01
    accel_bias: float = 0.1
    gyro_bias: float = 0.005
    accel_walk: float = 0.01
    gyro_walk: float = 1e-4
    robots: Mapping[str, ImuBias] = field(default_factory=dict)


@dataclass(frozen=True)
class VectorModel:
    """Vectors to landmarks: ``std`` m of each axis."""

    std: float = 0.2


@dataclass(frozen=True)
class HeightModel:
    """Heights: ``std`` m, and a ``bias`` m that is taken off; of a barometer a ``drift``, too: the
    standard deviation (m) of a bias that filters estimate, whose correlation falls by e in
    ``drift_time`` s (0: none)."""

    std: float = 0.2
    bias: float = 0.0
    drift: float = 0.0
    drift_time: float = 300.0


@dataclass(frozen=True)
class FixModel:
    """Position fixes: ``std`` m of each axis, or of the horizontal ones where there is a
    ``vertical_std`` m (0: none)."""

    std: float = 1.0
    vertical_std: float = 0.0


@dataclass(frozen=True)
class TdoaModel:
    """Time differences of arrival: ``std`` m."""

    std: float = 0.15


@dataclass(frozen=True)
class AngleModel:
    """Angles of arrival: standard deviations, rad."""

    azimuth_std: float = 0.05
    elevation_std: float = 0.05


@dataclass(frozen=True)
class FlowModel:
    """Optical flow: ``std`` m/s."""

    std: float = 0.1


@dataclass(frozen=True)
class CompassModel:
    """Headings: ``std`` rad."""

    std: float = 0.1


@dataclass(frozen=True)
class StrengthModel:
    """Signal strengths: ``power`` dBm at 1 m, less 10 ``exponent`` dB for each tenfold distance,
    ``wall_loss`` for each wall between, ``std`` dB."""

    std: float = 4.0
    power: float = -40.0
    exponent: float = 2.2
    wall_loss: float = 5.0


@dataclass(frozen=True)
class LightModel:
    """Lamps that shine down: ``power`` lx at 1 m below, ``ambient`` lx of other light, noise of a
    ``share`` and a ``floor`` lx, directions to ``angle_std`` rad."""

    power: float = 1000.0
    ambient: float = 20.0
    share: float = 0.05
    floor: float = 0.5
    angle_std: float = 0.05


@dataclass(frozen=True)
class EchoModel:
    """Distances to walls: ``std`` m, none beyond ``reach`` m."""

    std: float = 0.03
    reach: float = 4.0


@dataclass(frozen=True)
class FieldModel:
    """Magnetic fields by a map: ``std`` µT; the map's error ``map_std`` µT, which lasts
    ``map_time`` s; the field varies by ``anomaly_std`` µT over ``length`` m."""

    std: float = 0.5
    map_std: float = 0.5
    map_time: float = 1.0
    anomaly_std: float = 5.0
    length: float = 2.0


@dataclass(frozen=True)
class MotionModel:
    """``model``: one of ``MODELS``, or ``auto`` (by what the recording has). Of a constant
    velocity: white acceleration ``accel_std`` (m/s²/√Hz), ``damping`` s (0: none). ``slow_flight``:
    standard deviation m/s of the velocity about zero (0: nothing is believed of it)."""

    model: str = "auto"
    accel_std: float = 0.5
    damping: float = 0.0
    slow_flight: float = 0.0


@dataclass(frozen=True)
class NoiseModel:
    """All of ``believed.yaml``; every part has defaults. ``anchors`` and ``tags``: refined places
    that replace the recording's (m, by the names of anchors and robots)."""

    motion: MotionModel = MotionModel()
    imu: ImuModel = ImuModel()
    odometry: OdometryModel = OdometryModel()
    anchor_ranges: RangeModel = RangeModel()
    uav_ranges: RangeModel = RangeModel()
    landmark_bearings: BearingModel = BearingModel()
    uav_bearings: BearingModel = BearingModel()
    landmark_vectors: VectorModel = VectorModel()
    tdoa: TdoaModel = TdoaModel()
    arrival_angles: AngleModel = AngleModel()
    flow: FlowModel = FlowModel()
    compass: CompassModel = CompassModel()
    rssi: StrengthModel = StrengthModel()
    uav_rssi: StrengthModel = StrengthModel()
    light: LightModel = LightModel()
    ultrasonic: EchoModel = EchoModel()
    magnetometer: FieldModel = FieldModel()
    height: HeightModel = HeightModel()
    position_fix: FixModel = FixModel()
    anchors: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    tags: Mapping[str, tuple[tuple[float, ...], ...]] = field(default_factory=dict)


def read_noise_model(path: Path, recording: Recording, *under: str) -> NoiseModel:
    """Read what is believed, for a recording, from a YAML file (``under``: the keys it stands at).

    Raises:
        DataError: an entry is unknown, no number, or of a link, robot or anchor that the recording
            does not have; with file and line.
    """
    file = YamlFile(path)
    names = {
        "links": links(recording),
        "robots": recording.robots,
        "anchors": recording.anchor_names,
        "tags": recording.robots,
    }
    for key, known in (("anchors", recording.anchor_names), ("tags", recording.robots)):
        file.allow((*under, key), known, key.removesuffix("s"))
    return _built(NoiseModel, file, under, names, recording)


def write_noise_model(model: NoiseModel, notes: str = "") -> str:
    """The text of ``believed.yaml``: what differs from the defaults, under ``notes`` as comment."""
    import yaml

    found = _differing(model, NoiseModel())
    head = "".join(f"# {line}\n".replace("# \n", "#\n") for line in notes.splitlines())
    return head + yaml.safe_dump(found or {}, sort_keys=False, allow_unicode=True)


def links(recording: Recording) -> tuple[str, ...]:
    """Names of all links that may be: a robot's to each anchor and to each other robot."""
    others = (*recording.robots, *recording.anchor_names)
    return tuple(f"{a}/{b}" for a in recording.robots for b in others if a != b)


# ------------------------------------------------------------------ parts


def _built(
    kind: type[_T], file: YamlFile, keys: Keys, names: Mapping[str, Any], recording: Recording
) -> _T:
    """A dataclass of numbers, words and mappings from a file's entries; defaults for the rest."""
    fields = {each.name: each for each in dataclasses.fields(kind)}  # type: ignore[arg-type]
    file.allow(keys, fields)
    found: dict[str, Any] = {}
    default = kind()
    for name in file.mapping(*keys):
        at, standard = (*keys, name), getattr(default, name)
        if name in ("gyro", "accel", "turn"):
            found[name] = tuple(file.vector(*at, size=3))
        elif name == "model":
            found[name] = file.choice(at, ("auto", *MODELS), "auto")
        elif name == "anchors":
            found[name] = {
                each: tuple(file.vector(*at, each, size=recording.dim))
                for each in file.mapping(*at)
            }
        elif name == "tags":
            found[name] = {
                each: _arms(file, (*at, each), each, recording) for each in file.mapping(*at)
            }
        elif name in ("links", "robots"):
            inner = _INNER[kind]
            file.allow(at, names[name], name.removesuffix("s"))
            found[name] = {
                each: _built(inner, file, (*at, each), names, recording)
                for each in file.mapping(*at)
            }
        elif dataclasses.is_dataclass(standard):
            found[name] = _built(type(standard), file, at, names, recording)
        else:
            value = file.number(*at)
            if value < 0 and name not in ("bias", "range", "bearing", "delay"):
                file.fail(at, f"{value:g} is not 0 or more")
            if abs(value) > 1e6 or (name == "delay" and abs(value) > 60):
                file.fail(at, f"{value:g} is beyond all measure")
            if name in _POSITIVE and value == 0:
                file.fail(at, f"0 is no {_POSITIVE[name]}")
            if name in ("scale", "turn_scale") and not 0.01 < value < 100:
                file.fail(at, f"{value:g} is no scale from 0.01 to 100")
            found[name] = value
    return kind(**found)


_POSITIVE = {"drift_time": "time", "map_time": "time", "length": "length"}
_INNER: dict[type, type] = {
    RangeModel: LinkModel,
    BearingModel: SightingBias,
    ImuModel: ImuBias,
}


def _arms(file: YamlFile, keys: Keys, robot: str, recording: Recording) -> tuple[Any, ...]:
    own = recording.tags[recording.robots.index(robot)]
    count = int((~np.isnan(own).any(1)).sum())
    given = file.get(*keys)
    if not isinstance(given, list) or len(given) != count:
        file.fail(keys, f"is not a list of the {count} lever arms that the robot has")
    return tuple(tuple(file.vector(*keys, i, size=recording.dim)) for i in range(count))


def _differing(value: Any, default: Any) -> Any:
    """What of a dataclass differs from another, as YAML can hold it; None if nothing does."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = {
            each.name: _differing(getattr(value, each.name), getattr(default, each.name, None))
            for each in dataclasses.fields(value)
        }
        return {name: part for name, part in parts.items() if part is not None} or None
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()} or None
    return None if value == default else _plain(value)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {each.name: _plain(getattr(value, each.name)) for each in dataclasses.fields(value)}
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
