"""Recordings for rerun's viewer: a localizer's run as it goes, or the first run of an evaluation.

Entities, with an instance a UAV in order: ``world/truth``, ``world/AGENT/estimate``,
``world/AGENT/ellipsoid``, ``world/AGENT/particles``; ``world/links`` and ``world/ranges``;
``world/obstacles``; what stands still: ``world/arena``, ``world/walls``, ``world/landmarks``,
``world/anchors``. Scalars, with a series a UAV: ``error/AGENT`` (m), ``nees/AGENT``;
``radio/bytes`` of all. Timelines: ``time`` (s) and ``step``. Lengths in m, world frame, z = 0 in
the plane.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from agents.localizer import Localizer
from coloc_env.motion import Arena
from coloc_env.render.style import uav_colours
from coloc_env.scenario import Scenario
from coloc_env.sensors import Ranging
from training.evaluation.ellipsoids import half_axes, in_space
from training.evaluation.metrics import Floats
from training.evaluation.record import nees, places_of
from training.evaluation.rollout import Step, rollout
from training.evaluation.runs import Runs

_TRUTH, _LINK, _PLACE = (28, 35, 49), (141, 154, 176), (152, 162, 179)
_FITS, _WRONG = np.array((0, 158, 115)), np.array((213, 94, 0))
_APART = 3.0  # standard deviations from which on a range is drawn as wrong


class Viewing:
    """Writes one recording to a file; ``close`` it. ValueError where rerun is not installed."""

    def __init__(self, path: Path, name: str) -> None:
        try:
            import rerun
        except ImportError:
            raise ValueError("a viewer needs rerun: pip install 'coloc-env[view]'") from None
        self.rr = rerun
        self.stream = rerun.RecordingStream("coloc", recording_id=name)
        self.stream.save(path)

    def close(self) -> None:
        """Everything is in the file when this returns."""
        self.stream.flush()
        self.stream.disconnect()

    def log(self, entity: str, value: Any, static: bool = False) -> None:
        self.stream.log(entity, value, static=static)

    def at(self, step: int, dt: float) -> None:
        """What follows is of this step."""
        self.stream.set_time("step", sequence=step)
        self.stream.set_time("time", duration=step * dt)

    def arena(
        self, low: tuple[float, ...], high: tuple[float, ...], places: dict[str, Floats]
    ) -> None:
        """What stands still."""
        rr = self.rr
        corners = in_space(np.array([low, high], float))
        self.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        box = rr.Boxes3D(mins=corners[:1], sizes=corners[1:] - corners[:1], colors=_LINK)
        self.log("world/arena", box, static=True)
        for name, found in places.items():
            points = rr.Points3D(in_space(found), radii=0.1, colors=_PLACE)
            self.log(f"world/{name}", points, static=True)

    def walls(self, boxes: tuple[Any, ...]) -> None:
        if boxes:
            low, high = (in_space(np.array([box[i] for box in boxes], float)) for i in (0, 1))
            self.log("world/walls", self.rr.Boxes3D(mins=low, sizes=high - low), static=True)

    def obstacles(self, axes: Floats, radius: float, arena: Arena) -> None:
        """Columns [C, d] that move, as boxes from the floor to the ceiling."""
        if len(axes):
            low, high = (
                in_space(np.array([side], float))[0, 2] for side in (arena.low, arena.high)
            )
            centres = in_space(axes)
            centres[:, 2] = 0.5 * (low + high)
            halves = np.tile((radius, radius, 0.5 * (high - low)), (len(axes), 1))
            self.log("world/obstacles", self.rr.Boxes3D(centers=centres, half_sizes=halves))

    def truth(self, position: Floats, radius: float) -> None:
        """Where UAVs are [N, d]."""
        self.log("world/truth", self.rr.Points3D(in_space(position), radii=radius, colors=_TRUTH))

    def estimates(self, agent: str, position: Floats, covariance: Floats, radius: float) -> None:
        """Where an agent takes them to be [N, d], with ellipsoids of 95 %."""
        places, colours = in_space(position), _colours(len(position))
        points = self.rr.Points3D(places, radii=radius, colors=colours)
        self.log(f"world/{agent}/estimate", points)
        sizes, turns = _ellipsoids(half_axes(covariance))
        known = np.isfinite(sizes).all(-1) & np.isfinite(places).all(-1)
        ellipsoids = self.rr.Ellipsoids3D(
            centers=places[known],
            half_sizes=sizes[known],
            quaternions=Rotation.from_matrix(turns[known]).as_quat() if known.any() else [],
            colors=colours[known],
        )
        self.log(f"world/{agent}/ellipsoid", ellipsoids)

    def lines(self, entity: str, ends: Floats, colours: Any) -> None:
        """Straight lines [L, 2, 3]."""
        self.log(entity, self.rr.LineStrips3D(ends, colors=colours, radii=0.01))

    def scalars(self, name: str, values: Floats) -> None:
        """A number a UAV; NaN where there is none."""
        self.log(name, self.rr.Scalars(np.asarray(values, float)))


def view_runs(runs: Runs, path: Path) -> None:
    """Write the first run of an evaluation, with every agent's estimates, into a file."""
    view = Viewing(path, f"{runs.name}-{runs.summary['seed']}")
    view.arena(runs.low, runs.high, runs.places)
    radius = _radius(runs.low, runs.high)
    for k, truth in enumerate(runs.truth):
        view.at(k, runs.dt)
        view.truth(truth, radius)
        view.lines("world/links", _between(truth, runs.links[k]), _LINK)
        for agent, one in runs.methods.items():
            view.estimates(agent, truth + one.offset[k], one.covariance[k], 0.8 * radius)
            scored = runs.scored[0, k]
            view.scalars(f"error/{agent}", np.where(scored, one.error[0, k], np.nan))
            view.scalars(f"nees/{agent}", np.where(scored, one.nees[0, k], np.nan))
    view.close()


