"""The report as one HTML file: data, script, style and plotly's own script in one."""

import html
import json
from importlib import resources

from training.evaluation.report.content import content
from training.evaluation.runs import Runs


def plotly_script() -> str:
    """Plotly's own script. ValueError where plotly is not installed."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise ValueError("a report needs plotly: pip install 'coloc-env[report]'") from None
    script: str = get_plotlyjs()
    return script


def page(every: list[Runs]) -> str:
    """The page about some evaluations. ValueError where plotly is not installed."""
    data = json.dumps(content(every), allow_nan=False, separators=(",", ":"))
    files = resources.files("training.evaluation.report")
    parts = {
        "title": html.escape(", ".join(runs.name for runs in every)),
        "style": (files / "report.css").read_text("utf-8"),
        "plotly": plotly_script(),
        "data": data.replace("<", "\\u003c"),
        "script": (files / "report.js").read_text("utf-8"),
    }
    text = (files / "report.html").read_text("utf-8")
    for name, part in parts.items():
        text = text.replace(f"<!--{name}-->", part)
    return text
