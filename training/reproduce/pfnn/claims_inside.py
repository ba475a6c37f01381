"""What the paper claims of how PF-NN works: adaptation, errors over time, costs, learning."""

from collections.abc import Callable, Iterator

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.reproduce.pfnn import paper
from training.reproduce.pfnn.flown import Case, Flown
from training.reproduce.verdicts import Claim, gain, interval

_NEAR_MAX = 0.95  # of the most particles: "near the maximum"


def inside() -> Iterator[Case]:
    """All of them."""
    yield from _adaptation()
    yield from _over_time()
    yield from _costs()
    yield from _learning()


def _adaptation() -> Iterator[Case]:
    count, us = paper.TABLE_4["pfnn"].particles, ("pfnn",)
    assert count is not None
    yield Case(
        Claim("average particles of PF-NN", f"{count.mean:g}", "", None, count.mean),
        us,
        lambda f: interval(_known(f.particles("pfnn"))),
    )
    yield Case(
        Claim(
            "PF-NN needs fewer particles than Fixed PF",
            f"{count.mean:g} against {paper.MAX_PARTICLES}",
            "",
            "below",
            paper.MAX_PARTICLES,
            count.mean,
        ),
        us,
        lambda f: interval(_known(f.particles("pfnn"))),
    )
    yield Case(
        Claim(
            "particle counts stay near 800 most of the time",
            f"> 50 % of steps at {_NEAR_MAX * paper.MAX_PARTICLES:g} or more",
            "%",
            "above",
            50.0,
        ),
        us,
        lambda f: _share(f, "particles", _NEAR_MAX * paper.MAX_PARTICLES, np.inf),
    )
    low, high = paper.ESS_BAND
    yield Case(
        Claim(
            f"the ESS ratio is predominantly {low} to {high}",
            "> 50 % of steps",
            "%",
            "above",
            50.0,
        ),
        us,
        lambda f: _share(f, "ess_share", low, high),
    )
    first, last = paper.RESAMPLED_EVERY
    yield Case(
        Claim(
            f"most UAVs resample every {first} to {last} steps",
            "> 50 % of UAVs",
            "%",
            "above",
            50.0,
        ),
        us,
        _share_resampling,
    )


def _share(f: Flown, key: str, low: float, high: float) -> Difference:
    """Per cent of the steps after 10 s with a figure from ``low`` to ``high``."""
    values, late = f.tables.agents["pfnn"].series[key][:, f.steady], f.steady
    inside = 100.0 * ((values >= low) & (values <= high))
    return interval(
        metrics.mean_per_run(inside, f.tables.worlds.scored[:, late] & ~np.isnan(values))
    )


def _share_resampling(f: Flown) -> Difference:
    """Per cent of UAVs whose mean time between resamplings (ESS below half) is in the band."""
    few = (f.tables.agents["pfnn"].series["ess_share"][:, f.steady] < 0.5).mean(1)
    with np.errstate(divide="ignore"):
        every = 1 / few
    first, last = paper.RESAMPLED_EVERY
    return interval(100.0 * ((every >= first) & (every <= last)).mean(1))


def _known(values: Floats | None) -> Floats:
    return np.array([np.nan]) if values is None else values


def _over_time() -> Iterator[Case]:
    us = ("pfnn",)
    yield Case(
        Claim("errors start above 2 m", "> 2 m", "m", "above", paper.START_ERROR),
        us,
        lambda f: interval(f.error("pfnn")[:, 0].mean(-1)),
    )
    yield Case(
        Claim(
            "all UAVs are below 1 m after 10 s (the worst of each run)",
            "< 1 m",
            "m",
            "below",
            paper.CONVERGED_ERROR,
        ),
        us,
        lambda f: interval(f.error("pfnn")[:, f.steady][:, 0].max(-1)),
    )
    yield Case(
        Claim("errors have spikes above 2 m (the worst of each run)", "> 2 m", "m", "above", 2.0),
        us,
        lambda f: interval(f.error("pfnn")[:, f.steady].max((1, 2))),
    )
    yield Case(
        Claim(
            "medians are below 0.2 m (the worst UAV of each run)",
            "< 0.2 m",
            "m",
            "below",
            paper.MEDIAN,
        ),
        us,
        lambda f: interval(np.median(f.error("pfnn"), axis=1).max(-1)),
    )


