"""Evaluation: every agent meets the same worlds, batched over runs, and nothing is ever dropped."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

import agents as _agents  # noqa: F401  (registers the localizers)
from agents.localizer import Estimate, Localizer, make
from coloc_env.bounds import Bound, posterior_bound
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.world import World
from training.results import AgentResult, Results

Progress = Callable[[str, int, int], None]

_MEMORY = 2**30  # bytes that a batch's beliefs and what is made of them in a step may take
_WORKING_SET = 20  # bytes in use at the height of a step per byte of belief
_HUGE = 1e30  # m; what lies beyond counts as infinite
_NUMERICAL = (ArithmeticError, RuntimeError, np.linalg.LinAlgError)  # what a filter may die of
_TIMED, _WARM_UP = 50, 5  # steps


def evaluate(
    scenario: Scenario,
    agents: Sequence[str],
    runs: int = 20,
    seed: int = 0,
    progress: Progress | None = None,
    *,
    bound: bool = True,
    chunk: int | None = None,
) -> Results:
    """Run agents (names with options, ``"ekf:robust=huber"``) on the worlds of seeds ``seed`` …
    ``seed + runs − 1``.

    ``progress(what, done, total)`` is called as work is done. ``bound``: compute the posterior
    bound too, where the scenario has one. ``chunk``: runs simulated at once (default: as many as
    memory allows); it changes no result.

    A run in which an agent says NaN or infinity, or raises a numerical error, goes on with the last
    finite estimates (the prior before the first) and counts as diverged.
    """
    _check(agents, runs, seed, chunk)
    team = {name: make(name, scenario) for name in agents}
    tell = progress or (lambda what, done, total: None)
    known = _bound(scenario, runs, seed, tell) if bound else None
    results: dict[str, AgentResult] = {}
    tape = None
    for name, localizer in team.items():
        tape = _play(name, localizer, scenario, runs, seed, chunk, tell)
        results[name] = AgentResult(
            offset=tape.offset.numpy(),
            error=tape.error.numpy(),
            nees=tape.nees.numpy(),
            broken=tape.broken.numpy(),
            raised=len(tape.raised),
            message=tape.raised[0] if tape.raised else None,
            series={key: value.numpy() for key, value in tape.series.items()},
            ms_per_step=ms_per_step(localizer, scenario, seed),
        )
    assert tape is not None
    return Results(
        scenario=scenario,
        seed=seed,
        truth=tape.truth.numpy(),
        attitude=tape.attitude[0].numpy(),
        scored=tape.scored.numpy(),
        bound=known,
        agents=results,
    )


def _check(agents: Sequence[str], runs: int, seed: int, chunk: int | None) -> None:
    if not agents:
        raise ValueError("no agents: at least one is needed")
    twice = next((name for i, name in enumerate(agents) if name in agents[:i]), None)
    if twice is not None:
        raise ValueError(f"agent {twice!r} is named twice")
    if runs < 1:
        raise ValueError(f"runs={runs} is not allowed: at least 1")
    if not 0 <= seed < 2**62:
        raise ValueError(f"seed={seed} is not allowed: a whole number from 0 to 2^62")
    if chunk is not None and chunk < 1:
        raise ValueError(f"chunk={chunk} is not allowed: at least 1")


def _bound(scenario: Scenario, runs: int, seed: int, tell: Progress) -> Bound | None:
    """The posterior bound over the same worlds; None for a scenario that it does not cover."""
    tell("bound", 0, 1)
    try:
        known = posterior_bound(scenario, runs=runs, seed=seed)
    except (ValueError, NotImplementedError, torch.linalg.LinAlgError):
        known = None
    tell("bound", 1, 1)
    return known


# ------------------------------------------------------------------ one agent


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
        names = ("truth", "attitude", "scored", "offset", "error", "nees", "broken")
        blank = torch.full_like(tapes[0].error[:1], torch.nan)
        series = {
            key: torch.cat([t.series.get(key, blank.expand_as(t.error)) for t in tapes])
            for key in dict.fromkeys(key for t in tapes for key in t.series)
        }
        return Tape(
            *(torch.cat([getattr(tape, name) for tape in tapes]) for name in names),
            raised=[message for tape in tapes for message in tape.raised],
            series=series,
        )


def _play(
    name: str,
    localizer: Localizer,
    scenario: Scenario,
    runs: int,
    seed: int,
    chunk: int | None,
    tell: Progress,
) -> Tape:
    """All runs of one agent, as many at once as memory allows."""
    at_once = chunk or _runs_at_once(localizer, scenario)
    done, total = 0, runs * scenario.horizon

    def tick(steps: int) -> None:
        nonlocal done
        done += steps
        tell(name, done, total)

    seeds = torch.arange(seed, seed + runs)
    return Tape.cat([simulate(localizer, scenario, part, tick) for part in seeds.split(at_once)])


class Fall(Exception):
    """A localizer raised a numerical error at ``step``."""

    def __init__(self, step: int, error: Exception) -> None:
        super().__init__(f"step {step}: {type(error).__name__}: {error}")
        self.step = step


def simulate(
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
            return Tape.cat([simulate(localizer, scenario, part, tick) for part in parts])
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
    action, covariance, belief = _prior_action(observation, scenario.arena.dim), None, None
    for k in range(scenario.horizon):
        if k < stop:
            try:
                belief = localizer.reset(observation) if belief is None else belief
                belief, estimate = localizer.step(belief, observation)
                own = localizer.diagnostics(belief)
            except NotImplementedError:
                raise
            except _NUMERICAL as error:
                raise Fall(k, error) from error
            action, finite = _finite(estimate, action)
            covariance = estimate.covariance
            tape.broken |= (~finite & world.alive).any(-1)
            for key, value in own.items():
                blank = torch.full_like(tape.error, torch.nan)
                tape.series.setdefault(key, blank)[:, k] = value.to(torch.float32)
        _note(tape, k, world, action, covariance if k < stop else None)
        observation = world.observation()
        tick(len(seeds))
    return tape


def _prior_action(observation: Observation, dim: int) -> Float32[Tensor, "B N A"]:
    """What each UAV is told of its start, as an action."""
    prior = observation["prior"]
    return torch.cat((prior[..., : 2 * dim], prior[..., -2 - dim : -2].clamp_min(1e-6).log()), -1)


def _finite(
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


# ------------------------------------------------------------------ cost


def _runs_at_once(localizer: Localizer, scenario: Scenario) -> int:
    """How many runs fit in memory, from the size of one run's belief."""
    try:
        size = localizer.reset(World(scenario, window=1).reset(0)).bytes()
    except _NUMERICAL:
        return 1
    return max(1, _MEMORY // (_WORKING_SET * max(1, size)))


@torch.no_grad()
def ms_per_step(localizer: Localizer, scenario: Scenario, seed: int) -> float | None:
    """Median time in ms of the whole team's step, one world, one thread; None if it raises."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    world, times = World(scenario), []
    try:
        while len(times) < _WARM_UP + _TIMED:
            observation = world.reset(seed)
            belief = localizer.reset(observation)
            for _ in range(min(scenario.horizon, _WARM_UP + _TIMED - len(times))):
                start = time.perf_counter()
                belief, estimate = localizer.step(belief, observation)
                times.append(time.perf_counter() - start)
                world.advance(estimate.action())
                observation = world.observation()
    except _NUMERICAL:
        return None
    finally:
        torch.set_num_threads(threads)
    return 1e3 * statistics.median(times[_WARM_UP:])
