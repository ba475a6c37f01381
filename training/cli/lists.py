"""``coloc scenarios`` and ``coloc agents``: what there is, and its options."""

from typing import Annotated

import typer

from training.cli.terminal import explain, show

_FAMILIES = {  # of agents, by their package
    "agents.kalman": "Kalman filters",
    "agents.particle": "particle filters",
    "agents.trust": "learned trust",
    "agents.factor_graph": "factor graphs",
    "agents.slam": "SLAM",
    "agents.stein": "Stein particles",
    "agents.swarm": "whole teams by their ranges: scaling, majorization, least squares",
    "agents.stdcl": "graph networks",
    "agents.policies": "trained policies",
}
_OWN = "your own and installed packages'"


def scenarios(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[SCENARIO]", help="Show this scenario's settings; none: list all."),
    ] = None,
) -> None:
    """List the scenarios, or one scenario's settings with their types and defaults.

    **Examples**

    coloc scenarios

    coloc scenarios indoor-v0
    """
    from coloc_env.scenarios import SCENARIOS

    if name is None:
        show(["scenario", ""], [[key, SCENARIOS.summary(key)] for key in SCENARIOS])
        typer.echo("coloc scenarios SCENARIO lists what can be --set in one.")
    else:
        explain(name, SCENARIOS, "override")


def agents(
    name: Annotated[
        str | None,
        typer.Argument(metavar="[AGENT]", help="Show this agent's options; none: list all."),
    ] = None,
) -> None:
    """List the agents, or one agent's options with their types and defaults.

    **Examples**

    coloc agents

    coloc agents ekf
    """
    from agents import LOCALIZERS

    if name is None:
        families: dict[str, list[str]] = {family: [] for family in (*_FAMILIES.values(), _OWN)}
        for key in LOCALIZERS:
            package = LOCALIZERS.module(key).rpartition(".")[0]
            families[_FAMILIES.get(package, _OWN)].append(key)
        width = max(map(len, LOCALIZERS))
        for family, names in families.items():
            if names:
                typer.secho(f"\n{family}", bold=True)
                lines = [[key.ljust(width), LOCALIZERS.summary(key)] for key in names]
                show(["", ""], lines)
        typer.echo("coloc agents AGENT lists its options, written AGENT:option=value:option=value.")
    else:
        explain(name, LOCALIZERS, "option")
