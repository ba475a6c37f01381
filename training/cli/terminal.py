"""What commands print on a terminal: tables, explanations and bars of progress."""

import inspect
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from coloc_env.options import paragraphs, typed
from coloc_env.registry import Registry

_PIPED = 160  # columns of a table that no terminal shows
_QUIET = 30.0  # s without a line of progress


def explain(name: str, registry: Registry, kind: str) -> None:
    """Print what a registered name is by its docstring, and its options (each a ``kind``, a
    singular noun) in groups: what each may be, with its unit, and its default."""
    known = registry.options_of(name)
    text = "\n\n".join(map(escape, paragraphs(inspect.getdoc(registry[name]) or "")))
    console = Console()
    console.print(f"[bold]{escape(name)}[/bold]\n{text}", highlight=False)
    if not known:
        typer.echo(f"\nno {kind}s")
    groups = {option.group: option.about for option in known.values()}
    width = max(map(len, known), default=0)
    for group in sorted(groups, key=bool):  # those of the function itself first
        about = f"\n{escape(groups[group])}" if groups[group] else ""
        console.print(f"\n[bold]{group or f'{kind}s'}[/bold]{about}", highlight=False)
        lines = [
            [option.name.ljust(width), option.words, typed(option.default)]
            for option in known.values()
            if option.group == group
        ]
        show(["", "allowed", "default"], lines)


def show(header: list[str], lines: list[list[str]]) -> None:
    """Print a table: a title a column (all empty: no header), and lines of as many cells. Beyond
    three columns, all but the first are numbers; where it must be narrowed, words give way to names
    and numbers."""
    table = Table(box=None, pad_edge=False, header_style="bold", show_header=any(header))
    numbers = len(header) > 3
    for i, title in enumerate(header):
        right = numbers and i > 0
        table.add_column(title, justify="right" if right else "left", no_wrap=right or i == 0)
    for line in lines:
        table.add_row(*map(escape, line))
    console = Console()
    if not console.is_terminal:
        console.width = _PIPED
    console.print(table, highlight=False)


@contextmanager
def progress() -> Iterator[Callable[[str, int, int], None]]:
    """Bars on stderr, where that is a terminal, or in a notebook's cell (by ipywidgets); elsewhere
    a line every half minute, and in CI (the variable ``CI`` is set) one for each task that is done.
    The block is given a function to call with a task's name, how much of it is done, and of
    how much; each task has a bar of its own."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    hidden = not (console.is_terminal or console.is_jupyter)
    in_ci = bool(os.environ.get("CI"))
    start = last = time.monotonic()
    with Progress(*columns, console=console, transient=True, disable=hidden) as bars:
        tasks: dict[str, Any] = {}
        said: set[str] = set()

        def advance(what: str, done: int, total: int) -> None:
            nonlocal last
            if what not in tasks:
                tasks[what] = bars.add_task(escape(what), total=total)
            bars.update(tasks[what], completed=done, total=total)
            now = time.monotonic()
            whole = in_ci and done >= total and what not in said
            if hidden and (whole or now - last > _QUIET):
                last = now
                if done >= total:
                    said.add(what)
                count = total if done >= total else f"{done} of {total}"
                typer.echo(f"{what}: {count} done, {now - start:.1f} s", err=True)

        yield advance
