"""The ``coloc`` command. Heavy imports wait until a command needs them, so that help is instant."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from training.cli.reproduce import reproduce
from training.cli.terminal import explain, progress, show
from training.cli.train import train
from training.threads import use_threads

if TYPE_CHECKING:
    from coloc_env.scenario import Scenario

_FRAMES = 300  # at most, in an animation
_TOO_WIDE = ("rmse_std", "mean", "avg_particles")  # columns left out on a terminal


class _Plain(TyperGroup):
    """Commands whose known errors are one line on stderr: exit code 2, or 130 when interrupted."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(130) from None
        except (ValueError, OSError) as error:
            text = " ".join(str(error).split()) or type(error).__name__
            typer.echo(f"error: {text}", err=True)
            raise typer.Exit(2) from None


app = typer.Typer(
    cls=_Plain,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="""Cooperative localization of UAV swarms: simulate, localize, and measure how well.

    **A first look**

    coloc scenarios

    coloc agents

    coloc evaluate indoor-v0 --agents ekf,pf500 --runs 5 --out results/first
    """,
)

ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="See **coloc scenarios**.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override one setting of the scenario; repeat it for more. "
        "**coloc scenarios SCENARIO** lists them.",
    ),
]
Data = Annotated[
    Path | None,
    typer.Option("--data", metavar="DIR", help="Folder of recordings (sets COLOC_DATA)."),
]
Seed = Annotated[int, typer.Option(help="Seed of the first world.")]
Threads = Annotated[int, typer.Option(help="CPU threads of torch.")]


@app.command()
def evaluate(
    scenario: ScenarioName,
    agents: Annotated[
        str,
        typer.Option(
            metavar="A,B,C",
            help="Agents, with commas between; options follow a name after colons: "
            "**ekf,ekf:robust=huber**.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")],
    runs: Annotated[int, typer.Option(help="Worlds, seeded SEED, SEED + 1, …")] = 20,
    seed: Seed = 0,
    settings: Settings = None,
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw figures.")] = True,
    bound: Annotated[
        bool, typer.Option("--bound/--no-bound", help="Compute the posterior bound.")
    ] = True,
    threads: Threads = 1,
    data: Data = None,
) -> None:
    """Let agents meet the same worlds, and write how well each localizes.

    DIR receives results.json, results.csv, table.md, figures, and the first run's trajectories as
    TUM files; results that are there already are replaced once everything is done.

    **Examples**

    coloc evaluate indoor-v0 --agents ekf,pf500 --runs 20 --out results/indoor

    coloc evaluate indoor-v0 --agents ekf,ekf:robust=huber --set nlos=0.3 --set landmarks=5
    --out results/hard

    coloc evaluate replay-mrclam-v0 --agents dead_reckoning,ekf --data ~/recordings --out results/uw
    """
    from coloc_env.staging import staged_folder

    built = _scenario(scenario, settings, threads, data)
    from training.evaluation import results as files
    from training.evaluation.evaluate import evaluate as run
    from training.evaluation.evaluate import split_agents

    names = split_agents(agents)

    with staged_folder(out, files.NAMES) as folder, progress() as tell:
        found = run(built, names, runs, seed, tell, bound=bound)
        tell("files", 0, 1)
        files.write(found, folder, figures)
        tell("files", 1, 1)
    columns = {key: title for key, title in files.COLUMNS.items() if key not in _TOO_WIDE}
    show(["", *columns.values()], files.rows(found, columns))
    for name, one in found.agents.items():
        if one.messages:
            count = f"{len(one.messages)} of {found.runs} runs"
            what = f"{name} raised in {count}; first at {one.messages[0]}"
            typer.echo(f"warning: {what}", err=True)
    typer.echo(f"written to {out}")


@app.command()
def scenarios(
    name: Annotated[str | None, typer.Argument(help="Show this scenario's settings.")] = None,
) -> None:
    """List the scenarios, or one scenario's settings with their types and defaults."""
    from coloc_env.scenarios import SCENARIOS

    if name is None:
        show(["scenario", ""], [[key, SCENARIOS.summary(key)] for key in SCENARIOS])
        typer.echo("coloc scenarios SCENARIO lists what can be --set in one.")
    else:
        explain(name, SCENARIOS, "override")


@app.command()
def agents(
    name: Annotated[str | None, typer.Argument(help="Show this agent's options.")] = None,
) -> None:
    """List the agents, or one agent's options with their types and defaults."""
    from agents import LOCALIZERS

    if name is None:
        show(["agent", ""], [[key, LOCALIZERS.summary(key)] for key in LOCALIZERS])
        typer.echo("coloc agents AGENT lists its options, written AGENT:option=value:option=value.")
    else:
        explain(name, LOCALIZERS, "option")


@app.command()
def render(
    scenario: ScenarioName,
    out: Annotated[Path, typer.Option(metavar="FILE", help="An animation .gif or a picture .png.")],
    agent: Annotated[str, typer.Option(help="Who localizes.")] = "ekf",
    steps: Annotated[int, typer.Option(help="Steps to show; a picture shows the last.")] = 100,
    seed: Seed = 0,
    settings: Settings = None,
    threads: Threads = 1,
    data: Data = None,
) -> None:
    """Draw a world and what an agent makes of it.

    **Examples**

    coloc render indoor-v0 --agent ekf --steps 200 --out flight.gif

    coloc render indoor-v0 --agent pf500 --set motion=random --seed 3 --out world.png
    """
    from coloc_env.staging import staged_file

    built = _scenario(scenario, settings, threads, data)
    from coloc_env.render import frame_to_png, save_animation
    from training.evaluation.animation import frames
    from training.evaluation.evaluate import make

    suffix = out.suffix.lower()
    if suffix not in (".gif", ".png"):
        raise ValueError(f"--out {out} is not allowed: a name ending in .gif or .png")
    if not 1 <= steps <= built.horizon:
        raise ValueError(f"--steps {steps} is not allowed: 1 to {built.horizon} for {scenario}")
    every = steps if suffix == ".png" else -(-steps // _FRAMES)
    with staged_file(out) as file, progress() as tell:
        localizer = make(agent, built)
        drawn = list(frames(localizer, built, seed, steps, every, lambda k: tell(agent, k, steps)))
        if suffix == ".png":
            frame_to_png(drawn[-1], file)
        else:
            save_animation(drawn, file, min(30.0, max(10.0, 1 / (every * built.arena.dt))))
    typer.echo(f"written to {out}")


@app.command()
def bench(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the figures.")],
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter measurements.")] = False,
) -> None:
    """Measure speed: worlds, both faces, agents, beside other environments where installed."""
    from training.bench.bench import bench as measure

    measure(out, quick)


app.command()(train)
app.command()(reproduce)


# ------------------------------------------------------------------ parts


def _scenario(name: str, settings: list[str] | None, threads: int, data: Path | None) -> "Scenario":
    """Prepare the process, and build a scenario from a command line."""
    use_threads(threads)
    if data is not None:
        os.environ["COLOC_DATA"] = str(data)
    from dataclasses import replace

    from coloc_env.scenarios import make_scenario, parse_override

    overrides = dict(parse_override(name, text) for text in settings or ())
    return replace(make_scenario(name, **overrides), overrides=overrides)


def main() -> None:
    """Run the command."""
    app()


if __name__ == "__main__":
    main()
