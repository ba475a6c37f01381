"""Runs of one agent: on tape, in a batch, or as pictures."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray
from torch import Tensor

from agents.localizer import Estimate, Localizer
from coloc_env.observation import prior_action
from coloc_env.render import Renderer
from coloc_env.scenario import Scenario
from coloc_env.world import World
from training.evaluation.agreement import team_figures

NUMERICAL = (ArithmeticError, RuntimeError, np.linalg.LinAlgError)  # what a filter may die of
_HUGE = 1e30  # m; what lies beyond counts as infinite


@dataclass
class Tape:
    """All that is kept of B runs of an agent over K steps."""

    truth: Float64[Tensor, "B K N d"]
    attitude: Float64[Tensor, "B K N a"]
    scored: Bool[Tensor, "B K N"]
    offset: Float32[Tensor, "B K N d"]
    error: Float32[Tensor, "B K N"]
    nees: Float32[Tensor, "B K N"]
    broken: Bool[Tensor, "B"]
    raised: list[str] = field(default_factory=list)
    series: dict[str, Float32[Tensor, "B K N"]] = field(default_factory=dict)

    @classmethod
    def blank(cls, scenario: Scenario, runs: int) -> "Tape":
        n, dim = scenario.arena.n_uavs, scenario.arena.dim
        shape = (runs, scenario.horizon, n)
        return cls(
            truth=torch.zeros(*shape, dim, dtype=torch.float64),
            attitude=torch.zeros(*shape, 4 if dim == 3 else 1, dtype=torch.float64),
            scored=torch.zeros(shape, dtype=torch.bool),
            offset=torch.zeros(*shape, dim),
            error=torch.zeros(shape),
            nees=torch.full(shape, torch.nan),
            broken=torch.zeros(runs, dtype=torch.bool),
        )

    @staticmethod
    def cat(tapes: Sequence["Tape"]) -> "Tape":
        """The tapes' runs one after the other."""
        if len(tapes) == 1:
            return tapes[0]
        blank = torch.full_like(tapes[0].error[:1], torch.nan)
        return Tape(
            truth=torch.cat([tape.truth for tape in tapes]),
            attitude=torch.cat([tape.attitude for tape in tapes]),
            scored=torch.cat([tape.scored for tape in tapes]),
            offset=torch.cat([tape.offset for tape in tapes]),
            error=torch.cat([tape.error for tape in tapes]),
            nees=torch.cat([tape.nees for tape in tapes]),
            broken=torch.cat([tape.broken for tape in tapes]),
            raised=[message for tape in tapes for message in tape.raised],
            series={
                key: torch.cat([t.series.get(key, blank.expand_as(t.error)) for t in tapes])
                for key in dict.fromkeys(key for t in tapes for key in t.series)
            },
        )


class Fall(Exception):
    """A localizer raised a numerical error at ``step``."""

    def __init__(self, step: int, error: Exception) -> None:
        super().__init__(f"step {step}: {type(error).__name__}: {error}")
        self.step = step


def play(
    localizer: Localizer, scenario: Scenario, seeds: Tensor, tick: Callable[[int], None]
) -> Tape:
    """The runs of some seeds, in one batch as long as the localizer raises nothing.

    Where it does, the batch is halved until it is known whose run it is; that run goes on with its
    last estimates. ``tick(run_steps)`` reports progress.
    """
    try:
        return _fly(localizer, scenario, seeds, tick, scenario.horizon)
    except Fall as fall:
        tick(-fall.step * len(seeds))
        if len(seeds) > 1:
            parts = seeds.tensor_split(2)
            return Tape.cat([play(localizer, scenario, part, tick) for part in parts])
        tape = _fly(localizer, scenario, seeds, tick, fall.step)
        tape.broken[:] = True
        tape.raised.append(str(fall))
        return tape


