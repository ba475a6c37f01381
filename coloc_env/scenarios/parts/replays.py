"""Options and parts of scenarios that replay a recording.

The data are their owners' and not part of this package: see ``coloc_env.datasets``. Loading is lazy
(at ``make_scenario``) and parsing is cached on disk.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

from coloc_env.datasets import Recording, load
from coloc_env.datasets.folders import Version, dataset_folder, version
from coloc_env.datasets.grid import Grid
from coloc_env.options import Group, Metres, PositiveSeconds, Seconds
from coloc_env.sensors import RangeNoise


@dataclass(frozen=True)
class SpanOptions(Group):
    """``span``: the part that is replayed, from and to, in s after the start (none: all of it)."""

    title: ClassVar[str] = "recording"

    span: tuple[Seconds, Seconds] | None = None

    def cut(self, grid: Grid) -> Grid:
        """The steps of ``span``, of the steps of a whole recording."""
        if self.span is None:
            return grid
        first, last = (round(max(-1.0, min(s / grid.dt, grid.count - 1.0))) for s in self.span)
        if not 0 <= first < last:
            raise ValueError(
                f"span={self.span} is not allowed: (from, to) in s within 0 and "
                f"{grid.count * grid.dt:.1f}"
            )
        return Grid(int(grid.times[first]), grid.dt, last - first + 1)


@dataclass(frozen=True)
class OwnReplayOptions(SpanOptions):
    """``dt``: duration of a step."""

    dt: PositiveSeconds = 0.1


@dataclass(frozen=True)
class RecordingOptions(SpanOptions):
    """``sequence``: which recording (none: the one with the most robots); ``data``: the folder that
    holds the data sets (none: that of the environment variable COLOC_DATA)."""

    sequence: str | None = None
    data: str | None = None

    def load(self, dataset: str, **options: Any) -> Recording:
        """The recording of a data set."""
        known = version(dataset_folder(dataset, self.data))
        return _loaded(known, dataset, self.sequence, self.data, **options)


@dataclass(frozen=True)
class ReplayOptions(RecordingOptions):
    """``dt``: duration of a step."""

    dt: PositiveSeconds = 0.1


@dataclass(frozen=True)
class BiasOptions(Group):
    """The team believes that each link's ranges have a bias of ``range_bias_std`` m that lasts
    ``range_bias_time`` s; what estimates claim of themselves considers that (0: no biases).
    """

    title: ClassVar[str] = "biases"

    range_bias_std: Metres = 0.1
    range_bias_time: PositiveSeconds = 100.0

    def noise(self, std: float) -> RangeNoise:
        """The believed noise of ranges, of standard deviation ``std`` m."""
        return RangeNoise(std, bias_std=self.range_bias_std, bias_time=self.range_bias_time)


@lru_cache(maxsize=4)
def _loaded(
    known: Version, name: str, sequence: str | None, data: str | None, **options: Any
) -> Recording:
    """A recording, kept for the next scenario that replays it until a file of its dataset
    changes."""
    return load(name, sequence, data, **options)
