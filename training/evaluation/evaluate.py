"""Evaluation: every agent meets the same worlds, batched over runs, and nothing is ever dropped."""

import statistics
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from agents.errors import NotServed
from agents.localizer import Localizer
from coloc_env.bounds import Bound
from coloc_env.scenario import Scenario
from coloc_env.seeding import checked_seed
from coloc_env.world import World
from training.evaluation.blocks import Block, Bounded, Team
from training.evaluation.innovations import innovations, tracked
from training.evaluation.record import RunRecord
from training.evaluation.results import Evaluation
from training.evaluation.rollout import NUMERICAL, Breakdown, rollout
from training.pool import ALONE, Workers, work

Progress = Callable[[str, int, int], None]


def silent(what: str, done: int, total: int) -> None:
    """Progress that is reported to nobody."""


_FAST = 2**25  # bytes of a batch's beliefs and what is made of them in a step: more fits no cache
_WORKING_SET = 20  # bytes in use at the height of a step per byte of belief
_MOST_RUNS = 10_000_000  # of one evaluation: the record of more fits no memory
_TIMED, _WARM_UP = 50, 5  # steps


def evaluate(
    scenario: Scenario,
    agents: Sequence[str],
    runs: int = 20,
    seed: int = 0,
    progress: Progress = silent,
    *,
    bound: bool = True,
    chunk: int | None = None,
    workers: Workers = ALONE,
    device: str = "cpu",
) -> Evaluation:
    """Run agents (names with options, ``"ekf:robust=huber"``) on the worlds of seeds ``seed`` …
    ``seed + runs − 1``.

    ``progress(what, done, total)`` is called as work is done. ``bound``: compute the posterior
    bound too, where the scenario has one. ``chunk``: runs simulated at once (default: as many as
    are fast); no result depends on it, a localizer's own rounding aside. ``workers``: who computes;
    no digit of a result depends on that, times a step aside, which are measured here
    at the end. ``device``: where worlds, filters and networks are.

    A run in which an agent's estimate is NaN or infinite, or that raises a numerical error, goes on
    with the last finite estimates (the prior before the first) and counts as diverged. An agent
    that does not serve the team, or raises any other error, has no metrics but that error, and the
    others go on; if all do, the first one's error is raised. Raises ValueError, before anything is
    run, for a name or an option that is wrong, and if no agent serves the team.
    """
    _check(agents, runs, seed, chunk)
    truthful = tracked(scenario)
    units: list[Block | Bounded] = [Bounded(scenario, seed, runs)] if bound and truthful else []
    errors: dict[str, Exception] = {}
    localizers: dict[str, Localizer] = {}
    teams = {name: Team(name, scenario, device) for name in agents}
    for name, team in teams.items():  # what is wrong with any is known before one is tried
        try:
            localizers[name] = team.localizer
        except NotServed as error:
            errors[name] = error
    if not localizers:
        raise errors[agents[0]]
    for name in localizers:
        try:
            units += _blocks(teams[name], seed, runs, chunk)
        except Exception as error:
            errors[name] = error
    known: Bound | None = None
    parts: dict[str, dict[int, RunRecord]] = {name: {} for name in agents}
    for found in work(units, workers, _bars(runs * scenario.horizon, progress)):
        unit = found.unit
        if isinstance(unit, Bounded):
            known = found.result
            if found.error is not None:
                _accept_no_bound(scenario, found.error)
        elif found.error is None:
            parts[unit.team.name][unit.seed] = found.result
        else:
            errors.setdefault(unit.team.name, found.error)
    records: dict[str, RunRecord] = {}
    for name in agents:
        if name in errors:
            continue
        try:
            whole = RunRecord.cat([part for _, part in sorted(parts[name].items())])
            ms = ms_per_step(localizers[name], scenario, seed, device)
            records[name] = replace(whole, ms_per_step=ms)
        except Exception as error:
            errors[name] = error
    if not records:
        raise errors[agents[0]]
    seeds = torch.arange(seed, seed + runs)
    without_truth = (
        {}
        if truthful
        else {n: innovations(localizers[n], scenario, seeds, device) for n in records}
    )
    return Evaluation(
        scenario,
        next(iter(records.values())).worlds,
        known,
        records,
        {name: _words(errors[name]) for name in agents if name in errors},
        {name: figures for name, (figures, _) in without_truth.items()},
    )


