"""Tables of an evaluation as text: the main one, Markdown and CSV; and how numbers are shown."""

import csv
import html
import io
from collections.abc import Iterable, Sequence

from coloc_env.options import typed
from training.evaluation import metrics
from training.evaluation.results import Evaluation, plain

COLUMNS = {
    "rmse": "RMSE",
    "rmse_std": "± runs",
    "mean": "mean",
    "median": "median",
    "max": "max",
    "rmse_after_10s": "after 10 s",
    "diverged_runs": "diverged",
    "nees": "NEES",
    "avg_particles": "particles",
    "bytes_per_step": "bytes/step",
    "ms_per_step": "ms/step",
    "ratio_to_bound": "× bound",
}

_EXPLAINED = """\
Position errors in m, all agents on the same worlds; RMSE over UAVs, steps and runs, ± its
standard deviation over runs; max is the mean over runs and UAVs of the largest error. A run counts
as diverged if a UAV's error stays above {:g} m over its last {:g} s, or if an estimate was not
finite; it stays in every figure. NEES: {} is consistent, more is overconfident. bytes/step: what
each UAV sends to others in a step. ms/step: the whole team, one world, one thread. × bound: over
the posterior bound's RMSE; below 1 in few runs by chance."""


WITHOUT_TRUTH = (
    "Without ground truth: mean NIS of each sensor's measurements and where it lies for a "
    "consistent filter, correlation of a link's successive innovations (0 if white), share beyond "
    "the 99.9 % gate, predicted deviation per axis and distance from the other methods' mean (m)."
)
INNOVATION_COLUMNS = (
    "agent", "sensor", "NIS", "band", "correlation", "band of it", "rejected", "predicted σ",
    "disagreement",
)  # fmt: skip


def rows(results: Evaluation, keys: Iterable[str] = COLUMNS) -> list[list[str]]:
    """The main table as text: one line for the bound, if known, and one per agent."""
    keys = tuple(keys)
    bound, lines = results.bound, []
    if bound is not None:
        known = {"rmse": bound.rmse, "rmse_after_10s": bound.rmse_after(10.0)}
        lines.append(["bound", *(short(plain(known.get(key))) for key in keys)])
    for name, found in results.summary["agents"].items():
        lines.append([name, *(short(found[key]) for key in keys)])
    return lines


def heading(results: Evaluation) -> str:
    """Which worlds the table is about."""
    runs = "1 run" if results.runs == 1 else f"{results.runs} runs"
    what = f"{runs} of {results.scenario.horizon} steps of {results.dt:g} s"
    last = results.seed + results.runs - 1
    return f"{results.scenario.name}: {what}, seeds {results.seed} to {last}"


def markdown(results: Evaluation) -> str:
    """The main table, paired differences to the first agent, and what the words mean."""
    names, dim = list(results.agents), results.scenario.arena.dim
    text = [f"# {heading(results)}", ""]
    if results.scenario.overrides:
        chosen = (f"`{key}={typed(value)}`" for key, value in results.scenario.overrides.items())
        text += ["Overrides: " + ", ".join(chosen) + ".", ""]
    text += table(["agent", *COLUMNS.values()], rows(results))
    text += ["", _EXPLAINED.format(results.lost_beyond, metrics.LOST_SECONDS, dim)]
    if len(names) > 1 and results.runs > 1:
        differences = [[name, *_interval(results, name, names[0])] for name in names[1:]]
        text += ["", f"RMSE minus that of `{names[0]}`, paired by run:", ""]
        text += table(["agent", "mean difference", "95 % interval"], differences)
    if results.innovations:
        text += ["", WITHOUT_TRUTH, "", *table(INNOVATION_COLUMNS, innovation_rows(results), 2)]
    for name, one in results.agents.items():
        if one.messages:
            how_many = f"{len(one.messages)} of {results.runs} runs"
            text += ["", f"`{name}` raised in {how_many}; the first at {one.messages[0]}"]
    for name, error in results.errors.items():
        text += ["", f"`{name}` ended in an error: {error}"]
    if results.dropped:
        text += ["", left_out(results)]
    return "\n".join(text) + "\n"


def innovation_rows(results: Evaluation) -> list[list[str]]:
    """What is known of each agent without truth: a line a sensor."""
    lines = []
    for name, found in results.innovations.items():
        figures = plain(found | {"apart": results.disagreement.get(name)})
        ends = (short(figures.get("predicted_std")), short(figures["apart"]))
        sensors = [key.removeprefix("nis_") for key in found if f"{key}_low" in found]
        for sensor in sensors or [""]:
            own = {key: figures.get(f"{key}_{sensor}") for key in ("nis", "whiteness", "rejected")}
            band = [short(figures.get(f"nis_{sensor}_{end}")) for end in ("low", "high")]
            band = band if sensor else ["–"]
            white = short(figures.get(f"whiteness_{sensor}_band"))
            shown = (short(own["nis"]), " to ".join(band), short(own["whiteness"]), f"± {white}")
            lines.append([name, sensor or "–", *shown, short(own["rejected"]), *ends])
    return lines


def html_table(results: Evaluation) -> str:
    """The main table as notebooks show it."""
    lines = [["", *COLUMNS.values()], *rows(results)]
    cells = [
        "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in line)
        for line, tag in zip(lines, ["th", *["td"] * (len(lines) - 1)], strict=True)
    ]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in cells) + "</table>"


def left_out(results: Evaluation) -> str:
    """What of a recording was left out."""
    streams = ", ".join(f"{count} of {stream}" for stream, count in results.dropped.items())
    return f"Left out of the recording, since no sensor can have measured it: {streams}."


def csv_text(results: Evaluation) -> str:
    """One line per agent; empty where a figure does not apply."""
    lines = []
    for name, found in results.summary["agents"].items():
        per_uav = {f"rmse_uav_{i}": x for i, x in enumerate(found["per_uav_rmse"])}
        line = {k: v for k, v in found.items() if k not in ("per_uav_rmse", "diagnostics")}
        lines.append({"agent": name} | line | found["diagnostics"] | per_uav)
    out = io.StringIO()
    columns = list(dict.fromkeys(key for line in lines for key in line))
    writer = csv.DictWriter(out, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return out.getvalue()


def _interval(results: Evaluation, a: str, b: str) -> list[str]:
    difference = results.paired_difference(a, b)
    return [signed(difference.mean), f"{signed(difference.low)} to {signed(difference.high)}"]


def table(header: Sequence[str], lines: Iterable[Sequence[str]], left: int = 1) -> list[str]:
    """The lines of a Markdown table; all columns but the first ``left`` are set right."""
    every = [header, [*["---"] * left, *["---:"] * (len(header) - left)], *lines]
    return ["| " + " | ".join(cells) + " |" for cells in every]


def signed(value: float) -> str:
    """Two digits and a sign."""
    return f"{value:+.2g}".replace("-", "−")


def short(value: float | None) -> str:
    """Three digits, no exponent where it can be helped."""
    if value is None:
        return "–"
    if isinstance(value, int) or 100 <= abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:.3g}"
