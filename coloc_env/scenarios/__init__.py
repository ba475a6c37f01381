"""Scenarios, one short file per family; none is imported before it is asked for."""

from coloc_env.scenarios.registry import (
    SCENARIOS,
    make_scenario,
    parse_overrides,
    parse_scenario,
    scenario_from,
)

__all__ = ["SCENARIOS", "make_scenario", "parse_overrides", "parse_scenario", "scenario_from"]
