"""The result page: Markdown from ``results.json`` alone."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from training.evaluation.tables import table

Content = Mapping[str, Any]
_ALIGN = {"left": "---", "right": "---:"}


def read(file: Path) -> Content:
    """``results.json`` of a study. ValueError, in one line, if there is none or it is none."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if not {"study", "sections", "provenance"} <= content.keys():
            raise KeyError("sections")
    except FileNotFoundError:
        raise ValueError(f"{file} does not exist: run the study first") from None
    except (ValueError, KeyError, AttributeError, RecursionError):
        raise ValueError(f"{file} holds no results of a study") from None
    return dict(content)


def render(content: Content, images: str = "") -> str:
    """The page; ``images``: where its figures lie, seen from the page ("" or a path with /)."""
    lines = [f"# {content['study']}, reproduced", "", f"{content['source']}.", ""]
    lines += [_provenance(content["provenance"]), ""]
    for section in content["sections"]:
        lines += [f"## {section['title']}", ""]
        for paragraph in section["text"]:
            lines += [paragraph, ""]
        for each in section["tables"]:
            lines += rendered(each)
        for figure in section["figures"]:
            caption = figure["caption"]
            lines += [f"![{caption}]({images}{figure['file']})", "", f"*{caption}*", ""]
    if content["not_run"]:
        lines += ["## Not run", "", *(f"- {line}" for line in content["not_run"]), ""]
    return "\n".join(lines).rstrip() + "\n"


def rendered(content: Content) -> list[str]:
    """A table with its title and caption; a long one folded."""
    left = sum(side == "left" for side in content["align"])
    body = table(content["header"], content["rows"], left)
    title, caption = content["title"], content["caption"]
    if content.get("long"):
        start = ['<details markdown="1">', f"<summary>{title}</summary>", ""]
        return [*start, *body, "", "</details>", ""]
    start = [f"### {title}", ""] if title else []
    return [*start, *body, "", *([caption, ""] if caption else [])]


def _provenance(facts: Content) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    commit = f" at commit {facts['commit']}" if facts["commit"] else ""
    return (
        f"Written by `{facts['command']}` on {facts['date']}{commit}: {facts['runs']} runs, seeds "
        f"from {facts['seed']} on; {versions}; {facts['machine']}."
    )


def write(content: Content, folder: Path, names: Sequence[str]) -> None:
    """``results.json`` and the page, under these names."""
    text = json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False)
    (folder / names[0]).write_text(text + "\n", encoding="utf-8")
    (folder / names[1]).write_text(render(content), encoding="utf-8")
