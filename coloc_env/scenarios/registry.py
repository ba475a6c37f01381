"""Scenarios by id: what exists, which overrides each takes, clear words for the rest."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from coloc_env import options
from coloc_env.registry import Registry

if TYPE_CHECKING:
    from coloc_env.scenario import Scenario

SCENARIOS = Registry(
    "scenario",
    "coloc.scenarios",
    {
        "campus-v0": "coloc_env.scenarios.campus:campus",
        "indoor-v0": "coloc_env.scenarios.indoor:indoor",
        "replay-euroc-v0": "coloc_env.scenarios.replay_euroc:replay_euroc",
        "replay-hanyang-v0": "coloc_env.scenarios.replay_hanyang:replay_hanyang",
        "replay-miluv-v0": "coloc_env.scenarios.replay_miluv:replay_miluv",
        "replay-mrclam-v0": "coloc_env.scenarios.replay_mrclam:replay_mrclam",
        "replay-murp-v0": "coloc_env.scenarios.replay_murp:replay_murp",
        "replay-stein-euroc-team-v0": (
            "coloc_env.scenarios.replay_stein_euroc:replay_stein_euroc_team"
        ),
        "replay-stein-euroc-v0": "coloc_env.scenarios.replay_stein_euroc:replay_stein_euroc",
        "replay-tiers-v0": "coloc_env.scenarios.replay_tiers:replay_tiers",
        "replay-tuc-v0": "coloc_env.scenarios.replay_tuc:replay_tuc",
        "replay-v0": "coloc_env.scenarios.replay:replay_own",
        "stein2d-v0": "coloc_env.scenarios.stein:stein2d",
        "stein3d-v0": "coloc_env.scenarios.stein:stein3d",
        "swarm-v0": "coloc_env.scenarios.swarm:swarm",
        "wsn-v0": "coloc_env.scenarios.wsn:wsn",
    },
)


def make_scenario(name: str, **overrides: Any) -> Scenario:
    """Build a scenario by its id.

    Raises ValueError, in one line that names what is allowed, for an unknown scenario, an unknown
    override, or a value of the wrong type or range.
    """
    family = SCENARIOS.require(name)
    overrides = options.checked(name, overrides, SCENARIOS.options_of(name))
    try:
        made: Any = family(**options.grouped(family, overrides))
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(name) else f"{name}: {text}") from error
    if not hasattr(made, "overrides"):
        raise ValueError(f"{name}: a Scenario is needed, not {type(made).__name__}")
    found: Scenario = replace(made, overrides=overrides)
    return found


def scenario_from(scenario: str | Scenario, overrides: dict[str, Any]) -> Scenario:
    """The scenario of an id with overrides, or the one given; ValueError for both at once."""
    if isinstance(scenario, str):
        return make_scenario(scenario, **overrides)
    if overrides:
        raise ValueError("overrides go with a scenario's id, not with a built Scenario")
    return scenario


def parse_scenario(text: str, variant: str = "") -> Scenario:
    """A scenario with overrides as on a command line: ``indoor-v0:nlos=0.3:horizon=200``; those of
    a ``variant`` (``nlos=0.1:landmarks=5``) take the place of these."""
    name, *own = text.split(":")
    others = variant.split(":") if variant else ()
    return make_scenario(name, **parse_overrides(name, own) | parse_overrides(name, others))


def parse_overrides(name: str, texts: Iterable[str]) -> dict[str, Any]:
    """``key=value`` from a command line, each value read as the override's type. Raises ValueError
    for one that does not fit, or is given twice."""
    return options.parse_all(name, texts, SCENARIOS.options_of(name))
