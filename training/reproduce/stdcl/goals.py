"""What ST-DCL was to reach here."""

from collections.abc import Iterator

from training.evaluation.metrics import Difference
from training.reproduce.cost import COST, Cost
from training.reproduce.measures import rmse
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.links import Loop
from training.reproduce.stdcl.measures import better, drift
from training.reproduce.stdcl.plan import HUBER, LOOP, OPTIMIZER, WHOLE, W
from training.reproduce.verdicts import Goal, exactly, interval, mean_of
from training.reproduce.work import WORLD

WORSE, BETTER = -3.0, 10.0  # per cent


def goals(settings: Settings) -> Iterator[Goal]:
    """All under "To beat" of the specification."""
    cases = (
        (W.share(0.15), 2.2),
        (W.speed(plan.MODERATE), 2.6),
        (W.share(0.0), 1.85),
        (W.share(0.3), 2.6),
        (W.share(0.5), 3.2),
        (W.tail(0.5), 2.8),
        (W.failing(0.4), 2.5),
        (W.sparse(2500.0), 4.5),
    )
    for variant, limit in cases:
        bias = "INS bias 0.3 m/s" if variant == W.speed(plan.MODERATE) else variant.title
        yield Goal(f"RMSE, {bias}", "m", limit, False, ((variant.key, WHOLE),), mean_of(rmse))
    key = W.sparse(plan.SPARSE[0]).key
    yield Goal("degree 2.5: of INS alone", "", 0.5, False, ((key, WHOLE), (key, WORLD)), _ratio)
    for variant in (*plan.stressed(W), *W.held_out().values()):
        key = variant.key
        helped = key.startswith(("sparse-", "ins-")) or variant == W.drifting(0.3)
        needs = ((key, WHOLE), (key, OPTIMIZER))
        words = f"better than `{OPTIMIZER}`: {variant.title}"
        yield Goal(words, "%", BETTER if helped else WORSE, True, needs, better)
    key = W.share(0.15).key
    yield Goal(
        f"better than `{HUBER}`: NLOS 15 %", "%", 35.0, True, ((key, WHOLE), (key, HUBER)), better
    )
    yield Goal(
        "1000 steps: last hundred, as a multiple of steps 10 to 110",
        "",
        1.1,
        False,
        ((W.long().key, WHOLE),),
        mean_of(drift),
    )
    ten = W.timed_flight().key
    for key, agent, limit in (
        (W.timed(200).key, OPTIMIZER, 20.0),
        (W.timed(200).key, WHOLE, 40.0),
        (ten, OPTIMIZER, 5.0),
        (ten, WHOLE, 5.0),
    ):
        n = 10 if key == ten else 200
        yield Goal(
            f"N = {n}: median time of `{agent}`",
            "ms",
            limit,
            False,
            ((key, agent, COST),),
            _median,
        )
    words = "largest change of a link's confidence in a step"
    yield Goal(words, "%", 10.0, False, ((W.long().key, WHOLE, LOOP),), _largest_change)


def _ratio(one: Runs, other: Runs) -> Difference:
    return interval(rmse(one) / rmse(other))


def _median(cost: Cost) -> Difference:
    return exactly(cost.median)


def _largest_change(loop: Loop) -> Difference:
    return exactly(100 * float(loop.change.max()))
