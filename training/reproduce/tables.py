"""Tables of reports: built from measures, written as numbers with their intervals."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from training.evaluation import metrics
from training.evaluation.metrics import Difference, Floats
from training.evaluation.tables import short
from training.reproduce.results import Runs

DASH = "–"
Column = tuple[str, Callable[[Runs], str]]  # a header, and an agent's cell


@dataclass(frozen=True)
class Table:
    """A titled table; ``left``: so many columns are words; ``long``: shown folded."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: int = 1
    caption: str = ""
    long: bool = False

    def as_json(self) -> dict[str, Any]:
        """As plain values."""
        right = len(self.header) - self.left
        return {
            "title": self.title,
            "caption": self.caption,
            "header": list(self.header),
            "align": ["left"] * self.left + ["right"] * right,
            "rows": [list(row) for row in self.rows],
            "long": self.long,
        }


def by_agent(
    title: str,
    found: Mapping[str, Mapping[str, Runs]],
    columns: Sequence[Column],
    *,
    where: str = "variant",
    caption: str = "",
) -> Table:
    """A line for every agent in every place, by the place's title."""
    rows = [
        [place, f"`{agent}`", *(cell(one) for _, cell in columns)]
        for place, there in found.items()
        for agent, one in there.items()
    ]
    return Table(title, [where, "agent", *(header for header, _ in columns)], rows, 2, caption)


def numbered(measure: Callable[[Runs], Any], form: str = "{:.2f}") -> Callable[[Runs], str]:
    """A cell with one number."""
    return lambda one: number(measure(one), form)


def shortened(measure: Callable[[Runs], Any]) -> Callable[[Runs], str]:
    """A cell with three digits."""
    return lambda one: short(float(measure(one)))


def with_ends(measure: Callable[[Runs], Floats], form: str = "{:.3f}") -> Callable[[Runs], str]:
    """A cell with the mean over runs and its 95 % interval."""

    def cell(one: Runs) -> str:
        values = measure(one)
        found = metrics.paired_difference(values, np.zeros_like(values))
        return ends(found, form.format)

    return cell


def number(value: float | None, form: str = "{:.2f}") -> str:
    """A number, or a dash."""
    return DASH if value is None or not np.isfinite(value) else form.format(value)


def ends(x: Difference, form: Callable[[float], str] = "{:.3f}".format) -> str:
    """A mean with its interval; a dash for NaN."""
    if np.isnan(x.mean):
        return DASH
    if not np.isfinite([x.low, x.high]).all():
        return form(x.mean)
    return f"{form(x.mean)} ({form(x.low)} to {form(x.high)})"


def signed(found: Difference, unit: str, sign: bool = True, scale: float = 1.0) -> str:
    """Mean and interval with a unit and, of a difference, a sign."""
    mean, low, high = (
        f"{scale * x:{'+' if sign else ''}.3g}".replace("-", "−").replace("inf", "∞")
        for x in (found.mean, found.low, found.high)
    )
    return f"{mean}{unit and ' '}{unit} ({low} to {high})"


def spread(values: Floats | None) -> str:
    """Mean ± standard deviation over runs, or over steps."""
    if values is None or not np.isfinite(values).any():
        return DASH
    kept = values[np.isfinite(values)]
    deviation = f" ± {short(kept.std(ddof=1))}" if len(kept) > 1 else ""
    return short(metrics.mean(kept)) + deviation


def lost(one: Runs) -> str:
    """Runs that ended lost or not finite."""
    return f"{one.diverged} of {one.evaluation.runs}"


def nees(one: Runs) -> str:
    """Mean NEES of the position; 3 in space, 2 in the plane, is consistent."""
    return short(metrics.mean(one.record.nees[one.scored]))


def interleaved(pairs: Iterable[tuple[str, str]]) -> list[str]:
    """The paper's cells and ours, side by side."""
    return [cell for pair in pairs for cell in pair]
