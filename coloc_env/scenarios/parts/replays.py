"""Options and parts of scenarios that replay a recording.

The data are their owners' and not part of this package: see ``coloc_env.datasets``. Loading is lazy
(at ``make_scenario``) and parsing is cached on disk.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

from coloc_env.datasets import Recording, load
from coloc_env.datasets.grid import Grid
from coloc_env.options import Group, PositiveSeconds, Seconds


@dataclass(frozen=True)
class RecordingOptions(Group):
    """``sequence``: which recording (none: the one with the most robots); ``data``: the folder that
    holds the data sets (none: that of the environment variable COLOC_DATA); ``span``: the part that
    is replayed, from and to, in s after the start (none: all of it)."""

    title: ClassVar[str] = "recording"

    sequence: str | None = None
    data: str | None = None
    span: tuple[Seconds, Seconds] | None = None

    def load(self, dataset: str, **options: Any) -> Recording:
        """The recording of a data set."""
        return _loaded(dataset, self.sequence, self.data, **options)

    def cut(self, grid: Grid) -> Grid:
        """The steps of ``span``, of the steps of a whole recording."""
        if self.span is None:
            return grid
        first, last = (round(s / grid.dt) for s in self.span)
        last = min(last, grid.count - 1)
        if not 0 <= first < last:
            raise ValueError(
                f"span={self.span} is not allowed: (from, to) in s within 0 and "
                f"{grid.count * grid.dt:.1f}"
            )
        return Grid(int(grid.times[first]), grid.dt, last - first + 1)


@dataclass(frozen=True)
class ReplayOptions(RecordingOptions):
    """``dt``: duration of a step."""

    dt: PositiveSeconds = 0.1


@lru_cache(maxsize=4)
def _loaded(name: str, sequence: str | None, data: str | None, **options: Any) -> Recording:
    """A recording, kept for the next scenario that replays it."""
    return load(name, sequence, data, **options)
