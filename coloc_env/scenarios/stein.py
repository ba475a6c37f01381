"""``stein2d-v0``, ``stein3d-v0``: teams that measure poses relative to each other and nothing else,
some of them wrong (CSPF paper, section 5)."""

import math
from itertools import product
from typing import Any

import torch

from coloc_env.motion import MOTIONS, Arena, Motion, Recorded
from coloc_env.network import Network
from coloc_env.scenario import ConstantVelocity, Prior, Process, Scenario, Wheeled
from coloc_env.sensors import Odometry, Reference, RelativePose
from coloc_env.series import Tape

_SPACING = 2.0  # m, of the lattice on which a static team stands (eq. 27)
_LATTICE = (0, 1, 2)


def stein2d(
    *,
    n_uavs: int = 3,
    horizon: int = 250,
    dt: float = 0.1,
    size: float = 10.0,
    motion: str = "random",
    outliers: float = 0.2,
    matches_per_step: int = 1,
    relative_pose_noise: tuple[float, float] = (0.05, 2.0),
    odometry_noise: tuple[float, float] = (0.005, 0.2),
    comm_radius: float | None = None,
    message_loss: float = 0.0,
    failure_rate: float = 0.0,
    reward: str = "error",
) -> Scenario:
    """Robots in an area of 10 × 10 m; at each step ``matches_per_step`` random pairs learn their
    relative pose, and each robot its own odometry. Nobody is told anything of where it starts.

    ``relative_pose_noise``: standard deviations in m and degrees; ``outliers``: share of relative
    poses that are wrong, uniform over the area and all rotations; ``odometry_noise``: m and degrees
    a step. ``motion``: any of ``indoor-v0``'s, or ``static``. Poses are relative to UAV 0's, which
    the leaf ``reference`` says and which is not scored. The team believes all but the outliers.
    """
    return _stein(dim=2, name="stein2d-v0", **locals())


def stein3d(
    *,
    n_uavs: int = 3,
    horizon: int = 250,
    dt: float = 0.1,
    size: float = 10.0,
    motion: str = "static",
    outliers: float = 0.2,
    matches_per_step: int = 1,
    relative_pose_noise: tuple[float, float] = (0.05, 2.0),
    odometry_noise: tuple[float, float] = (0.0, 0.0),
    comm_radius: float | None = None,
    message_loss: float = 0.0,
    failure_rate: float = 0.0,
    reward: str = "error",
) -> Scenario:
    """The same in space: UAVs that stand still at (0, 0, 0), (2, 0, 0), (0, 2, 0), … m, level, in a
    cube of 10 m (eq. 27), if no other ``motion`` is asked for, and know it: their odometry has no
    noise by default. Overrides as ``stein2d-v0``."""
    return _stein(dim=3, name="stein3d-v0", **locals())


def _stein(
    *,
    dim: int,
    name: str,
    n_uavs: int,
    horizon: int,
    dt: float,
    size: float,
    motion: str,
    outliers: float,
    matches_per_step: int,
    relative_pose_noise: tuple[float, float],
    odometry_noise: tuple[float, float],
    comm_radius: float | None,
    message_loss: float,
    failure_rate: float,
    reward: str,
) -> Scenario:
    if not (dt > 0 and size > 0):
        raise ValueError("dt (s) and size (m) must be > 0")
    if n_uavs < 1:
        raise ValueError(f"n_uavs={n_uavs} is not allowed: at least one UAV")
    arena = Arena(dim, n_uavs, dt, (-0.5 * size,) * dim, (0.5 * size,) * dim)
    std, turn_std = relative_pose_noise[0], math.radians(relative_pose_noise[1])
    slip, turn = odometry_noise[0] / dt, math.radians(odometry_noise[1]) / dt
    odometry, reference = Odometry(slip, slip, turn), Reference()

    def matches(wrong: float) -> RelativePose:
        return RelativePose(matches_per_step, std, turn_std, wrong)

    process: Process = Wheeled() if dim == 2 else ConstantVelocity(accel_std=0.1)
    return Scenario(
        name=name,
        arena=arena,
        horizon=horizon,
        motion=_motion(motion, arena),
        sensors=(odometry, matches(outliers), reference),
        network=Network(comm_radius, loss=message_loss, max_neighbours=max(16, n_uavs)),
        prior=Prior(kind="uniform", attitude_std=3.0),
        process=process,
        believed_sensors=(odometry, matches(0.0), reference),
        failure_rate=failure_rate,
        reward=reward,
        guides=min(1, n_uavs - 1),
    )


def _motion(name: str, arena: Arena) -> Motion:
    """A motion by name; ``static``: on a lattice of 2 m, the places nearest the origin first."""
    if name in MOTIONS:
        return MOTIONS[name]
    if name != "static":
        raise ValueError(f"motion={name!r} is not allowed: one of static, {', '.join(MOTIONS)}")
    places = sorted(product(_LATTICE, repeat=arena.dim), key=_far)
    if arena.n_uavs > len(places) or _SPACING * max(_LATTICE) > max(arena.high):
        raise ValueError(
            f"motion=static is not allowed: only for at most {len(places)} UAVs in "
            f"{2 * _SPACING * max(_LATTICE):g} m or more"
        )
    position = _SPACING * torch.tensor(places[: arena.n_uavs], dtype=torch.float64).unsqueeze(0)
    attitude = position.new_tensor((1.0, 0.0, 0.0, 0.0) if arena.dim == 3 else (0.0,))
    attitude = attitude.expand(1, arena.n_uavs, -1)
    return Recorded(Tape(position), Tape(torch.zeros_like(position)), Tape(attitude))


def _far(place: tuple[int, ...]) -> tuple[Any, ...]:
    """How far from the origin along the axes, then along which axis first."""
    return sum(place), tuple(-x for x in place)
