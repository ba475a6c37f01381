"""The report as one HTML file: data, script, style and plotly's own script in one."""

import html
import json
from importlib import resources

from training.evaluation.report.content import content
from training.evaluation.runs import Runs


def page(every: list[Runs]) -> str:
    """The page about some evaluations. ValueError where plotly is not installed."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise ValueError("a report needs plotly: pip install 'coloc-env[report]'") from None
    data = json.dumps(content(every), allow_nan=False, separators=(",", ":"))
    files = resources.files("training.evaluation.report")
    parts = {
        "title": html.escape(", ".join(runs.name for runs in every)),
        "style": (files / "report.css").read_text("utf-8"),
        "plotly": get_plotlyjs(),
        "data": data.replace("<", "\\u003c"),
        "script": (files / "report.js").read_text("utf-8"),
    }
    text = (files / "report.html").read_text("utf-8")
    for name, part in parts.items():
        text = text.replace(f"<!--{name}-->", part)
    return text
