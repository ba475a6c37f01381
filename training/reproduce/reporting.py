"""What reports have in common: verdicts as text and JSON, and what could not be flown."""

import json
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from training.evaluation.metrics import Difference
from training.evaluation.results import plain
from training.evaluation.tables import table
from training.reproduce import verdicts
from training.reproduce.study import Study
from training.reproduce.verdicts import Verdict

DASH = "–"
Text = list[str]
Table = tuple[list[str], list[list[str]]]  # header and lines


def difference(found: Difference, scale: float, unit: str, sign: bool = True) -> str:
    """Mean and 95 % interval in words."""
    mean, low, high = (
        f"{scale * x:{'+' if sign else ''}.3g}".replace("-", "−").replace("inf", "∞")
        for x in (found.mean, found.low, found.high)
    )
    return f"{mean}{unit and ' '}{unit} ({low} to {high})"


def ends(x: Difference, form: Callable[[float], str] = "{:.3f}".format) -> str:
    """A mean with its interval; a dash for NaN."""
    if np.isnan(x.mean):
        return DASH
    if not np.isfinite([x.low, x.high]).all():
        return form(x.mean)
    return f"{form(x.mean)} ({form(x.low)} to {form(x.high)})"


def section(title: str, content: Table, left: int) -> Text:
    """A titled table, ``left`` columns of which are words; nothing if it has no lines."""
    header, lines = content
    return [f"### {title}", "", *table(header, lines, left=left), ""] if lines else []


def counts(judged: Sequence[Verdict]) -> str:
    """How many claims came out how."""
    count = Counter(each.verdict for each in judged)
    kinds = (verdicts.REPRODUCED, verdicts.NOT, verdicts.CONTRADICTED, verdicts.UNKNOWN)
    return f"**{len(judged)} claims: " + ", ".join(f"{count[x]} {x}" for x in kinds) + ".**"


def claims(judged: Sequence[Verdict]) -> Text:
    """A table of claims and what became of them."""
    lines = []
    for each in judged:
        claim, ours = each.claim, DASH
        if each.ours is not None:
            ours = difference(each.ours, 1.0, claim.unit, claim.compares)
        lines.append([claim.words, claim.theirs, ours, f"**{each.verdict}**: {each.reason}"])
    return table(["claim", "paper", "ours (95 %)", "verdict"], lines, left=4)


def failures(study: Study) -> Text:
    """What could not be flown, and why."""
    if not study.failed:
        return []
    keys: dict[tuple[str, str], list[str]] = {}
    for (key, agent), why in study.failed.items():
        keys.setdefault((agent, why), []).append(f"*{key}*")
    agents: dict[tuple[str, str], list[str]] = {}
    for (agent, why), some in keys.items():
        agents.setdefault((", ".join(some), why), []).append(f"`{agent}`")
    lines = [f"- {where}, {', '.join(some)}: {why}" for (where, why), some in agents.items()]
    return ["", "## Not flown", "", *lines]


def write_report(folder: Path, name: str, source: str, text: Text, study: Study) -> None:
    """``report.md`` of a paper: what was found, and what could not be flown."""
    text = [f"# {name}, reproduced", "", f"{source}.", "", *text, *failures(study)]
    (folder / "report.md").write_text("\n".join(text).rstrip() + "\n", encoding="utf-8")


def as_json(each: Verdict) -> dict[str, Any]:
    """A verdict as plain values."""
    ours = each.ours
    return {
        "claim": each.claim.words,
        "paper": each.claim.theirs,
        "unit": each.claim.unit,
        "ours": None if ours is None else ours.mean,
        "interval": None if ours is None else [ours.low, ours.high],
        "verdict": each.verdict,
        "reason": each.reason,
    }


def write_json(path: Path, content: Any) -> None:
    """Indented, NaN and infinity as null."""
    text = json.dumps(plain(content), indent=1, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
