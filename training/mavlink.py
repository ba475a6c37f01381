"""Estimates for autopilots: MAVLink's VISION_POSITION_ESTIMATE by UDP (extra ``mavlink``)."""

import math
import socket
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from agents.online import Located

_COMPONENT = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
# East, north, up to north, east, down; forward, left, up to forward, right, down.
_NED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
_FRD = np.diag((1.0, -1.0, -1.0))
_UPPER = np.triu_indices(6)


class MavlinkSender:
    """Sends each robot's estimate to ``udp:HOST:PORT``, as system 1, 2, … in the setup's order.

    Raises:
        ValueError: the address is none, or pymavlink is not installed.
    """

    def __init__(self, address: str, robots: int) -> None:
        try:
            from pymavlink.dialects.v20 import common
        except ImportError:
            raise ValueError(
                '--mavlink needs pymavlink: pip install "coloc-env[mavlink]"'
            ) from None
        kind, _, rest = address.partition(":")
        host, _, port = rest.rpartition(":")
        if kind != "udp" or not host or not port.isdigit() or not 0 < int(port) < 65536:
            raise ValueError(
                f"--mavlink {address} is not allowed: udp:HOST:PORT, as in udp:127.0.0.1:14550"
            )
        try:
            family, *_, to = socket.getaddrinfo(host, int(port), type=socket.SOCK_DGRAM)[0]
        except socket.gaierror:
            raise ValueError(f"--mavlink {address}: there is no host {host}") from None
        self._to: Any = to
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._links = [common.MAVLink(None, 1 + i, _COMPONENT) for i in range(robots)]

    def send(self, located: Located) -> None:
        """Send one message a robot; what is not estimated is NaN."""
        for robot, link in enumerate(self._links):
            place, turn, covariance = in_ned(located, robot)
            message = link.vision_position_estimate_encode(
                max(located.stamp // 1000, 0), *place, *turn, covariance=covariance
            )
            self._socket.sendto(message.pack(link), self._to)
            link.seq = (link.seq + 1) % 256

    def close(self) -> None:
        self._socket.close()


def in_ned(
    located: Located, robot: int
) -> tuple[NDArray[np.float64], tuple[float, float, float], list[float]]:
    """A robot's position (m, north-east-down), roll, pitch, yaw (rad, of a forward-right-down body)
    and the 21 upper entries of their covariance, row by row."""
    d = located.position.shape[1]
    place, spread = np.zeros(3), np.full((6, 6), math.nan)
    place[:d] = located.position[robot]
    enu = np.full((3, 3), math.nan)
    enu[:d, :d] = located.covariance[robot]
    swap = [1, 0, 2]
    signs = np.outer((1, 1, -1), (1, 1, -1))
    spread[:3, :3] = enu[np.ix_(swap, swap)] * signs
    turn = (math.nan, math.nan, math.nan)
    if located.attitude is not None:
        own = located.attitude[robot]
        turned = (
            Rotation.from_euler("z", own[0]) if d == 2 else Rotation.from_quat(np.roll(own, -1))
        )
        frd_to_ned = Rotation.from_matrix(_NED @ turned.as_matrix() @ _FRD)
        yaw, pitch, roll = frd_to_ned.as_euler("ZYX").tolist()
        turn = (roll, pitch, yaw)
    return _NED @ place, turn, spread[_UPPER].tolist()
