"""``coloc scenarios`` and ``coloc agents``: what there is, and its options."""

from typing import Annotated

import typer

from training.cli.terminal import explain, show


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
        show(["agent", ""], [[key, LOCALIZERS.summary(key)] for key in LOCALIZERS])
        typer.echo("coloc agents AGENT lists its options, written AGENT:option=value:option=value.")
    else:
        explain(name, LOCALIZERS, "option")