def _costs() -> Iterator[Case]:
    limit = f"{paper.REAL_TIME:g} ms"
    for agent in ("pfnn", "pf500", "pf800", "apf"):
        meets = agent == "pfnn"
        words = f"{paper.METHODS[agent]} {'meets' if meets else 'misses'} {limit} a step"
        theirs = f"{paper.TABLE_5[agent].ms.mean} ms"
        theirs += "" if meets else ": only EKF and PF-NN are said to meet it"
        yield Case(
            Claim(words, theirs, "ms", "below" if meets else "above", paper.REAL_TIME),
            (agent,),
            _step_time(agent),
        )
    for cheap, dear in (("pf500", "pfnn"), ("pfnn", "pf800"), ("apf", "pfnn"), ("ekf", "pfnn")):
        a, b = (paper.TABLE_5[x].ms.mean for x in (cheap, dear))
        size, names = 100 * (1 - a / b), paper.METHODS
        yield Case(
            Claim(
                f"{names[cheap]} takes less time a step than {names[dear]}",
                f"{a} against {b} ms: {size:.1f} % less",
                "%",
                "above",
                0,
                size,
            ),
            (cheap, dear),
            _time_gain(cheap, dear),
        )
    printed = f"{paper.TABLE_5['pfnn'].memory} against {paper.TABLE_5['pf800'].memory} MB"
    yield Case(
        Claim(
            "PF-NN takes less memory than Fixed PF",
            f"{printed}, said to be {paper.MEMORY_SAVING_PF800} % less",
            "%",
            "above",
        ),
        ("pfnn", "pf800"),
        _memory_saving,
    )


def _step_time(agent: str) -> Callable[[Flown], Difference | None]:
    return lambda f: interval(f.cost[agent].ms) if agent in f.cost else None


def _time_gain(cheap: str, dear: str) -> Callable[[Flown], Difference | None]:
    return lambda f: (
        gain(f.cost[cheap].ms, f.cost[dear].ms) if {cheap, dear} <= f.cost.keys() else None
    )


def _memory(f: Flown, agent: str) -> float:
    return f.cost[agent].belief + f.cost[agent].working


def _memory_saving(f: Flown) -> Difference | None:
    """In whole %; it does not vary."""
    if not {"pfnn", "pf800"} <= f.cost.keys():
        return None
    saving = float(round(100 * (1 - _memory(f, "pfnn") / _memory(f, "pf800"))))
    return Difference(saving, saving, saving)


def _learning() -> Iterator[Case]:
    start, end, after = paper.LOSS_START, paper.LOSS_END, paper.LOSS_ITERATIONS

    def loss(f: Flown, at: int) -> Difference | None:
        if f.learning is None or f.learning.loss.shape[1] <= at:
            return None
        return interval(f.learning.loss[:, at])

    us = ("pfnn",)
    yield Case(
        Claim("the training loss starts at about 0.15", f"{start}", "", None, start),
        us,
        lambda f: loss(f, 0),
    )
    yield Case(
        Claim(f"the loss is below 0.05 after {after} trainings", f"< {end}", "", "below", end),
        us,
        lambda f: loss(f, after),
    )

    def against_apf(f: Flown) -> Difference | None:
        if f.learning is None:
            return None
        error = f.learning.error
        ours = metrics.rmse_per_run(error, f.tables.worlds.scored[:, : error.shape[1]])
        return gain(ours, f.rmse("apf"))

    size = paper.GAINS["apf"]
    yield Case(
        Claim(
            "learning in flight, PF-NN's RMSE is below that of Adaptive PF",
            f"by {size} %",
            "%",
            "above",
            0,
            size,
        ),
        ("pfnn", "apf"),
        against_apf,
    )
