"""Figures 10 and 11, and why the paper's confidence is too weak."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from training.reproduce.drawing import panels
from training.reproduce.stdcl import plan
from training.reproduce.stdcl.figures import Bounds, curve, in_time
from training.reproduce.stdcl.flown import Teams
from training.reproduce.stdcl.looks import OF_SNAPSHOT, WITH_MOTION, legend, log, metres
from training.reproduce.stdcl.measures import Runs, told_by
from training.reproduce.stdcl.plan import POSTERIOR, SNAPSHOT

By = Mapping[float, Teams]  # a stressed quantity's values
ByBounds = Mapping[float, Bounds]


def nlos(biased: By, heavy: By, bounds: tuple[ByBounds, ByBounds]) -> Figure:
    """Figure 10: NRMSE by share of NLOS ranges: 25 m too long, and with 50 m of noise instead of
    10; INS without bias; 95 % intervals over runs. The paper's NRMSE of 0.08 is 400 m."""
    figure, (grid,) = panels(1, 2, (11.5, 4.8), "NLOS", sharey=True)
    titles = ("25 m too long", "mixture: 50 m of noise")
    for axes, found, known, title in zip(grid, (biased, heavy), bounds, titles, strict=True):
        _curves(axes, found, known, 100.0, scaled=True)
        axes.set(xlabel="NLOS ranges (%)", title=title)
    grid[0].set_ylabel("NRMSE")
    metres(grid[-1], _reach(heavy))
    legend(figure, grid)
    return figure


def connectivity(sparse: By, known: ByBounds, failing: Teams, bounds: Bounds) -> Figure:
    """Figure 11: (a) RMSE by mean number of neighbours, from 2.5 on; (b) NRMSE over time with every
    link failing in 25 % of the steps. INS without bias."""
    figure, ((by_degree, in_steps),) = panels(1, 2, (11.5, 4.8), "Connectivity")
    degrees = {r: degree(next(iter(there.values()))) for r, there in sparse.items() if there}
    _curves(
        by_degree,
        {degrees[r]: sparse[r] for r in degrees},
        {degrees[r]: known[r] for r in degrees},
        1.0,
        scaled=False,
    )
    by_degree.set(xlabel="mean degree", ylabel="RMSE (m)", xscale="log", title="a  sparse networks")
    if degrees:
        words = [f"{x:.3g}" for x in degrees.values()]
        by_degree.set_xticks(list(degrees.values()), words, fontsize=8)
        by_degree.minorticks_off()
    in_time(in_steps, failing, bounds)
    in_steps.set(title="b  25 % of the links failing", ylabel="NRMSE")
    metres(in_steps, _reach({0.0: failing}))
    legend(figure, [by_degree, in_steps])
    return figure


def confidence(found: By, bounds: ByBounds) -> Figure:
    """The optimizer with no confidence, the paper's, Huber's loss and calibrated weights: halving
    the weight of a link halves its pull, no more; a bias of one sign stays."""
    figure, ((axes,),) = panels(1, 1, (6.4, 4.4), "How much a doubtful link counts")
    agents = (*(f"{plan.OPTIMIZER}:confidence={c}" for c in plan.CONFIDENCES), plan.OPTIMIZER)
    shown = {x: {a: there[a] for a in agents if a in there} for x, there in found.items()}
    _curves(axes, shown, bounds, 100.0, scaled=False)
    axes.set(xlabel="NLOS ranges (%)", ylabel="RMSE (m)")
    axes.legend(fontsize=8)
    return figure


def degree(one: Runs) -> float:
    """Mean number of UAVs within reach, over the runs' first, middle and last step."""
    truth = one.results.worlds.truth
    places = truth[:, [0, truth.shape[1] // 2, -1]].reshape(-1, *truth.shape[2:])
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    return float((apart <= one.radius).sum(-1).mean() - 1)


def _curves(axes: Axes, found: By, bounds: ByBounds, scale: float, scaled: bool) -> None:
    """All agents' curves over a quantity, and the bounds'."""
    agents: Sequence[str] = list(dict.fromkeys(a for there in found.values() for a in there))
    for i, agent in enumerate(agents):
        own = {scale * x: there[agent] for x, there in found.items() if agent in there}
        curve(axes, agent, i, own, scaled)
    for which, style in ((POSTERIOR, WITH_MOTION), (SNAPSHOT, OF_SNAPSHOT)):
        known = {
            x: told_by(b)
            for x, each in bounds.items()
            if (b := each.get(which)) is not None and found.get(x)
        }
        reach = {x: next(iter(found[x].values())).radius if scaled else 1.0 for x in known}
        axes.plot([scale * x for x in known], [known[x] / reach[x] for x in known], **style)
    log(axes)


def _reach(found: By) -> float:
    return next((one.radius for there in found.values() for one in there.values()), float("nan"))
