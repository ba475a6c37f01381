"""Settings of a study that is run: where, how much of it, and with what."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from coloc_env.seeding import checked_seed
from training.pool import ALONE, Workers


@dataclass(frozen=True)
class Settings:
    """``out``: folder of the store and the results; ``part`` of the study, or "all"; ``runs``:
    worlds of the main tables, seeded ``seed``, ``seed`` + 1, …; ``agents`` and ``variants``: these
    only (None: all); ``steps``: cut runs to so many (None: whole runs); ``workers``: who
    computes; ``fresh``: throw the store away first; ``report_only``: compute nothing;
    ``device``: where runs are.

    Links in ``out`` are followed. Raises ValueError, in one line, for a value that is not allowed.
    """

    out: Path
    runs: int
    part: str = "all"
    seed: int = 0
    agents: Sequence[str] | None = None
    variants: Sequence[str] | None = None
    steps: int | None = None
    workers: Workers = ALONE
    fresh: bool = False
    report_only: bool = False
    device: str = "cpu"

    def __post_init__(self) -> None:
        for name in ("runs", "steps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"--{name} {value} is not allowed: at least 1")
        checked_seed(self.seed, "reproduce")
        if self.fresh and self.report_only:
            raise ValueError("--fresh and --report-only: nothing would be left to report")
        object.__setattr__(self, "out", _resolved(self.out))

    @property
    def store(self) -> Path:
        """Where results are kept."""
        return self.out / "store"

    def fraction(self, divisor: int) -> int:
        """A share of the runs, at least one: of what is expensive, or differs little."""
        return max(1, self.runs // divisor)


def _resolved(out: Path) -> Path:
    try:
        return out.resolve()
    except (OSError, RuntimeError) as error:  # links in a circle
        raise ValueError(f"{out} cannot be written: {error}") from None
