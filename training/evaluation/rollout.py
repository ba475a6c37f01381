"""The rollout: a localizer in its worlds, step by step. Everything that runs localizers uses it."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from agents.localizer import Estimate, Localizer, finite_action
from coloc_env.commands import Commands
from coloc_env.observation import Observation, prior_action
from coloc_env.scenario import Scenario
from coloc_env.world import World
from training.devices import clock

NUMERICAL = (ArithmeticError, RuntimeError, np.linalg.LinAlgError)  # how a filter may break down


class Breakdown(Exception):
    """A localizer raised a numerical error at step ``k``."""

    def __init__(self, k: int, error: Exception) -> None:
        super().__init__(f"step {k}: {type(error).__name__}: {error}")
        self.k = k


@dataclass(frozen=True)
class Step:
    """Step ``k`` of B worlds: the ``world`` still at k, what was observed, and what came of it.

    ``belief`` and ``estimate`` after the observation was used (None once the localizer is no longer
    asked); ``action`` [B, N, A] that is scored and sent, the last one where an estimate is not
    ``finite``; ``seconds`` that the localizer took.
    """

    k: int
    world: World
    observation: Observation
    belief: Any
    estimate: Estimate | None
    action: Float32[Tensor, "B N A"]
    finite: Bool[Tensor, "B N"]
    seconds: float


@torch.no_grad()
def rollout(
    localizer: Localizer | None,
    scenario: Scenario,
    seeds: Int64[Tensor, "B"],
    steps: int | None = None,
    stop: int | None = None,
    device: str | torch.device = "cpu",
    timed: bool = False,
    commands: Callable[[int], Commands] | None = None,
) -> Iterator[Step]:
    """A localizer's steps in the worlds of ``seeds``: ``steps`` of them (default: the horizon).
    Without one nobody estimates, and the action is what the prior says.

    The world moves on when the next step is asked for. From step ``stop`` on the localizer is not
    asked any more, and its last action stands. Worlds are on ``device``, where the localizer must
    be (``localizer.to``); ``timed``: wait for the device, so that ``seconds`` are those of the
    step; ``commands(k)``: what the team commands for the step k → k + 1. Raises Breakdown
    for a numerical error.
    """
    world = World(scenario, len(seeds), device)
    observation = world.reset(seeds)
    action = prior_action(observation, scenario.arena.dim)
    belief, estimate = None, None
    finite = torch.ones_like(action[..., 0], dtype=torch.bool)
    horizon = scenario.horizon if steps is None else steps
    for k in range(horizon):
        seconds = 0.0
        if localizer is not None and (stop is None or k < stop):
            try:
                belief = localizer.reset(observation) if k == 0 else belief
                start = clock(world.device) if timed else time.perf_counter()
                belief, estimate = localizer.step(belief, observation)
                seconds = (clock(world.device) if timed else time.perf_counter()) - start
            except NotImplementedError:
                raise
            except NUMERICAL as error:
                raise Breakdown(k, error) from error
            if k == 0:
                _require_estimate(localizer, estimate, action.shape[:2], scenario.arena.dim)
            action, finite = finite_action(estimate, action)
        else:
            estimate, finite = None, torch.ones_like(finite)
        yield Step(k, world, observation, belief, estimate, action, finite, seconds)
        if k + 1 < horizon:
            world.advance(action, None if commands is None else commands(k))
            observation = world.observation()


def _require_estimate(localizer: Localizer, estimate: Any, batch: torch.Size, d: int) -> None:
    """Raise ValueError for what is no Estimate of each UAV, with the shape that is needed."""
    who = type(localizer).__name__
    if not isinstance(estimate, Estimate):
        raise ValueError(
            f"{who}.step must return a belief and an Estimate, not {type(estimate).__name__}"
        )
    for key, shape in (("position", (d,)), ("velocity", (d,)), ("covariance", (d, d))):
        found = getattr(estimate, key).shape
        if found != batch + shape:
            needed = [*batch, *shape]
            raise ValueError(f"{who}: an estimate's {key} must be {needed}, not {[*found]}")
