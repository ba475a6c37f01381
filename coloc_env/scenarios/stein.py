"""``stein2d-v0``, ``stein3d-v0``: teams that measure poses relative to each other and nothing else,
some of them wrong (CSPF paper, section 5)."""

from itertools import product
from typing import Annotated, Any

import torch

from coloc_env.motion import MOTIONS, Arena, Motion, RecordedMotion
from coloc_env.network import NetworkOptions
from coloc_env.options import (
    Degrees,
    Metres,
    OneOf,
    PositiveCount,
    PositiveMetres,
    PositiveSeconds,
    PositiveSpeed,
)
from coloc_env.scenario import (
    ConstantVelocity,
    Inertial,
    Prior,
    Scenario,
    TeamOptions,
    Wheeled,
)
from coloc_env.sensors import Imu, ImuOptions, Odometry, Reference, RelativePoseOptions
from coloc_env.series import Series

SteinMotion = Annotated[str, OneOf(("static", *MOTIONS))]

_SPACING = 2.0  # m, of the lattice on which a static team stands (eq. 27)
_LATTICE = (0, 1, 2)


def stein2d(
    *,
    horizon: PositiveCount = 250,
    dt: PositiveSeconds = 0.1,
    size: PositiveMetres = 10.0,
    motion: SteinMotion = "random",
    odometry_noise: tuple[Metres, Degrees] = (0.005, 0.2),
    team: TeamOptions = TeamOptions(n_uavs=3),
    relative_poses: RelativePoseOptions = RelativePoseOptions(),
    network: NetworkOptions = NetworkOptions(),
) -> Scenario:
    """Robots in an area of 10 × 10 m that know nothing of where they start: random pairs measure
    their relative poses, some of them wrong, and each robot has its odometry.

    ``odometry_noise``: standard deviations in m and degrees a step. Poses are relative to UAV 0's,
    which is the leaf ``reference`` and is not scored.
    """
    arena = Arena(2, team.n_uavs, dt, 2 * (-0.5 * size,), 2 * (0.5 * size,))
    odometry = Odometry.of_steps(odometry_noise, dt)
    parts = (odometry, relative_poses, network, team)
    return _stein("stein2d-v0", arena, horizon, motion, Wheeled(), *parts)


def stein3d(
    *,
    horizon: PositiveCount = 250,
    dt: PositiveSeconds = 0.1,
    size: PositiveMetres = 10.0,
    motion: SteinMotion = "static",
    odometry_noise: tuple[Metres, Degrees] = (0.0, 0.0),
    imu: bool = False,
    top_speed: PositiveSpeed = 2.0,
    team: TeamOptions = TeamOptions(n_uavs=3),
    relative_poses: RelativePoseOptions = RelativePoseOptions(),
    network: NetworkOptions = NetworkOptions(),
    inertial: ImuOptions = ImuOptions(gyro_std=0.003),
) -> Scenario:
    """The same in space: UAVs in a cube of 10 m that stand still, and know it.

    They stand at (0, 0, 0), (2, 0, 0), (0, 2, 0), … m, level (eq. 27), if no other ``motion`` is
    asked for, and their odometry has no noise by default. With ``imu`` they have IMUs in place of
    it, and know of their velocities that no component exceeds ``top_speed`` (m/s) at the start.
    Other overrides as in ``stein2d-v0``.
    """
    arena = Arena(3, team.n_uavs, dt, 3 * (-0.5 * size,), 3 * (0.5 * size,))
    parts = (relative_poses, network, team)
    if not imu:
        odometry, process = Odometry.of_steps(odometry_noise, dt), ConstantVelocity(accel_std=0.1)
        return _stein("stein3d-v0", arena, horizon, motion, process, odometry, *parts)
    made = (arena, horizon, motion, Inertial(), inertial.believed, *parts)
    return _stein("stein3d-v0", *made, max_speed=top_speed)


def _stein(
    name: str,
    arena: Arena,
    horizon: int,
    motion: str,
    process: Wheeled | ConstantVelocity | Inertial,
    moved_by: Odometry | Imu,
    relative_poses: RelativePoseOptions,
    network: NetworkOptions,
    team: TeamOptions,
    max_speed: float | None = None,
) -> Scenario:
    return Scenario(
        name=name,
        arena=arena,
        horizon=horizon,
        motion=_motion(motion, arena),
        sensors=(moved_by, relative_poses.true, Reference()),
        network=network.network(max_neighbours=max(16, team.n_uavs)),
        prior=Prior(kind="uniform", attitude_std=3.0, max_speed=max_speed),
        process=process,
        believed_sensors=(moved_by, relative_poses.believed, Reference()),
        failure_rate=team.failure_rate,
        reward=team.reward,
        anchor_uavs=min(1, team.n_uavs - 1),
    )


def _motion(name: str, arena: Arena) -> Motion:
    """A motion by name; ``static``: on a lattice of 2 m, the places nearest the origin first."""
    if name in MOTIONS:
        return MOTIONS[name]
    places = sorted(product(_LATTICE, repeat=arena.dim), key=_far)
    if arena.n_uavs > len(places) or _SPACING * max(_LATTICE) > max(arena.high):
        raise ValueError(
            f"motion=static is not allowed: only for at most {len(places)} UAVs in "
            f"{2 * _SPACING * max(_LATTICE):g} m or more"
        )
    position = _SPACING * torch.tensor(places[: arena.n_uavs], dtype=torch.float64).unsqueeze(0)
    attitude = position.new_tensor((1.0, 0.0, 0.0, 0.0) if arena.dim == 3 else (0.0,))
    attitude = attitude.expand(1, arena.n_uavs, -1)
    return RecordedMotion(Series(position), Series(torch.zeros_like(position)), Series(attitude))


def _far(place: tuple[int, ...]) -> tuple[Any, ...]:
    """How far from the origin along the axes, then along which axis first."""
    return sum(place), tuple(-x for x in place)