def split_agents(text: str) -> list[str]:
    """Agents of a list with commas; a piece that starts with a digit, sign or point belongs to the
    option before (``apf:bounds=100,800``), and so does a piece of a path (``weights=a,b/c``)."""
    names: list[str] = []
    for piece in text.split(","):
        head, name = piece.partition("=")[0], piece.partition(":")[0]
        path = "/" in head or ".safetensors" in head or "=" in name
        if names and (path or piece[:1] in set("0123456789+-.")):
            names[-1] += f",{piece}"
        elif piece.strip():
            names.append(piece.strip())
    return names


def _check(agents: Sequence[str], runs: int, seed: int, chunk: int | None) -> None:
    if not agents:
        raise ValueError("no agents: at least one is needed")
    twice = next((name for i, name in enumerate(agents) if name in agents[:i]), None)
    if twice is not None:
        raise ValueError(f"agent {twice!r} is named twice")
    if not 1 <= runs <= _MOST_RUNS:
        raise ValueError(f"runs={runs} is not allowed: 1 to {_MOST_RUNS}")
    checked_seed(seed, "evaluate")
    if chunk is not None and chunk < 1:
        raise ValueError(f"chunk={chunk} is not allowed: at least 1")


def _words(error: Exception) -> str:
    """An error in one line; what a localizer says of a team that it does not serve is enough."""
    kind = "" if isinstance(error, NotServed) else f"{type(error).__name__}: "
    return kind + " ".join(str(error).split())


def _blocks(team: Team, seed: int, runs: int, chunk: int | None) -> list[Block]:
    """All runs of one agent, as many at once as are fast together: the same for all workers."""
    at_once = chunk or _runs_at_once(team)
    firsts = range(0, runs, at_once)
    return [Block(team, seed + first, min(at_once, runs - first)) for first in firsts]


def _bars(total: int, progress: Progress) -> Callable[[Block | Bounded, int], None]:
    """Progress of units as progress of agents, of ``total`` steps each, and of the bound."""
    done: Counter[str] = Counter()

    def tick(unit: Block | Bounded, steps: int) -> None:
        what, size = (unit.team.name, total) if isinstance(unit, Block) else ("bound", unit.size)
        done[what] += steps
        progress(what, done[what], size)

    return tick


def _accept_no_bound(scenario: Scenario, error: Exception) -> None:
    """A scenario that the bound does not cover has none; any other error is raised."""
    if isinstance(error, NotImplementedError):  # a sensor that it cannot count
        warnings.warn(f"{scenario.name}: no posterior bound: {error}", stacklevel=3)
    elif not isinstance(error, ValueError | torch.linalg.LinAlgError):
        raise error


# ------------------------------------------------------------------ cost


def _runs_at_once(team: Team) -> int:
    """How many runs are fastest together, from the size of one run's belief: what fits the CPU's
    caches, or half of a card's free memory."""
    try:
        world = World(team.scenario, device=team.device, window=1)
        size = team.localizer.reset(world.reset(0)).bytes()
    except NUMERICAL:
        return 1
    on_card = world.device.type == "cuda" and torch.cuda.is_available()
    fast = torch.cuda.mem_get_info(world.device)[0] // 2 if on_card else _FAST
    return max(1, fast // (_WORKING_SET * max(1, size)))


def ms_per_step(
    localizer: Localizer, scenario: Scenario, seed: int, device: str | torch.device = "cpu"
) -> float | None:
    """Median time in ms of the whole team's step, one world, one thread, on the ``device`` that the
    localizer is on; None if it raises."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    times: list[float] = []
    given = (localizer, scenario, torch.tensor([seed]))
    try:
        while len(times) < _WARM_UP + _TIMED:
            steps = min(scenario.horizon, _WARM_UP + _TIMED - len(times))
            times += [step.seconds for step in rollout(*given, steps, device=device, timed=True)]
    except Breakdown:
        return None
    finally:
        torch.set_num_threads(threads)
    return 1e3 * statistics.median(times[_WARM_UP:])
