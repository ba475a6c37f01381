"""``coloc recording``: recordings of one's own."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from training.cli.options import Data, Settings
from training.cli.terminal import progress, show

if TYPE_CHECKING:
    from coloc_env.datasets.check import StreamReport

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


class ExportFormat(StrEnum):
    """What a recording can be written as."""

    open = "open"
    tum = "tum"
    bag = "bag"


Folder = Annotated[
    Path, typer.Argument(metavar="DIR", help="A folder in the open recording format.")
]


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
        [[row.robot, row.stream, *_timing(row)] for row in report.streams],
    )
    if report.links:
        typer.echo("ranges less the truth")
        show(
            ["link", "samples", "bias, m", "σ, m", "beyond 3 σ", "late by, s"],
            [
                [
                    row.link,
                    *_noise(row.samples, row.bias, row.std, row.outliers),
                    f"{row.delay:+.2f}",
                ]
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
        str,
        typer.Argument(
            metavar="SCENARIO", help="**replay-miluv-v0**, another recording, or a folder of yours."
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")],
    sequence: Annotated[
        str | None, typer.Option(help="Which sequence; see **coloc recordings**.")
    ] = None,
    kind: Annotated[
        ExportFormat,
        typer.Option(
            "--format",
            help="**open**, everything; **tum** or **bag** (ROS 2), the true trajectories alone.",
        ),
    ] = ExportFormat.open,
    data: Data = None,
) -> None:
    """Write a recording that coloc knows in the open format, exact to the bit, or its trajectories
    for other tools, with attitudes and the stamps that were recorded.

    **Examples**

    coloc recording export replay-miluv-v0 --out miluv

    coloc recording export replay-mrclam-v0 --sequence MRCLAM_Dataset7 --out seven

    coloc recording export flight --format tum --out flight_tum
    """
    from coloc_env import options
    from coloc_env.datasets import DATASETS, load
    from coloc_env.datasets.open_format import read_recording, write_recording
    from coloc_env.datasets.trajectories import write_bag, write_tum

    known = {f"replay-{name}-v0": name for name in DATASETS}
    if scenario not in known and Path(scenario).is_dir():
        found = read_recording(scenario)
    else:
        options.require_known("recording", [scenario], known)
        found = load(known[scenario], sequence, data)
    {"open": write_recording, "tum": write_tum, "bag": write_bag}[kind.value](found, out)
    typer.echo(f"written to {out}")


@recording.command("import")
def import_(
    bag: Annotated[
        Path,
        typer.Argument(metavar="BAG", help="A ROS 1 bag, a ROS 2 bag's folder, or an MCAP file."),
    ],
    topics: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help="Which topic is which table: topics.yaml."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder to write.")] = None,
    show_topics: Annotated[
        bool, typer.Option("--list", help="Print what is there, as a first topics.yaml.")
    ] = False,
) -> None:
    """Make a recording of a bag, message by message.

    **Examples**

    coloc recording import flight.mcap --list > topics.yaml

    coloc recording import flight.mcap --map topics.yaml --out flight
    """
    from coloc_env.datasets.bags import first_topics, import_bag

    if show_topics:
        typer.echo(first_topics(bag), nl=False)
        return
    if topics is None or out is None:
        raise ValueError("--map and --out are needed (or --list)")
    with progress() as bars:
        counts = import_bag(bag, topics, out, bars)
    show(["table", "rows"], [[table, str(count)] for table, count in counts.items()])
    typer.echo(f"written to {out}")


@recording.command()
def calibrate(
    folder: Folder,
    span: Annotated[
        str | None,
        typer.Option(metavar="FROM:TO", help="The part to learn from, in s; score on the rest."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="What to write; DIR/believed.yaml if none.")
    ] = None,
    tune: Annotated[
        str | None,
        typer.Option(
            metavar="AGENT", help="Scale noise to what this agent does best with on the part."
        ),
    ] = None,
    settings: Settings = None,
) -> None:
    """Learn what a recording's sensors are like: noise, biases, delays, places and scales.

    With ground truth against that, else against the team's own smoothed estimate. Score on a part
    of the recording that was not used.

    **Examples**

    coloc recording calibrate flight --span 0:60

    coloc recording calibrate flight --span 0:60 --tune ekf:robust=huber

    coloc evaluate replay-v0 --set path=flight --set believed=flight/believed.yaml
    --set span=60:180 --agents ekf --out results/flight
    """
    from coloc_env.datasets.noise_model import write_noise_model
    from coloc_env.datasets.open_format import read_recording
    from coloc_env.staging import require_writable, staged_file
    from training.calibration.calibrate import calibrate as learn
    from training.calibration.calibrate import part_of

    path = folder / "believed.yaml" if out is None else out
    require_writable(path)
    found = read_recording(folder)
    if span is not None:
        found = part_of(found, _span(span))
    learnt = learn(found)
    lines = [
        [name, *_noise(n.count, n.bias, n.std, n.tail), f"{n.white:.3f}"]
        for name, n in learnt.noises.items()
    ]
    show(["", "samples", "bias", "σ", "beyond 3 σ", "σ if white"], lines)
    model, notes = learnt.model, learnt.notes
    if tune is not None:
        from coloc_env.scenarios import parse_overrides
        from training.calibration.tune import tuned

        if not found.tracked:
            raise ValueError("--tune needs ground truth")
        chosen = parse_overrides("replay-v0", settings or ())
        if span is not None:
            chosen.setdefault("span", _span(span))
        with progress() as bars:
            model, words = tuned(model, folder, tune, bars, **chosen)
        notes = (*notes, *words)
    for note in notes:
        typer.echo(note)
    part = "all of it" if span is None else f"{span} s of it"
    with staged_file(path) as file:
        text = write_noise_model(model, f"{found.name}: calibrated on {part}")
        file.write_text(text, encoding="utf-8")
    typer.echo(f"written to {path}")


def _timing(row: "StreamReport") -> list[str]:
    numbers = (f"{row.rate:.4g}", f"{row.longest:.3g}", str(row.gaps), str(row.repeated))
    return [str(row.samples), *numbers]


def _noise(count: int, bias: float, std: float, tail: float) -> list[str]:
    return [str(count), f"{bias:+.3f}", f"{std:.3f}", f"{100 * tail:.1f} %"]


def _span(text: str) -> tuple[float, float]:
    try:
        first, last = map(float, text.split(":"))
    except ValueError:
        first, last = 0.0, 0.0
    if not 0 <= first < last:
        raise ValueError(f"--span {text} is not allowed: FROM:TO in s, 0 ≤ FROM < TO")
    return first, last
