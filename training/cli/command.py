"""The ``coloc`` command. Heavy imports wait until a command needs them, so that help is instant."""

import contextlib
import io
import sys
import warnings
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from training.cli.bench import bench
from training.cli.dataset import dataset
from training.cli.evaluate import evaluate
from training.cli.lists import agents, scenarios
from training.cli.live import live
from training.cli.recording import recording
from training.cli.recordings import recordings
from training.cli.render import render
from training.cli.report import report
from training.cli.reproduce import reproduce
from training.cli.score import score, tasks
from training.cli.train import train
from training.cli.view import view


class _Plain(TyperGroup):
    """Commands whose known errors are one line on stderr: exit code 2, or 130 when interrupted."""

    def invoke(self, ctx: Any) -> Any:
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show_warning
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


def _show_warning(message: Warning | str, *rest: Any, **more: Any) -> None:
    typer.echo(f"warning: {' '.join(str(message).split())}", err=True)


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
for _command in (
    evaluate,
    report,
    score,
    scenarios,
    agents,
    tasks,
    recordings,
    render,
    view,
    live,
    dataset,
    bench,
    train,
    reproduce,
):
    app.command()(_command)
app.add_typer(recording, name="recording")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"coloc {version('coloc-env')}")
        raise typer.Exit


@app.callback()
def _main(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # what a terminal cannot show is no error
            stream.reconfigure(errors="replace")
    try:
        app()
    finally:
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.flush()


if __name__ == "__main__":
    main()
