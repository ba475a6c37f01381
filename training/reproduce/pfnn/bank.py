"""How much of what learned trust wins a bank keeps, as the mean log ratio over worlds."""

from collections.abc import Mapping, Sequence

import numpy as np

from training.evaluation.metrics import Floats
from training.evaluation.tables import short
from training.reproduce.measures import rmse
from training.reproduce.pfnn.plan import robust_agents, variants
from training.reproduce.results import Results
from training.reproduce.tables import DASH, Table

HUBER, ALONE = "ekf:robust=huber", "ekf_trust:bank=false"
_DRAWS, _LEVELS = 2000, (5, 95)
_NOTHING = 0.01  # mean log gain below which there is nothing to keep


def kept(huber: Floats, alone: Floats, bank: Floats) -> tuple[float, float, float, float]:
    """Σ log(huber / bank) / Σ log(huber / alone) over worlds, the ends of its 90 % bootstrap
    interval (worlds drawn with replacement), and the mean of log(huber / alone)."""
    gain, most = np.log(huber / bank), np.log(huber / alone)
    drawn = np.random.default_rng(0).integers(len(gain), size=(_DRAWS, len(gain)))
    low, high = np.percentile(gain[drawn].sum(1) / most[drawn].sum(1), _LEVELS)
    return float(gain.sum() / most.sum()), float(low), float(high), float(most.mean())


def gain_table(results: Results) -> Table | None:
    """Per-world RMSE, geometric mean over worlds, of Huber's weights, trust alone and its banks,
    and the share of the log gain that is kept; None unless all were run."""
    agents = robust_agents(results.settings)
    banks = [a for a in agents if a.startswith(("ekf_trust", "pf_trust")) and a != ALONE]
    if HUBER not in agents or ALONE not in agents or not banks:
        return None
    rows, worlds = [], []
    for variant in variants():
        there = results.runs(variant.key, agents)
        if HUBER in there and ALONE in there:
            every = {agent: rmse(runs) for agent, runs in there.items()}
            rows.append([variant.title, *_cells(every, banks)])
            if variant.scenario == "indoor-v0":
                worlds.append(every)
    if len(worlds) > 1:
        whole = [agent for agent in agents if all(agent in one for one in worlds)]
        pooled = {agent: np.concatenate([one[agent] for one in worlds]) for agent in whole}
        rows.append(["all that are simulated", *_cells(pooled, banks)])
    header = ["variant", "worlds", f"`{HUBER}`", f"`{ALONE}`", *(f"`{bank}`" for bank in banks)]
    return Table(
        "Typical RMSE in m, and the log gain over Huber that a bank keeps (90 %)", header, rows
    )


def _cells(every: Mapping[str, Floats], banks: Sequence[str]) -> list[str]:
    """How many worlds, what Huber's weights and trust alone reach in them, and what banks do."""
    huber, alone = every[HUBER], every[ALONE]
    cells = [str(len(huber)), *(_typical(one) for one in (huber, alone))]
    for bank in banks:
        if bank not in every:
            cells.append(DASH)
            continue
        share, low, high, most = kept(huber, alone, every[bank])
        interval = f" ({share:.2f}; {low:.2f} to {high:.2f})" if abs(most) > _NOTHING else ""
        cells.append(_typical(every[bank]) + interval)
    return cells


def _typical(rmses: Floats) -> str:
    """Geometric mean over worlds."""
    return short(float(np.exp(np.log(rmses).mean())))
