"""Tables 3 to 5, and figure 2 in numbers: the paper's figures beside ours."""

from collections.abc import Iterator

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Flags, Floats
from training.evaluation.tables import short
from training.reproduce.cost import COST, MEMORY, Cost
from training.reproduce.measures import largest, mean_error, rmse
from training.reproduce.pfnn import paper
from training.reproduce.pfnn.plan import (
    ABLATION,
    DEFAULT,
    ONLINE,
    ORACLE,
    PRINTED,
    PRINTED_ABLATION,
    SWEEP,
    particles,
    redrawn,
)
from training.reproduce.results import Results
from training.reproduce.settings import Settings
from training.reproduce.tables import DASH, Table, interleaved, signed, spread
from training.reproduce.work import WORLD


def text(settings: Settings) -> list[str]:
    """What is to be known of the tables."""
    last, more = (settings.seed + n - 1 for n in (settings.runs, settings.runs * 3 // 2))
    return [
        f"`indoor-v0`, {settings.runs} runs, seeds {settings.seed} to {last} (figure 9: to "
        f"{max(last, more)}); the paper has {paper.RUNS} runs. Ours: mean ± standard deviation "
        "over runs. The largest error is the mean of the UAVs' largest.",
        "`dfgo` is a fixed-lag smoother of each UAV over 2 s, tied by what neighbours' own sensors "
        "say. `dlspf` has latent states of a UAV's last eight positions and velocities; its paper "
        "of origin has those of fields.",
        "*As printed* (`variant=paper`): particles uniform in the room, weights that take a "
        "neighbour's estimate as exact, Algorithm 2, no tempering, no redraw. The other rows are "
        "regularized filters: Liu–West moves, a likelihood tempered at the start, and clouds "
        "redrawn from the posterior of an extended Kalman filter where few particles are "
        "effective; in what share of UAV-steps stands under *redrawn*. Claims about the paper's "
        "particle filters are judged by the rows as printed.",
        "*Oracle*: the corrector's output is its own target, computed from the truth: no training "
        "can do better.",
        "Where the corrector has no detectable effect here, it is because clouds in these worlds "
        "are centimetres wide: a factor within [0.4, 1] hardly differs over such a cloud. Where "
        "clouds are wide, these runs say nothing.",
    ]


def tables(results: Results) -> Iterator[Table]:
    """All of them."""
    yield _table_3(results)
    yield _table_4(results)
    yield _perturbation(results)
    yield _table_5(results)
    yield _figure_2(results)


def _table_3(results: Results) -> Table:
    """Errors of each UAV (m), mean over runs."""
    header = ["UAV", *interleaved((f"{x}, paper", f"{x}, ours") for x in ("RMSE", "mean", "max"))]
    rows, one = [], results.get(DEFAULT, "pfnn")
    for i, (name, row) in enumerate(paper.TABLE_3.items()):
        ours = [DASH] * 3
        if one is not None:
            part = slice(None) if name == "Average" else slice(i, i + 1)
            error, counts = one.error[:, :, part], one.scored[:, :, part]
            tracks = metrics.rmse_per_track(error, counts)
            most = np.where(counts, error, 0.0).max(1)
            means = metrics.mean_per_run(error, counts)
            ours = [spread(tracks.mean(1)), spread(means), spread(most.mean(1))]
        theirs = (f"{x:.3f}" for x in row)
        rows.append([name, *interleaved(zip(theirs, ours, strict=True))])
    return Table("Table 3. Errors of each UAV (m)", header, rows)


def _table_4(results: Results) -> Table:
    """Errors (m) and particles of each method, mean ± standard deviation over runs."""
    columns = ("RMSE", "mean", "max", "particles")
    header = ["method", "agent", *interleaved((f"{x}, paper", f"{x}, ours") for x in columns)]
    header += ["ours: diverged runs", "NEES", "× bound", "redrawn (%)"]
    rows, world = [], results.get(DEFAULT, WORLD)
    for agent, row in paper.TABLE_4.items():
        theirs = [_printed(cell) if cell else "N/A" for cell in row]
        for name in filter(None, (agent, PRINTED.get(agent))):
            pairs = interleaved(zip(theirs, _ours(results, name), strict=True))
            method = paper.METHODS[agent] + (", as printed" if name != agent else "")
            rows.append([method, f"`{name}`", *pairs, *_more(results, name)])
    both = ("pfnn", PRINTED["pfnn"])
    learned = [(agent, ONLINE, "learning in flight") for agent in both]
    learned += [(agent, ORACLE, "oracle") for agent in both]
    for agent, kind, what in learned:
        found = results.get(DEFAULT, agent, kind)
        if found is not None and world is not None:
            ours = _figures(found.error, found.count, world.scored[:, : found.error.shape[1]])
            pairs = interleaved((DASH, cell) for cell in ours)
            rows.append([paper.METHODS["pfnn"], f"{agent}, {what}", *pairs, *[DASH] * 4])
    if world is not None and (bound := world.evaluation.bound) is not None:
        least = metrics.rmse_per_run(np.sqrt(bound.mse.numpy()), bound.scored.numpy())
        rows.append(["*posterior bound*", DASH, DASH, spread(least), *[DASH] * 8, "1", DASH])
    return Table("Table 4. Methods (errors in m)", header, rows, 2)


def _ours(results: Results, agent: str) -> list[str]:
    """RMSE, mean and largest error (m), particles."""
    one = results.get(DEFAULT, agent)
    if one is None:
        return [DASH] * 4
    return [spread(measure(one)) for measure in (rmse, mean_error, largest, particles)]


def _more(results: Results, agent: str) -> list[str]:
    """Diverged runs, NEES, RMSE over the bound's, and redrawn clouds (%)."""
    one = results.get(DEFAULT, agent)
    if one is None:
        return [DASH] * 4
    keys = ("diverged_runs", "nees", "ratio_to_bound")
    return [*(short(one.summary[key]) for key in keys), short(redrawn(one))]


def _figures(error: Floats, count: Floats, scored: Flags) -> list[str]:
    """What ``_ours`` gives, of errors and counts [R, K, N]."""
    return [
        spread(metrics.rmse_per_run(error, scored)),
        spread(metrics.mean_per_run(error, scored)),
        spread(np.where(scored, error, 0.0).max(1).mean(1)),
        spread(metrics.mean_per_run(count, scored)),
    ]


def _perturbation(results: Results) -> Table:
    """PF-NN as printed over the perturbation, of which the paper gives no size."""
    header = ["Σ_perturb, position (m)", "agent", "RMSE", "mean", "max", "particles"]
    header += ["diverged runs", "NEES", "× bound"]
    rows = [
        [f"{std:g}", f"`{agent}`", *_ours(results, agent), *_more(results, agent)[:3]]
        for agent, std in SWEEP.items()
    ]
    caption = f"The paper's: RMSE {paper.TABLE_4['pfnn'].rmse.mean} m."
    return Table("PF-NN as printed, over Σ_perturb (errors in m)", header, rows, 2, caption)


def _table_5(results: Results) -> Table:
    """Time of a team's step (ms, mean ± standard deviation over steps), of all (s), and memory."""
    header = ["method", "agent", "ms/step, paper", "ours", "total s, paper", "ours"]
    header += ["MB, paper", "ours: belief", "working set"]
    rows = []
    for agent, row in paper.TABLE_5.items():
        theirs = (_printed(row.ms), f"{row.total:g}", f"{row.memory:g}")
        for name in filter(None, (agent, PRINTED.get(agent))):
            ours, cost = [DASH] * 4, results.get(DEFAULT, name, COST)
            if isinstance(cost, Cost):
                total = f"{cost.ms.sum() / 1e3:.2f}"
                memory = [f"{cost.belief / 1e6:.3f}", f"{cost.working / 1e6:.2f}"]
                ours = [spread(cost.ms), total, *memory]
            method = paper.METHODS[agent] + (", as printed" if name != agent else "")
            rows.append([method, f"`{name}`", *interleaved(zip(theirs[:2], ours[:2], strict=True))])
            rows[-1] += [theirs[2], *ours[2:]]
    caption = (
        "Times: one world, one thread, all methods step by step in turn; mean ± standard "
        f"deviation over steps. The paper's are MATLAB's on an Apple M1. {MEMORY}"
    )
    return Table("Table 5. Cost of a team's step", header, rows, 2, caption)


def _figure_2(results: Results) -> Table:
    """The ablation in numbers: RMSE and largest error (m), particles; paired with [0.4, 1.0]."""
    header = ["range", "agent", "RMSE", "minus that of [0.4, 1.0]", "largest error", "particles"]
    rows = []
    for agent, span in (ABLATION | PRINTED_ABLATION).items():
        cells, one = [DASH] * 4, results.get(DEFAULT, agent)
        proposed = PRINTED["pfnn"] if agent in PRINTED_ABLATION else "pfnn"
        own = results.get(DEFAULT, proposed)
        if one is not None:
            apart = DASH
            if agent != proposed and own is not None:
                apart = signed(metrics.paired_difference(rmse(one), rmse(own)), "mm", scale=1e3)
            cells = [spread(rmse(one)), apart, spread(largest(one)), spread(particles(one))]
        rows.append([f"[{span[0]}, {span[1]}]", f"`{agent}`", *cells])
    return Table("Figure 2 in numbers (m)", header, rows, 2)


def _printed(value: paper.Spread) -> str:
    return f"{value.mean:g}" + ("" if value.std is None else f" ± {value.std:g}")
