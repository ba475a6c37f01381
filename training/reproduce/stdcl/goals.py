"""What ST-DCL was to reach here, and whether it did."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from training.evaluation.metrics import Difference
from training.reproduce.cost import Cost
from training.reproduce.reporting import Table, ends
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.flown import Flown
from training.reproduce.stdcl.measures import Runs, better
from training.reproduce.stdcl.plan import HUBER, OPTIMIZER, WHOLE, Plan
from training.reproduce.study import WORLD
from training.reproduce.verdicts import interval

MET, MISSED, UNKNOWN = "met", "missed", "not measured"
WORSE, BETTER = -3.0, 10.0  # per cent
RULE = "A goal is met if the mean over runs is not beyond its limit; beside it its 95 % interval."


class Goal(NamedTuple):
    """A figure of ours and the limit that it is to stay below, or above."""

    words: str
    unit: str
    limit: float
    above: bool
    needs: tuple[tuple[str, str], ...]
    figure: Callable[..., Difference]


@dataclass(frozen=True)
class Outcome:
    """A goal, what was found, and whether it is met."""

    goal: Goal
    found: Difference | None
    verdict: str


def goals(the: Plan) -> Iterator[Goal]:
    """All under "To beat" of the specification."""
    cases = (
        (the.share(0.15), 2.2),
        (the.speed(plan.MODERATE), 2.6),
        (the.share(0.0), 1.85),
        (the.share(0.3), 2.6),
        (the.share(0.5), 3.2),
        (the.tail(0.5), 2.8),
        (the.failing(0.4), 2.5),
        (the.sparse(2500.0), 4.5),
    )
    for variant, limit in cases:
        bias = "INS bias 0.3 m/s" if variant == the.speed(plan.MODERATE) else variant.title
        yield Goal(f"RMSE, {bias}", "m", limit, False, ((variant.key, WHOLE),), _rmse)
    key = the.sparse(plan.SPARSE[0]).key
    yield Goal("degree 2.5: of INS alone", "", 0.5, False, ((key, WHOLE), (key, WORLD)), _ratio)
    for scene in (*the.stress(), *the.learned()):
        key = scene.variant.key
        if WHOLE in scene.agents and OPTIMIZER in scene.agents and key != the.long().key:
            needs = ((key, WHOLE), (key, OPTIMIZER))
            helped = key.startswith(("sparse-", "ins-")) or scene.variant == the.drifting(0.3)
            limit = BETTER if helped else WORSE
            yield Goal(
                f"better than `{OPTIMIZER}`: {scene.variant.title}", "%", limit, True, needs, better
            )
    key = the.share(0.15).key
    yield Goal(
        f"better than `{HUBER}`: NLOS 15 %", "%", 35.0, True, ((key, WHOLE), (key, HUBER)), better
    )
    yield Goal(
        "1000 steps: last hundred, as a multiple of steps 10 to 110",
        "",
        1.1,
        False,
        ((the.long().key, WHOLE),),
        lambda x: interval(x.drift()),
    )
    ten = the.timed_flight().key
    for key, agent, limit in (
        (the.timed(200).key, OPTIMIZER, 20.0),
        (the.timed(200).key, WHOLE, 40.0),
        (ten, OPTIMIZER, 5.0),
        (ten, WHOLE, 5.0),
    ):
        n = 10 if key == ten else 200
        yield Goal(
            f"N = {n}: median time of `{agent}`",
            "ms",
            limit,
            False,
            ((key, f"ms:{agent}"),),
            _median,
        )


def outcomes(flown: Flown, the: Plan) -> list[Outcome]:
    """Every goal of what was to be flown, measured or not."""
    found, asked = [], {*flown.scenes, *flown.cost}
    for goal in dict.fromkeys(goals(the)):
        if not asked.issuperset(key for key, _ in goal.needs):
            continue
        there = [flown.find(*need) for need in goal.needs]
        value = goal.figure(*there) if all(x is not None for x in there) else None
        found.append(_outcome(goal, value))
    if flown.loop is not None:
        most = float(flown.loop.change.max())
        goal = Goal("largest change of a link's confidence in a step", "%", 10.0, False, (), _rmse)
        found.append(_outcome(goal, Difference(100 * most, 100 * most, 100 * most)))
    return found


def lines(found: list[Outcome]) -> Table:
    """As a table."""
    header = ["goal", "limit", "verdict", "ours (95 %)"]
    rows = []
    for goal, value, verdict in ((x.goal, x.found, x.verdict) for x in found):
        limit = f"{'≥' if goal.above else '≤'} {goal.limit:g} {goal.unit}".strip()
        ours = "–" if value is None else ends(value, "{:.3g}".format)
        rows.append([goal.words, limit.replace("-", "−"), f"**{verdict}**", ours])
    return header, rows


def _outcome(goal: Goal, value: Difference | None) -> Outcome:
    if value is None or np.isnan(value.mean):
        return Outcome(goal, None, UNKNOWN)
    good = value.mean >= goal.limit if goal.above else value.mean <= goal.limit
    return Outcome(goal, value, MET if good else MISSED)


def _rmse(x: Runs) -> Difference:
    return interval(x.rmse)


def _ratio(x: Runs, other: Runs) -> Difference:
    return interval(x.rmse / other.rmse)


def _median(cost: Cost) -> Difference:
    ms = float(np.median(cost.ms))
    return Difference(ms, ms, ms)
