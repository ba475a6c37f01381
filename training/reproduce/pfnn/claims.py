"""What the paper claims of PF-NN: its errors, its particles, its cost, and how it learns.

Claims about its particle filters are judged by those that run as printed (``variant=paper``).
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.reproduce.cost import COST, Cost
from training.reproduce.measures import largest, rmse
from training.reproduce.pfnn import paper
from training.reproduce.pfnn.plan import (
    DEFAULT,
    FIGURE_9,
    ONLINE,
    PRINTED,
    PRINTED_ABLATION,
    Online,
    particles,
    steady,
)
from training.reproduce.results import Need, Runs
from training.reproduce.settings import Settings
from training.reproduce.verdicts import (
    Claim,
    Found,
    exactly,
    gain,
    gain_in,
    interval,
    least,
    mean_of,
)

_US: Need = (DEFAULT, PRINTED["pfnn"])
_NAMES = paper.METHODS
_NEAR_MAX = 0.95 * paper.MAX_PARTICLES  # "near the maximum"


def claims(settings: Settings) -> Iterator[Claim]:
    """All of them."""
    yield from _accuracy()
    yield from _comparisons()
    yield from _adaptation()
    yield from _over_time()
    yield from _costs()
    yield from _learning()


def _in(*methods: str) -> tuple[Need, ...]:
    """Of the paper's methods, as printed where we have that."""
    return tuple((DEFAULT, PRINTED.get(method, method)) for method in methods)


def _accuracy() -> Iterator[Claim]:
    row = paper.TABLE_4["pfnn"]
    yield Claim(
        "PF-NN's RMSE", f"{row.rmse.mean} m", "m", None, row.rmse.mean,
        needs=(_US,), figure=mean_of(rmse),
    )  # fmt: skip
    yield Claim(
        "sub-metre accuracy", "RMSE < 1 m", "m", "below", paper.SUB_METRE,
        needs=(_US,), figure=mean_of(rmse),
    )  # fmt: skip
    yield Claim(
        "PF-NN's largest error", f"{row.max.mean} m", "m", None, row.max.mean,
        needs=(_US,), figure=mean_of(largest),
    )  # fmt: skip


def _comparisons() -> Iterator[Claim]:
    for other, size in paper.GAINS.items():
        yield Claim(
            f"PF-NN's RMSE is below that of {_NAMES[other]}", f"by {size} %", "%", "above", 0.0,
            size, _in("pfnn", other), gain_in(rmse),
        )  # fmt: skip
    size = paper.MAX_GAIN_PF500
    yield Claim(
        f"PF-NN's largest error is below that of {_NAMES['pf500']}", f"by {size} %", "%", "above",
        0.0, size, _in("pfnn", "pf500"), gain_in(largest),
    )  # fmt: skip
    pairs = (("pfnn", "pf800"), ("apf", "pf800"), ("pf800", "pf500"), ("pf500", "ekf"))
    for pair in (*pairs, ("dfgo", "pfnn")):
        a, b = (paper.TABLE_4[agent].rmse.mean for agent in pair)
        yield Claim(
            f"{_NAMES[pair[0]]}'s RMSE is below that of {_NAMES[pair[1]]}", f"{a} against {b} m",
            "%", "above", 0.0, 100 * (1 - a / b), _in(*pair), gain_in(rmse),
        )  # fmt: skip
    rivals = ("pf500", "pf800", "apf", "ekf", "dlspf")
    yield Claim(
        "PF-NN is the best of all methods but DFGO", "lowest RMSE", "%", "above",
        needs=_in("pfnn", *rivals), figure=_least(rmse),
    )  # fmt: skip
    yield Claim(
        "PF-NN has the lowest RMSE of all particle filters in most of figure 9's runs",
        "consistently", "%", "above", 50.0,
        needs=tuple((FIGURE_9, PRINTED[agent]) for agent in ("pfnn", *rivals[:3])), figure=_wins,
    )  # fmt: skip
    proposed = PRINTED["pfnn"]
    others = [agent for agent in PRINTED_ABLATION if agent != proposed]
    for what, measure in (("RMSE", rmse), ("largest error", largest)):
        yield Claim(
            f"[0.4, 1.0] gives the lowest {what} of all ranges", "lowest", "%", "above",
            needs=_in(proposed, *others), figure=_least(measure),
        )  # fmt: skip


def _least(measure: Callable[[Runs], Floats]) -> Callable[..., Difference]:
    def figure(own: Runs, *others: Runs) -> Difference:
        return least([(measure(own), measure(other)) for other in others])

    return figure


def _wins(own: Runs, *rivals: Runs) -> Difference:
    """Per cent of runs in which PF-NN is the best."""
    best = np.min([rmse(rival) for rival in rivals], axis=0)
    return interval(100.0 * (rmse(own) < best))


def _adaptation() -> Iterator[Claim]:
    count = paper.TABLE_4["pfnn"].particles
    assert count is not None
    yield Claim(
        "average particles of PF-NN", f"{count.mean:g}", "", None, count.mean,
        needs=(_US,), figure=mean_of(particles),
    )  # fmt: skip
    yield Claim(
        "PF-NN needs fewer particles than Fixed PF",
        f"{count.mean:g} against {paper.MAX_PARTICLES}", "", "below", paper.MAX_PARTICLES,
        count.mean, (_US,), mean_of(particles),
    )  # fmt: skip
    yield Claim(
        "particle counts stay near 800 most of the time",
        f"> 50 % of steps at {_NEAR_MAX:g} or more", "%", "above", 50.0,
        needs=(_US,), figure=_share_within("particles", _NEAR_MAX, np.inf),
    )  # fmt: skip
    low, high = paper.ESS_BAND
    yield Claim(
        f"the ESS ratio is predominantly {low} to {high}", "> 50 % of steps", "%", "above", 50.0,
        needs=(_US,), figure=_share_within("ess_share", low, high),
    )  # fmt: skip
    first, last = paper.RESAMPLED_EVERY
    yield Claim(
        f"most UAVs resample every {first} to {last} steps", "> 50 % of UAVs", "%", "above", 50.0,
        needs=(_US,), figure=_share_resampling,
    )  # fmt: skip


