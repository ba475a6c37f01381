"""``coloc bench``."""

from pathlib import Path
from typing import Annotated

import typer


def bench(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the figures.")],
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter measurements.")] = False,
) -> None:
    """Measure speed: worlds, both faces, agents, beside other environments where installed.

    **Examples**

    coloc bench --quick --out results/bench
    """
    from training.bench.bench import bench as measure

    measure(out, quick)