@torch.no_grad()
def _fly(
    localizer: Localizer,
    scenario: Scenario,
    seeds: Tensor,
    tick: Callable[[int], None],
    stop: int,
) -> Tape:
    """A batch of runs; from step ``stop`` on the last estimates stand."""
    world = World(scenario, len(seeds))
    observation = world.reset(seeds)
    tape = Tape.blank(scenario, len(seeds))
    action, covariance, belief = prior_action(observation, scenario.arena.dim), None, None
    for k in range(scenario.horizon):
        if k < stop:
            try:
                belief = localizer.reset(observation) if belief is None else belief
                belief, estimate = localizer.step(belief, observation)
                own = localizer.diagnostics(belief)
                said = localizer.team(belief)
                own = own if said is None else own | team_figures(said, world.truth)
            except NotImplementedError:
                raise
            except NUMERICAL as error:
                raise Fall(k, error) from error
            action, finite = finite_action(estimate, action)
            covariance = estimate.covariance
            tape.broken |= (~finite & world.alive).any(-1)
            for key, value in own.items():
                if key not in tape.series:
                    tape.series[key] = torch.full_like(tape.error, torch.nan)
                tape.series[key][:, k] = value.to(torch.float32)
        _note(tape, k, world, action, covariance if k < stop else None)
        observation = world.observation()
        tick(len(seeds))
    return tape


def finite_action(
    estimate: Estimate, before: Float32[Tensor, "B N A"]
) -> tuple[Float32[Tensor, "B N A"], Bool[Tensor, "B N"]]:
    """The action, the one before where numbers are not finite, and where they are."""
    action = estimate.action()
    finite = (action.abs() < _HUGE).all(-1) & estimate.covariance.isfinite().all(-1).all(-1)
    return torch.where(finite.unsqueeze(-1), action, before), finite


def _note(
    tape: Tape,
    k: int,
    world: World,
    action: Float32[Tensor, "B N A"],
    covariance: Float64[Tensor, "B N d d"] | None,
) -> None:
    """Write step k on the tape and move the world on."""
    truth = world.truth
    tape.truth[:, k], tape.attitude[:, k] = truth.position, truth.attitude
    offset = action[..., : world.scenario.arena.dim] - truth.position
    if covariance is not None:
        tape.nees[:, k] = nees(offset, covariance.double()).to(torch.float32)
    step = world.step(action)
    tape.offset[:, k] = offset.to(torch.float32)
    tape.error[:, k], tape.scored[:, k] = step.error, step.scored


def nees(
    offset: Float64[Tensor, "*s d"], covariance: Float64[Tensor, "*s d d"]
) -> Float64[Tensor, "*s"]:
    """Normalised estimation error squared eᵀ P⁻¹ e; NaN where P is not positive definite."""
    root, wrong = torch.linalg.cholesky_ex(torch.nan_to_num(covariance))
    scaled = torch.linalg.solve_triangular(root, offset.unsqueeze(-1), upper=False)[..., 0]
    squared = (scaled * scaled).sum(-1)
    good = (wrong == 0) & squared.isfinite()
    return torch.where(good, squared, torch.nan)


@torch.no_grad()
def frames(
    localizer: Localizer,
    scenario: Scenario,
    seed: int,
    steps: int,
    every: int,
    tick: Callable[[int], None],
) -> Iterator[NDArray[np.uint8]]:
    """Pictures [H, W, 3] of a run's first ``steps`` steps, of every ``every``-th one;
    ``tick(steps_done)`` reports progress."""
    world, renderer = World(scenario), Renderer(scenario)
    observation = world.reset(seed)
    belief, action = localizer.reset(observation), prior_action(observation, scenario.arena.dim)
    for k in range(steps):
        belief, estimate = localizer.step(belief, observation)
        action, _ = finite_action(estimate, action)
        renderer.record(world, action)
        if (k + 1) % every == 0:
            picture = renderer.render(world, "rgb_array")
            assert picture is not None
            yield picture
        world.advance(action)
        observation = world.observation()
        tick(k + 1)
    renderer.close()
