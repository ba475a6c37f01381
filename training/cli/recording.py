"""``coloc recordings`` and ``coloc recording``: recordings that are known, and those of one's own."""

from pathlib import Path
from typing import Annotated

import typer

from training.cli.options import Data
from training.cli.terminal import show

recording = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="""Bring a recording of your own: look it over, import it, calibrate its noise.

    **From a bag to a result**

    coloc recording import flight.mcap --list > topics.yaml

    coloc recording import flight.mcap --map topics.yaml --out flight

    coloc recording check flight

    coloc recording calibrate flight --span 0:60

    coloc evaluate replay-v0 --set path=flight --set believed=flight/believed.yaml --agents ekf
    --out results/flight
    """,
)
Folder = Annotated[
    Path, typer.Argument(metavar="DIR", help="A folder in the open recording format.")
]


def recordings(data: Data = None) -> None:
    """List the recordings that are known, and which of their sequences are here.

    **Examples**

    coloc recordings

    coloc recordings --data ~/recordings
    """
    from coloc_env.datasets import DATASETS, sequences
    from coloc_env.datasets.folders import HOMES

    lines = []
    for name in DATASETS:
        try:
            found = sequences(name, data)
        except ValueError:
            found = ()
        lines.append([f"replay-{name}-v0", ", ".join(found) or f"not here: {HOMES[name]}"])
    show(["scenario", "sequences"], lines)
    typer.echo("--set sequence=NAME chooses one; your own: coloc recording --help")


@recording.command()
def check(
    folder: Folder,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw everything here, as PNG.")
    ] = None,
) -> None:
    """Say what is in a recording, and what of it will do harm, worst first.

    **Examples**

    coloc recording check flight

    coloc recording check flight --picture flight.png
    """
    from coloc_env.datasets.check import check as look
    from coloc_env.datasets.open_format import read_recording

    found = read_recording(folder)
    report = look(found)
    kinds = [f"{len(found.anchors)} anchors", f"{len(found.landmarks)} landmarks"]
    team = f"{len(found.robots)} robots in {found.dim} dimensions"
    typer.echo(f"{found.name}: {team}, {', '.join(kinds)}")
    show(
        ["robot", "stream", "samples", "rate, Hz", "longest gap, s", "gaps", "same stamp"],
        [
            [row.robot, row.stream, str(row.samples), f"{row.rate:.4g}", f"{row.longest:.3g}"]
            + [str(row.gaps), str(row.repeated)]
            for row in report.streams
        ],
    )
    if report.links:
        typer.echo("ranges less the truth")
        show(
            ["link", "samples", "bias, m", "σ, m", "beyond 3 σ", "late by, s"],
            [
                [row.link, str(row.samples), f"{row.bias:+.3f}", f"{row.std:.3f}"]
                + [f"{100 * row.outliers:.1f} %", f"{row.delay:+.2f}"]
                for row in report.links
            ],
        )
    for text in report.warnings:
        typer.echo(f"warning: {text}", err=True)
    if picture is not None:
        from coloc_env.staging import staged_file
        from training.evaluation.recording_figure import draw_recording

        with staged_file(picture.with_suffix(".png")) as path:
            draw_recording(found, path)


@recording.command()
def export(
    scenario: Annotated[
        str, typer.Argument(metavar="SCENARIO", help="**replay-miluv-v0** or another recording.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    sequence: Annotated[
        str | None, typer.Option(help="Which sequence; see **coloc recordings**.")
    ] = None,
    data: Data = None,
) -> None:
    """Write a recording that coloc knows in the open format, exact to the bit.

    **Examples**

    coloc recording export replay-miluv-v0 --out miluv

    coloc recording export replay-mrclam-v0 --sequence MRCLAM_Dataset7 --out seven
    """
    from coloc_env import options
    from coloc_env.datasets import DATASETS, load
    from coloc_env.datasets.open_format import write_recording

    known = {f"replay-{name}-v0": name for name in DATASETS}
    options.require_known("recording", [scenario], known)
    write_recording(load(known[scenario], sequence, data), out)
    typer.echo(f"written to {out}")
