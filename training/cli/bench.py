"""``coloc bench``."""

from pathlib import Path
from typing import Annotated

import typer

from training.cli.options import Device, Jobs, Ray, workers_of
from training.threads import use_threads


def bench(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the figures.")],
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter measurements.")] = False,
    growth: Annotated[
        bool,
        typer.Option("--growth", help="Against UAVs, worlds, particles and landmarks instead."),
    ] = False,
    device: Device = "cpu",
    jobs: Jobs = 1,
    ray: Ray = None,
) -> None:
    """Measure speed: worlds, both faces, agents, beside other environments where installed.

    **--device** measures worlds and agents there beside the CPU, by worlds at once; **--growth**
    how time and memory of a step grow, and what a large study costs; **--jobs** or **--ray** what
    it costs to spread work over processes or a cluster, and what it brings.

    **Examples**

    coloc bench --quick --out results/bench

    coloc bench --growth --out results/growth

    coloc bench --device cuda --out results/card

    coloc bench --ray auto --out results/cluster
    """
    use_threads(1)
    from training.bench import bench as measurements
    from training.devices import checked_device

    where = checked_device(device)
    if growth:
        measurements.bench_growth(out, quick, where)
    elif device != "cpu":
        measurements.bench_device(out, quick, where)
    elif jobs > 1 or ray is not None:
        with workers_of(jobs, ray) as workers:
            measurements.bench_spread(out, quick, workers)
    else:
        measurements.bench(out, quick)