def _share_within(series: str, low: float, high: float) -> Callable[[Runs], Difference]:
    """Per cent of the steps after 10 s with a figure from ``low`` to ``high``."""

    def figure(one: Runs) -> Difference:
        late = steady(one)
        values = one.record.series[series][:, late]
        inside = 100.0 * ((values >= low) & (values <= high))
        return interval(metrics.mean_per_run(inside, one.scored[:, late] & ~np.isnan(values)))

    return figure


def _share_resampling(one: Runs) -> Difference:
    """Per cent of UAVs whose mean time between resamplings (ESS below half) is in the band."""
    few = (one.record.series["ess_share"][:, steady(one)] < 0.5).mean(1)
    with np.errstate(divide="ignore"):
        every = 1 / few
    first, last = paper.RESAMPLED_EVERY
    return interval(100.0 * ((every >= first) & (every <= last)).mean(1))


def _over_time() -> Iterator[Claim]:
    yield Claim(
        "errors start above 2 m", "> 2 m", "m", "above", paper.START_ERROR,
        needs=(_US,), figure=lambda x: interval(x.error[:, 0].mean(-1)),
    )  # fmt: skip
    yield Claim(
        "all UAVs are below 1 m after 10 s (the worst of each run)", "< 1 m", "m", "below",
        paper.CONVERGED_ERROR,
        needs=(_US,), figure=lambda x: interval(x.error[:, steady(x)][:, 0].max(-1)),
    )  # fmt: skip
    yield Claim(
        "errors have spikes above 2 m (the worst of each run)", "> 2 m", "m", "above",
        paper.SPIKES, needs=(_US,), figure=lambda x: interval(x.error[:, steady(x)].max((1, 2))),
    )  # fmt: skip
    yield Claim(
        "medians are below 0.2 m (the worst UAV of each run)", "< 0.2 m", "m", "below",
        paper.MEDIAN,
        needs=(_US,), figure=lambda x: interval(np.median(x.error, axis=1).max(-1)),
    )  # fmt: skip


def _costs() -> Iterator[Claim]:
    for agent in ("pfnn", "pf500", "pf800", "apf"):
        meets = agent == "pfnn"
        theirs = f"{paper.TABLE_5[agent].ms.mean} ms"
        yield Claim(
            f"{_NAMES[agent]} {'meets' if meets else 'misses'} {paper.REAL_TIME:g} ms a step",
            theirs + ("" if meets else ": only EKF and PF-NN are said to meet it"),
            "ms", "below" if meets else "above", paper.REAL_TIME,
            needs=_costs_of(agent), figure=lambda x: interval(x.ms),
        )  # fmt: skip
    pairs = [("pf500", "pfnn"), ("pfnn", "pf800"), ("apf", "pfnn"), ("ekf", "pfnn")]
    pairs += [("pfnn", "dfgo"), ("pfnn", "dlspf")]
    for cheap, expensive in pairs:
        a, b = (paper.TABLE_5[x].ms.mean for x in (cheap, expensive))
        size = 100 * (1 - a / b)
        yield Claim(
            f"{_NAMES[cheap]} takes less time a step than {_NAMES[expensive]}",
            f"{a} against {b} ms: {size:.1f} % less", "%", "above", 0, size,
            _costs_of(cheap, expensive), lambda x, y: gain(x.ms, y.ms),
        )  # fmt: skip
    printed = f"{paper.TABLE_5['pfnn'].memory} against {paper.TABLE_5['pf800'].memory} MB"
    yield Claim(
        "PF-NN takes less memory than Fixed PF",
        f"{printed}, said to be {paper.MEMORY_SAVING_PF800} % less", "%", "above",
        needs=_costs_of("pfnn", "pf800"), figure=_memory_saving,
    )  # fmt: skip


def _costs_of(*methods: str) -> tuple[Need, ...]:
    return tuple((*need, COST) for need in _in(*methods))


def _memory_saving(one: Cost, other: Cost) -> Difference:
    """In whole %; it does not vary."""
    return exactly(float(round(100 * (1 - one.held / other.held))))


def _learning() -> Iterator[Claim]:
    online: Iterable[Need] = ((*_US, ONLINE),)
    start, end, after = paper.LOSS_START, paper.LOSS_END, paper.LOSS_ITERATIONS
    yield Claim(
        "the training loss starts at about 0.15", f"{start}", "", None, start,
        needs=tuple(online), figure=_loss(0),
    )  # fmt: skip
    yield Claim(
        f"the loss is below 0.05 after {after} trainings", f"< {end}", "", "below", end,
        needs=tuple(online), figure=_loss(after),
    )  # fmt: skip
    size = paper.GAINS["apf"]
    yield Claim(
        "learning in flight, PF-NN's RMSE is below that of Adaptive PF", f"by {size} %", "%",
        "above", 0, size, (*online, *_in("apf")), _online_gain,
    )  # fmt: skip


def _loss(at: int) -> Callable[[Online], Found]:
    few = f"fewer than {at + 1} trainings"
    return lambda x: interval(x.loss[:, at]) if x.loss.shape[1] > at else few


def _online_gain(online: Online, apf: Runs) -> Difference:
    scored = apf.scored[:, : online.error.shape[1]]
    return gain(metrics.rmse_per_run(online.error, scored), rmse(apf))