def view_scenario(
    localizer: Localizer,
    scenario: Scenario,
    seed: int,
    steps: int,
    path: Path,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Run a localizer in the world of a seed and write what happens into a file."""
    import torch

    view, arena = Viewing(path, f"{scenario.name}-{localizer.name}-{seed}"), scenario.arena
    radius = _radius(arena.low, arena.high)
    for step in rollout(localizer, scenario, torch.tensor([seed]), steps):
        if step.k == 0:
            view.arena(arena.low, arena.high, places_of(step.world))
            view.walls(scenario.network.walls)
        view.at(step.k, arena.dt)
        view.obstacles(step.world.obstacles[0].numpy(), scenario.sight.radius, arena)
        _log_step(view, localizer.name, step, radius)
        progress(step.k + 1)
    view.close()


def _log_step(view: Viewing, agent: str, step: Step, radius: float) -> None:
    assert step.estimate is not None
    world, dim = step.world, step.world.scenario.arena.dim
    truth, estimate = world.truth.position[0], step.estimate[0]
    view.truth(truth.numpy(), radius)
    view.estimates(
        agent, estimate.position.double().numpy(), estimate.covariance.numpy(), 0.8 * radius
    )
    view.lines("world/links", _between(truth.numpy(), world.links(0).numpy()), _LINK)
    _log_ranges(view, step)
    view.log("radio/bytes", view.rr.Scalars(float(world.bytes_sent[0].sum())))
    error, scored = world.score(step.action)
    view.scalars(f"error/{agent}", np.where(scored[0], error[0], np.nan))
    apart = step.action[0, :, :dim].double() - truth
    view.scalars(f"nees/{agent}", nees(apart, estimate.covariance.double()).numpy())
    particles = getattr(step.belief, "particles", None)
    if particles is not None:
        alive = step.belief.log_weights[0].isfinite()
        places = in_space(particles[0][alive][:, :dim].numpy())
        colours = np.repeat(_colours(len(alive)), alive.sum(-1).numpy(), 0)
        points = view.rr.Points3D(places, radii=0.2 * radius, colors=colours)
        view.log(f"world/{agent}/particles", points)


def _log_ranges(view: Viewing, step: Step) -> None:
    """Ranges between UAVs, coloured by how far they are from what the estimates say, in standard
    deviations: green for 0, orange from three on."""
    scenario, seen = step.world.scenario, step.observation
    sensor = scenario.believed.sensor(Ranging)
    assert step.estimate is not None
    n = scenario.arena.n_uavs
    if sensor is None or sensor.tags or seen["ranges"].shape[-1] != n:
        return
    place = step.estimate.position[0].double()
    covariance = step.estimate.covariance[0].double()
    apart = place.unsqueeze(1) - place
    distance = apart.norm(dim=-1).clamp_min(1e-9)
    u = apart / distance.unsqueeze(-1)
    spread = covariance.unsqueeze(1) + covariance  # the ends taken for independent
    variance = (u.unsqueeze(-2) @ spread @ u.unsqueeze(-1))[..., 0, 0] + sensor.noise.std**2
    off = ((seen["ranges"][0].double() - distance).abs() / variance.sqrt()).numpy()
    heard = np.triu(seen["range_mask"][0].numpy() > 0, 1)
    share = np.clip(off[heard] / _APART, 0, 1)[:, None]
    colours = ((1 - share) * _FITS + share * _WRONG).astype(np.uint8)
    view.lines("world/ranges", _between(place.numpy(), heard), colours)


def _ellipsoids(axes: Floats) -> tuple[Floats, Floats]:
    """Half lengths [N, 3] (m) and right-handed rotations [N, 3, 3] from half axes as columns."""
    sizes = np.linalg.norm(axes, axis=-2)
    known = (sizes > 0)[..., None, :]  # an ellipse in the plane has no third
    turns = np.where(known, axes / np.maximum(sizes, 1e-300)[..., None, :], np.eye(3))
    turns[..., 0] *= np.sign(np.linalg.det(turns))[..., None]
    return sizes, turns


def _colours(n_uavs: int) -> Floats:
    """RGB [N, 3], 0 to 255."""
    return (255 * uav_colours(n_uavs)).astype(np.uint8)


def _between(places: Floats, pairs: Any) -> Floats:
    """Lines [L, 2, 3] between UAVs [N, d] that are paired [N, N]."""
    points, (i, j) = in_space(places), np.nonzero(pairs)
    return np.stack((points[i], points[j]), 1)


def _radius(low: tuple[float, ...], high: tuple[float, ...]) -> float:
    """Of a UAV's dot (m)."""
    return 0.006 * max(b - a for a, b in zip(low, high, strict=True))
