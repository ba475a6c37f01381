"""What was learned beside what it starts from, in held-out worlds."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch

from agents.localizer import Localizer
from coloc_env.scenario import Scenario
from training.evaluation import metrics
from training.evaluation.record import record
from training.learning.run import Progress


def compared(
    variants: Iterable[str],
    build: Callable[[str], Scenario],
    agents: Callable[[Scenario], Mapping[str, Localizer[Any]]],
    runs: int,
    progress: Progress,
    **about: Any,
) -> Mapping[str, Any]:
    """RMSE (m) of each agent in the worlds of seeds 0 … ``runs`` − 1 of the scenario that each
    variant builds, and what else is to be said ``about`` the worlds; nothing for no runs."""
    if runs == 0:
        return {}
    variants, found = list(variants), dict[str, Any]()
    for variant in variants:
        scenario, each = build(variant), {}
        for name, one in agents(scenario).items():
            result = record(one, scenario, torch.arange(runs))
            each[f"{name}_rmse"] = metrics.rmse(result.error, result.worlds.scored)
        found[variant or "default"] = each
        progress("scoring", len(found), len(variants))
    return {"runs": runs, "seeds": [0, runs - 1], **about, "rmse": found}
