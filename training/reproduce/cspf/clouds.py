"""The paper's figures 3 to 5: the particles of one run, in the plane and in space."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from agents import make
from agents.stein.match_window import observed_matches
from coloc_env.geometry import poses_in
from coloc_env.sensors import RelativePose
from training.evaluation.evaluate import Progress
from training.evaluation.metrics import Flags
from training.evaluation.rollout import rollout
from training.reproduce.cspf import plan
from training.reproduce.drawing import headline, panels
from training.reproduce.results import Results
from training.reproduce.store import Arrays, Facts
from training.reproduce.work import Piece, Variant

_COLOURS = ("#0072B2", "#D55E00", "#009E73")
_WRONG = "#CC0000"
_FAR = 6.0  # standard deviations from the true relative pose: a wrong match
_SHOWN = (0, 10, 30, 150)  # steps of the figure in space
_HALF = 5.0  # m, half of the arena's side
_REACH = 10.0  # m: beyond this no UAV can be relative to another


@dataclass(frozen=True)
class Clouds:
    """One run of ``cspf``, relative to UAV 0: each UAV's ``particles`` of itself and its ``truth``
    (m), the ``ends`` of each step's first match, and whether a match was ``wrong``."""

    particles: Float64[Tensor, "K N m d"]
    truth: Float64[Tensor, "K N d"]
    ends: Int64[Tensor, "K 2"]
    wrong: Bool[Tensor, "K"]

    @property
    def uavs(self) -> int:
        return self.truth.shape[1]


def compute(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """Run ``cspf``, and look at its particles."""
    (agent,), scenario = piece.agents, piece.variant.build()
    dim = scenario.arena.dim
    poses, sensor = poses_in(dim), scenario.believed.sensor(RelativePose)
    assert sensor is not None
    own = torch.arange(scenario.arena.n_uavs)
    linked = torch.ones(1, len(own), len(own), dtype=torch.bool)
    each: list[tuple[Tensor, ...]] = []
    for step in rollout(make(agent, scenario), scenario, torch.tensor([piece.seed])):
        true = torch.cat((step.world.truth.position, step.world.truth.attitude), -1)[0].double()
        match = observed_matches(poses, step.observation, linked, False)
        holder = int(match.mask[0].any(-1).int().argmax())
        slot = int(match.mask[0, holder].int().argmax())
        ends = torch.stack((match.first, match.second), -1)[0, holder, slot]
        off = poses.minus(match.pose[0, holder, slot], poses.between(*true[ends]))
        wrong = bool((off[:dim].norm() > _FAR * sensor.std).item())
        particles = step.belief.x[0, own, own, :, :dim]
        each.append((particles, poses.between(true[:1], true)[:, :dim], ends, torch.tensor(wrong)))
        progress(agent, step.k + 1, piece.size)
    names = ("particles", "truth", "ends", "wrong")
    parts = zip(*each, strict=True)
    return {name: torch.stack(x).numpy() for name, x in zip(names, parts, strict=True)}, {}


def load(variant: Variant, arrays: Arrays, facts: Facts) -> Clouds:
    """What ``compute`` made."""
    return Clouds(**{name: torch.from_numpy(x) for name, x in arrays.items()})


def clouds(results: Results, dim: int) -> Clouds | None:
    """The study's first world with the paper's share of outliers; None where it was not run."""
    found: Clouds | None = results.get(plan.drawn(dim), "cspf", plan.DRAWN)
    return found


def plane(results: Results) -> Figure | None:
    """One run in the plane (the paper's figure 3): where the three UAVs are and which pair measures
    its relative pose (red: a wrong one), and each UAV's particles of itself, relative to UAV 0, in
    the first step and in the last one shown."""
    found = clouds(results, 2)
    if found is None:
        return None
    last = len(found.truth) - 1
    figure, (row,) = panels(1, 3, (10.0, 3.6), "Particles in the plane", sharex=True, sharey=True)
    for i, at in enumerate(found.truth[0].numpy()):
        row[0].plot(*at, "o", color=_COLOURS[i % 3], label=f"UAV {i}")
    colour = _WRONG if found.wrong[0] else "black"
    row[0].plot(*found.truth[0, found.ends[0]].T.numpy(), ":", color=colour)
    row[0].set(title="truth, step 0", ylabel="y (m)")
    row[0].legend(fontsize=7)
    for axes, k in zip(row[1:], (0, last), strict=True):
        for i in range(found.uavs):
            axes.plot(*found.particles[k, i].T.numpy(), ".", color=_COLOURS[i % 3], alpha=0.6)
            axes.plot(*found.truth[k, i].numpy(), "k+", markersize=9)
        axes.set(title=f"particles, step {k}")
    for axes in row:
        axes.set(xlabel="x (m)", aspect="equal", xlim=(-_REACH, _REACH), ylim=(-_REACH, _REACH))
    return figure


def coordinates(results: Results) -> Figure | None:
    """Coordinates of all particles of that run over its steps, relative to UAV 0 (figure 4); black:
    the truth; red: steps with a wrong match."""
    found = clouds(results, 2)
    if found is None:
        return None
    figure, rows = panels(2, 1, (7.0, 5.0), "Particles over time", sharex=True)
    for axis, (axes,) in enumerate(rows):
        for i in range(1, found.uavs):
            lines = found.particles[:, i, :, axis].numpy()
            axes.plot(lines, color=_COLOURS[i % 3], linewidth=0.5, alpha=0.5)
            axes.plot(found.truth[:, i, axis].numpy(), "k--", linewidth=1.2)
        _mark(axes, found.wrong.numpy())
        axes.set(ylabel=f"{'xy'[axis]} (m)")
    rows[-1][0].set(xlabel="step")
    return figure


def space(results: Results) -> Figure | None:
    """One run in space (figure 5): each UAV's particles of itself, relative to UAV 0, as they
    converge; crosses: the truth."""
    found = clouds(results, 3)
    if found is None:
        return None
    shown = [k for k in _SHOWN if k < len(found.truth)]
    figure = Figure(figsize=(3.2 * len(shown), 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    headline(figure, "Particles in space")
    for column, k in enumerate(shown, start=1):
        axes = figure.add_subplot(1, len(shown), column, projection="3d")
        for i in range(found.uavs):
            axes.plot(*found.particles[k, i].T.numpy(), ".", color=_COLOURS[i % 3], alpha=0.6)
            axes.plot(*found.truth[k, i].unsqueeze(-1).numpy(), "k+", markersize=9)
        axes.set(title=f"step {k}", xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
        axes.set(**{f"{axis}lim": (-_HALF, _HALF) for axis in "xyz"})
    return figure


def _mark(axes: Axes, wrong: Flags) -> None:
    """Vertical lines at the steps with a wrong match."""
    for k in np.flatnonzero(wrong):
        axes.axvline(float(k), color=_WRONG, linestyle=":", linewidth=0.6)


FIGURES = {"plane.png": plane, "coordinates.png": coordinates, "space.png": space}
