"""What rows of which tables messages become: known ROS types, and any other by field paths."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from coloc_env.datasets.open_format.truth import QUATERNION
from coloc_env.datasets.recording import IMU_COLUMNS, DataError

Cells = Mapping[str, Any]
_A, _B = 6378137.0, 6356752.314245  # m: the ellipsoid of WGS 84


@dataclass
class LocalOrigin:
    """The first satellite fix, about which all are east, north and up (m)."""

    place: np.ndarray | None = None
    turn: np.ndarray | None = None

    def of(self, fix: Any) -> dict[str, float]:
        """East, north and up of a NavSatFix (degrees, m above the ellipsoid); NaN of one that the
        receiver says is none, or is not finite."""
        at = (fix.latitude, fix.longitude, fix.altitude)
        known = fix.status.status >= 0 and np.isfinite(at).all()
        return dict(zip("xyz", self.local(*at) if known else (np.nan,) * 3, strict=True))

    def local(self, latitude: float, longitude: float, altitude: float) -> tuple[float, ...]:
        """East, north and up of a fix (degrees, m above the ellipsoid)."""
        here = _earth_centred(latitude, longitude, altitude)
        if self.place is None or self.turn is None:
            self.place, self.turn = here, _to_local(latitude, longitude)
        return tuple((self.turn @ (here - self.place)).tolist())


def field_of(message: Any, path: str, where: str) -> Any:
    """What stands at a dotted path of a message: ``header.stamp``, ``ranges.0.distance``.

    Raises DataError for a path that does not exist.
    """
    found = message
    for name in path.split("."):
        try:
            found = found[int(name)] if name.lstrip("-").isdigit() else getattr(found, name)
        except (AttributeError, IndexError, TypeError, KeyError):
            known = [key for key in getattr(found, "__dataclass_fields__", {}) if key[:2] != "__"]
            raise DataError(
                f"{where}: there is no field {name!r} in {path!r}; known: {', '.join(known)}"
            ) from None
    return found


def stamp_of(message: Any) -> int | None:
    """The header's stamp in ns; None where there is none, or it was never set."""
    header = getattr(message, "header", None)
    if header is None:
        return None
    stamp = header.stamp
    nanoseconds = getattr(stamp, "nanosec", getattr(stamp, "nsecs", None))
    if nanoseconds is None:
        nanoseconds = stamp.nsec
    seconds = getattr(stamp, "sec", getattr(stamp, "secs", 0))
    return int(seconds) * 10**9 + int(nanoseconds) or None


# ------------------------------------------------------------------ known types


def _pose(pose: Any) -> dict[str, float]:
    p, q = pose.position, pose.orientation
    turned = zip(QUATERNION, (q.x, q.y, q.z, q.w), strict=True)
    return {"x": p.x, "y": p.y, "z": p.z, **dict(turned)}


def _transform(message: Any) -> dict[str, float]:
    t, q = message.transform.translation, message.transform.rotation
    turned = zip(QUATERNION, (q.x, q.y, q.z, q.w), strict=True)
    return {"x": t.x, "y": t.y, "z": t.z, **dict(turned)}


def _imu(message: Any) -> dict[str, float]:
    w, f = message.angular_velocity, message.linear_acceleration
    return dict(zip(IMU_COLUMNS, (w.x, w.y, w.z, f.x, f.y, f.z), strict=True))


def _twist(message: Any) -> dict[str, float]:
    v, w = message.twist.twist.linear, message.twist.twist.angular
    return {"vx": v.x, "vy": v.y, "wz": w.z}


def _distance(message: Any) -> float:
    """Of a Range; NaN beyond what its sensor can measure (REP 117)."""
    least, most = message.min_range, message.max_range
    beyond = message.range < least or 0 < most < message.range
    return np.nan if beyond else message.range


def _range(message: Any) -> dict[str, float]:
    return {"range": _distance(message)}


def _height(message: Any) -> dict[str, float]:
    return {"height": _distance(message)}


def _velocity(twist: Any) -> dict[str, float]:
    return {"vx": twist.linear.x, "vy": twist.linear.y}


def _field(message: Any) -> dict[str, float]:
    b = message.magnetic_field
    return {"x": b.x, "y": b.y, "z": b.z}


def _point(message: Any) -> dict[str, float]:
    return {"x": message.point.x, "y": message.point.y, "z": message.point.z}


_POSES: dict[str, Callable[[Any], Cells]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: _pose(m.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _pose(m.pose.pose),
    "nav_msgs/msg/Odometry": lambda m: _pose(m.pose.pose),
    "geometry_msgs/msg/TransformStamped": _transform,
    "geometry_msgs/msg/PointStamped": _point,
}
FIX = "sensor_msgs/msg/NavSatFix"
KNOWN: dict[str, dict[str, Callable[[Any], Cells]]] = {
    "truth": _POSES,
    "position_fix": _POSES,
    "imu": {"sensor_msgs/msg/Imu": _imu},
    "odometry": {"nav_msgs/msg/Odometry": _twist},
    "ranges": {"sensor_msgs/msg/Range": _range},
    "height": {"sensor_msgs/msg/Range": _height},
    "flow": {
        "geometry_msgs/msg/TwistStamped": lambda m: _velocity(m.twist),
        "geometry_msgs/msg/TwistWithCovarianceStamped": lambda m: _velocity(m.twist.twist),
    },
    "magnetometer": {"sensor_msgs/msg/MagneticField": _field},
}
PLACES = ("truth", "position_fix")


def reader_of(table: str, kind: str, origin: LocalOrigin) -> Callable[[Any], Cells] | None:
    """What reads messages of a type for a table; None where the type says nothing of it."""
    if kind == FIX and table in PLACES:
        return origin.of
    return KNOWN.get(table, {}).get(kind)


def entries_of(message: Any, each: str, where: str) -> Iterator[Any]:
    """The message, or the entries of the list that stands at ``each`` in it."""
    if not each:
        yield message
        return
    found = field_of(message, each, where)
    try:
        yield from found
    except TypeError:
        raise DataError(f"{where}: {each!r} is no list") from None


# ------------------------------------------------------------------ the Earth


def _earth_centred(latitude: float, longitude: float, altitude: float) -> np.ndarray:
    """Earth-centred, earth-fixed place (m) of geodetic coordinates (WGS 84)."""
    phi, lam = np.radians(latitude), np.radians(longitude)
    squared = 1 - (_B / _A) ** 2
    n = _A / np.sqrt(1 - squared * np.sin(phi) ** 2)
    flat = (n + altitude) * np.cos(phi)
    up = (n * (1 - squared) + altitude) * np.sin(phi)
    return np.array((flat * np.cos(lam), flat * np.sin(lam), up))


def _to_local(latitude: float, longitude: float) -> np.ndarray:
    """Rotation from earth-centred axes to east, north, up."""
    sp, cp = np.sin(np.radians(latitude)), np.cos(np.radians(latitude))
    sl, cl = np.sin(np.radians(longitude)), np.cos(np.radians(longitude))
    return np.array(((-sl, cl, 0.0), (-sp * cl, -sp * sl, cp), (cp * cl, cp * sl, sp)))
