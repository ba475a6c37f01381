"""The paper's figure 7: each particle's error on a recording, beside a smoother's."""

import torch
from jaxtyping import Float64
from matplotlib.figure import Figure
from torch import Tensor

from agents import make
from training.evaluation.evaluate import Progress
from training.evaluation.rollout import rollout
from training.reproduce.cspf import plan
from training.reproduce.drawing import panels, seconds
from training.reproduce.results import Results
from training.reproduce.store import Arrays, Facts
from training.reproduce.work import Piece, Variant

_LIGHT, _DARK, _ORANGE = "#56B4E9", "#0072B2", "#E69F00"


def compute(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """Run ``stein_vi``, and measure how far each particle is from the truth."""
    (agent,), scenario = piece.agents, piece.variant.build()
    each: list[Tensor] = []
    for step in rollout(make(agent, scenario), scenario, torch.tensor([piece.seed])):
        off = step.belief.x[0, 0, :, :3] - step.world.truth.position[0, 0]
        each.append(off.norm(dim=-1))
        progress(agent, step.k + 1, piece.size)
    return {"error": torch.stack(each).numpy()}, {}


def load(variant: Variant, arrays: Arrays, facts: Facts) -> Float64[Tensor, "K m"]:
    """Position errors of the particles, m."""
    return torch.from_numpy(arrays["error"])


def errors(results: Results) -> Figure | None:
    """Position errors of the particles of `stein_vi` (light), of its estimate (dark) and of a
    sliding-window smoother with Huber's loss (orange) in one run on a recording, a tenth of whose
    landmarks is mistaken (the paper's figure 7)."""
    where = plan.euroc(*plan.SHOWN)
    particles = results.get(where.key, "stein_vi", plan.ERRORS)
    runs = results.runs(where.key, ("stein_vi", plan.SMOOTHER))
    if particles is None or len(runs) < 2:
        return None
    figure, ((axes,),) = panels(1, 1, (8.0, 3.6), f"Particles beside a smoother, {where.title}")
    stein, smoother = runs["stein_vi"], runs[plan.SMOOTHER]
    time = seconds(particles.numpy(), stein.dt)
    lines = axes.plot(time, particles.numpy(), color=_LIGHT, linewidth=0.4, alpha=0.6)
    lines[0].set_label("particles")
    axes.plot(time, smoother.error[0, :, 0], color=_ORANGE, linewidth=1.8, label="smoother")
    axes.plot(time, stein.error[0, :, 0], color=_DARK, linewidth=0.9, label="stein_vi")
    axes.set(xlabel="time (s)", ylabel="position error (m)", ylim=(0, 0.2))
    axes.legend(fontsize=8, loc="upper right")
    return figure


FIGURES = {"errors.png": errors}
