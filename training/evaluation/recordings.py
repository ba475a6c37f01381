"""Every recording in the data folder, measured by the same agents: the one table of real data."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from agents.errors import NotServed
from agents.registry import make
from coloc_env.datasets import DATASETS, DataError, dataset_folder, sequences
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from training.evaluation import metrics
from training.evaluation.evaluate import Progress, silent
from training.evaluation.record import record
from training.evaluation.results import Evaluation, plain
from training.evaluation.tables import short

AGENTS = (
    *("ekf", "ekf:robust=huber", "ekf_trust:bank=false", "ekf_trust"),
    *("ekf:robust=huber:fusion=pairwise", "ekf:robust=huber:fusion=exchange"),
    "ekf_joint:robust=huber",
    *("map", "stdcl:variant=calibrated:bank=true", "hpff:main=ekf", "nnhpff:main=ekf"),
)
CLASSICAL = AGENTS[:2]
_DASH = "–"


@dataclass(frozen=True)
class Recorded:
    """A sequence in the data folder, and the scenario that replays it."""

    dataset: str
    sequence: str

    @property
    def scenario_name(self) -> str:
        return f"replay-{self.dataset}-v0"

    def scenario(self, **overrides: Any) -> Scenario:
        """The scenario; of a team without IMU, by the motion model that needs none."""
        chosen = {"sequence": self.sequence, **overrides}
        try:
            return make_scenario(self.scenario_name, **chosen)
        except ValueError as error:
            if "process=constant_velocity" not in str(error):
                raise
            return make_scenario(self.scenario_name, process="constant_velocity", **chosen)


def recorded(data: str | None = None) -> Iterator[Recorded]:
    """All sequences of all datasets in the data folder.

    Raises:
        DataError: there is no such folder.
    """
    missing: list[DataError] = []
    for dataset in DATASETS:
        try:
            dataset_folder(dataset, data)
        except DataError as error:
            missing.append(error)
            continue
        yield from (Recorded(dataset, each) for each in sequences(dataset, data))
    if len(missing) == len(DATASETS):
        raise missing[0]


def measure(
    scenario: Scenario, agents: Sequence[str], runs: int, seed: int, progress: Progress = silent
) -> dict[str, dict[str, Any]]:
    """By agent: RMSE (m), NEES scaled to 3 dimensions, UAVs lost, the share of time that a bank's
    learned branch spoke (None without a bank), and bytes that a UAV sent in a step (None where it
    sends none); ``refused``, and why, where an agent does not serve the recording."""
    found: dict[str, dict[str, Any]] = {}
    seeds = torch.arange(seed, seed + runs)
    for i, agent in enumerate(agents):
        progress(scenario.name, i, len(agents))
        if scenario.arena.n_uavs == 1 and ("fusion=" in agent or "joint" in agent):
            found[agent] = {"refused": "a team of one has nothing to fuse"}
            continue
        try:
            localizer = make(agent, scenario)
        except NotServed as error:
            found[agent] = {"refused": str(error)}
            continue
        one = record(localizer, scenario, seeds)
        scored = one.worlds.scored
        beyond = Evaluation(scenario, one.worlds, None, {agent: one}, {}).lost_beyond
        share = one.series.get("trust_share")
        sent = one.series.get("bytes") if scenario.arena.n_uavs > 1 else None
        found[agent] = {
            "rmse": metrics.rmse(one.error, scored),
            "nees": 3 / scenario.arena.dim * metrics.mean(one.nees[scored]),
            "lost": int(metrics.lost(one.error, scored, scenario.arena.dt, beyond).sum()),
            "uavs": int(scored.any(1).sum()),
            "trust_share": None if share is None else float(np.nanmean(share[scored])),
            "bytes": None if sent is None else float(np.nanmean(sent)),
        }
        found[agent] = plain(found[agent])
    progress(scenario.name, len(agents), len(agents))
    return found


def table(
    figures: Mapping[str, Mapping[str, Mapping[str, Any]]],
    tuned: Mapping[str, bool],
    agents: Sequence[str],
    runs: int,
    seed: int,
    command: str,
    provenance: str,
) -> dict[str, Any]:
    """A measured table (``docs/results/measured``): a line a recording."""
    rows = []
    for name, by_agent in figures.items():
        cells = [_cell(by_agent[agent], _best(by_agent)) for agent in agents]
        rows.append([f"{name}{' ᵗ' if tuned[name] else ''}", *cells])
    return {
        "title": "Every recording",
        "caption": "RMSE in m (NEES, scaled so that 3 is honest); † UAVs lost of all runs'; % of "
        "the time that trust speaks; B: bytes that a UAV sends in a step; **bold**: at most 1.05 × "
        "the better of `ekf` and Huber; ᵗ "
        f"constants were chosen on it. {runs} runs, seeds {seed} to {seed + runs - 1}.",
        "command": command,
        "provenance": provenance,
        "header": ["", *(f"`{agent}`" for agent in agents)],
        "align": ["left", *["right"] * len(agents)],
        "rows": rows,
    }


def chosen_elsewhere(
    figures: Mapping[str, Mapping[str, Mapping[str, Any]]], agents: Sequence[str]
) -> dict[str, tuple[str, float]]:
    """By dataset: the agent with the least mean log ratio to the best classical filter on the
    recordings of all *other* datasets, and its mean ratio on those of this one. How far constants
    carry that were chosen without it."""
    ratios: dict[str, dict[str, list[float]]] = {}
    for name, by_agent in figures.items():
        best = _best(by_agent)
        for agent in agents:
            if agent not in CLASSICAL and "rmse" in by_agent[agent] and best < float("inf"):
                ratio = float(np.log(by_agent[agent]["rmse"] / best))
                ratios.setdefault(name.split("/")[0], {}).setdefault(agent, []).append(ratio)
    means = {
        dataset: {agent: float(np.mean(every)) for agent, every in here.items()}
        for dataset, here in ratios.items()
    }
    return {
        dataset: (agent, float(np.exp(means[dataset][agent])))
        for dataset, agent in best_elsewhere(means).items()
    }


def best_elsewhere(scores: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """By dataset: whose mean score over all *other* datasets is least, of those that have one here.

    Raises:
        ValueError: there is but one dataset.
    """
    found = {}
    for dataset, here in scores.items():
        others = [one for other, one in scores.items() if other != dataset]
        if not others:
            raise ValueError(f"only {dataset} was measured: another dataset is needed to choose on")
        elsewhere = {
            name: float(np.mean([one[name] for one in others if name in one])) for name in here
        }
        found[dataset] = min(elsewhere, key=lambda name: elsewhere[name])
    return found


def _best(by_agent: Mapping[str, Mapping[str, Any]]) -> float:
    """RMSE of the better classical filter; infinite where none serves."""
    known = [one["rmse"] for name, one in by_agent.items() if name in CLASSICAL and "rmse" in one]
    return min(known, default=float("inf"))


def _cell(one: Mapping[str, Any], best: float) -> str:
    if "rmse" not in one:
        return _DASH
    text = short(one["rmse"])
    if one["rmse"] <= 1.05 * best < float("inf"):
        text = f"**{text}**"
    text += f" ({short(one['nees'])})"
    if one["lost"]:
        text += f" †{one['lost']}/{one['uavs']}"
    if one["trust_share"] is not None:
        text += f" {100 * one['trust_share']:.0f} %"
    if one["bytes"] is not None:
        text += f" {one['bytes']:.0f} B"
    return text
