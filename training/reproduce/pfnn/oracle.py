"""PF-NN with a corrector that cannot be better: y = exp(−‖p − p_true‖), its own target."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from agents import make
from agents.particle.belief import ParticleBelief
from coloc_env.observation import prior_action
from coloc_env.scenario import Scenario
from coloc_env.world import World
from training.evaluation.evaluate import Progress
from training.evaluation.metrics import Floats
from training.evaluation.rollout import rollout
from training.reproduce.store import Arrays, Facts
from training.reproduce.work import Piece, Variant


@dataclass(frozen=True, eq=False)
class Oracle:
    """``error`` (m) and ``count`` of particles [R, K, N]."""

    error: Floats
    count: Floats


def compute(piece: Piece, progress: Progress) -> tuple[Arrays, Facts]:
    """The agent's runs with the correction that the truth gives."""
    (agent,), scenario = piece.agents, piece.variant.build()
    seeds = torch.arange(piece.seed, piece.seed + piece.runs)
    truth = _truth(scenario, seeds)
    localizer: Any = make(agent, scenario)
    low, high = localizer.correction

    def log_correction(
        particles: Float32[Tensor, "B N M S"], belief: ParticleBelief
    ) -> Float32[Tensor, "B N M"]:
        place = truth[int(belief.step.max())].unsqueeze(-2).to(particles.dtype)
        apart = (particles[..., : place.shape[-1]] - place).norm(dim=-1)
        return (low + (high - low) * (-apart).exp()).log()  # equations 14 and 15

    localizer.log_correction = log_correction
    errors, counts = [], []
    for step in rollout(localizer, scenario, seeds):
        assert step.estimate is not None
        errors.append((step.estimate.position.double() - truth[step.k]).norm(dim=-1))
        counts.append(localizer.diagnostics(step.belief)["particles"])
        progress(agent, piece.runs * (step.k + 1), piece.size)
    return {k: torch.stack(v, 1).numpy() for k, v in (("error", errors), ("count", counts))}, {}


def load(variant: Variant, arrays: Arrays, facts: Facts) -> Oracle:
    """What ``compute`` made."""
    return Oracle(**arrays)


def _truth(scenario: Scenario, seeds: Tensor) -> list[Float64[Tensor, "B N d"]]:
    """Positions (m) at every step: motion is scripted, whatever the estimates."""
    world = World(scenario, len(seeds))
    action = prior_action(world.reset(seeds), scenario.arena.dim)
    places = []
    for k in range(scenario.horizon):
        places.append(world.truth.position)
        if k + 1 < scenario.horizon:
            world.advance(action)
    return places
