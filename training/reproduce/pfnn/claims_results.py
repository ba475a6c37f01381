"""What the paper claims of how well PF-NN localizes, beside others and with other corrections."""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.reproduce.pfnn import paper
from training.reproduce.pfnn.flown import Case, Flown
from training.reproduce.pfnn.plan import ablation_agents
from training.reproduce.verdicts import Claim, gain, interval, least

PerRun = Callable[[Flown, str], Floats]  # an agent's figure of each run


def results() -> Iterator[Case]:
    """All of them."""
    yield from _accuracy()
    yield from _comparisons()
    yield from _figure_9()
    yield from _ablation()


def _accuracy() -> Iterator[Case]:
    row, us = paper.TABLE_4["pfnn"], ("pfnn",)
    yield Case(
        Claim("PF-NN's RMSE", f"{row.rmse.mean} m", "m", None, row.rmse.mean),
        us,
        lambda f: interval(f.rmse("pfnn")),
    )
    yield Case(
        Claim("sub-metre accuracy", "RMSE < 1 m", "m", "below", paper.SUB_METRE),
        us,
        lambda f: interval(f.rmse("pfnn")),
    )
    yield Case(
        Claim("PF-NN's largest error", f"{row.max.mean} m", "m", None, row.max.mean),
        us,
        lambda f: interval(f.largest("pfnn")),
    )


def _comparisons() -> Iterator[Case]:
    names = paper.METHODS
    for other, size in paper.GAINS.items():
        words = f"PF-NN's RMSE is below that of {names[other]}"
        yield Case(
            Claim(words, f"by {size} %", "%", "above", 0.0, size),
            ("pfnn", other),
            _gain(Flown.rmse, "pfnn", other),
        )
    size = paper.MAX_GAIN_PF500
    words = f"PF-NN's largest error is below that of {names['pf500']}"
    yield Case(
        Claim(words, f"by {size} %", "%", "above", 0.0, size),
        ("pfnn", "pf500"),
        _gain(Flown.largest, "pfnn", "pf500"),
    )
    for pair in (("pfnn", "pf800"), ("apf", "pf800"), ("pf800", "pf500"), ("pf500", "ekf")):
        a, b = (paper.TABLE_4[agent].rmse.mean for agent in pair)
        words = f"{names[pair[0]]}'s RMSE is below that of {names[pair[1]]}"
        yield Case(
            Claim(words, f"{a} against {b} m", "%", "above", 0.0, 100 * (1 - a / b)),
            pair,
            _gain(Flown.rmse, *pair),
        )
    rivals = ("pf500", "pf800", "apf", "ekf")
    yield Case(
        Claim("PF-NN is the best of the methods measured here", "lowest RMSE", "%", "above"),
        ("pfnn", *rivals),
        _least(Flown.rmse, rivals),
    )


def _figure_9() -> Iterator[Case]:
    rivals = ("pf500", "pf800", "apf")

    def best(f: Flown) -> Difference:
        """Per cent of runs in which PF-NN is the best."""
        per_run = {
            a: metrics.rmse_per_run(f.cdf.agents[a].error, f.cdf.worlds.scored)
            for a in f.cdf.agents
        }
        best = np.min([per_run[rival] for rival in rivals], axis=0)
        return interval(100.0 * (per_run["pfnn"] < best))

    words = "PF-NN has the lowest RMSE of all particle filters in most of figure 9's runs"
    yield Case(
        Claim(words, "consistently", "%", "above", 50.0),
        ("pfnn", *rivals),
        best,
    )


def _ablation() -> Iterator[Case]:
    others = [agent for agent in ablation_agents() if agent != "pfnn"]
    for what, of in (("RMSE", Flown.rmse), ("largest error", Flown.largest)):
        yield Case(
            Claim(f"[0.4, 1.0] gives the lowest {what} of all ranges", "lowest", "%", "above"),
            ("pfnn", *others),
            _least(of, others),
        )


def _gain(of: PerRun, ours: str, other: str) -> Callable[[Flown], Difference]:
    return lambda f: gain(of(f, ours), of(f, other))


def _least(of: PerRun, others: Iterable[str]) -> Callable[[Flown], Difference]:
    return lambda f: least([(of(f, "pfnn"), of(f, other)) for other in others])
