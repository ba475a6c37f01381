"""Tables of measured numbers: a line that is nothing but a link to a file of ``results/measured``
becomes that file's table, so that no number on a page is typed by hand."""

import json
import re
from pathlib import Path
from typing import Any

_LINK = re.compile(r"^\[[^\]]+\]\((?P<path>[\w./-]*measured/\w+\.json)\)$", re.MULTILINE)


def table(measured: dict[str, Any]) -> str:
    """The Markdown of one file: its table, what it shows, and where its numbers come from."""
    rule = ["---:" if side == "right" else "---" for side in measured["align"]]
    lines = [measured["header"], rule, *measured["rows"]]
    rows = ["| " + " | ".join(cells) + " |" for cells in lines]
    source = f"*{measured['caption']} `{measured['command']}`; {measured['provenance']}.*"
    return "\n".join([f"**{measured['title']}**", "", *rows, "", source])


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    folder = Path(page.file.abs_src_path).parent if page.file.abs_src_path else Path()

    def replaced(found: re.Match[str]) -> str:
        return table(json.loads((folder / found["path"]).read_text(encoding="utf-8")))

    return _LINK.sub(replaced, markdown)
