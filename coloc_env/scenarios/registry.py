"""Scenarios by id: what exists, which overrides each takes, clear words for the rest."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from coloc_env import options
from coloc_env.scenario import Scenario

Family = Callable[..., Scenario]
FAMILIES: dict[str, Family] = {}


def register(name: str) -> Callable[[Family], Family]:
    """Register a scenario family: a function of keyword-only overrides that returns a Scenario."""

    def add(family: Family) -> Family:
        FAMILIES[name] = family
        return family

    return add


def overrides_of(name: str) -> dict[str, inspect.Parameter]:
    """Override names of a scenario with their types and defaults."""
    options.require_known("scenario", [name], sorted(FAMILIES))
    return options.parameters(FAMILIES[name])


def make_scenario(name: str, **overrides: Any) -> Scenario:
    """Build a registered scenario.

    Raises ValueError, in one line that names what is allowed, for an unknown scenario, an unknown
    override, or a value of the wrong type or range.
    """
    options.check(name, overrides, overrides_of(name))
    try:
        return replace(FAMILIES[name](**overrides), overrides=overrides)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(name) else f"{name}: {text}") from error


def scenario_from(scenario: str | Scenario, overrides: dict[str, Any]) -> Scenario:
    """The scenario of an id with overrides, or the one given; ValueError for both at once."""
    if isinstance(scenario, str):
        return make_scenario(scenario, **overrides)
    if overrides:
        raise ValueError("overrides go with a scenario's id, not with a built Scenario")
    return scenario


def parse_override(name: str, text: str) -> tuple[str, Any]:
    """``key=value`` from a command line, the value read as the override's type."""
    return options.parse(name, text, overrides_of(name))
