"""A run's metrics: TorchRL's CSV files, and TensorBoard beside them."""

import os
from pathlib import Path

from torchrl.record import CSVLogger, TensorboardLogger

from coloc_env.staging import staged_file

FOLDERS = ("metrics", "tensorboard")


class RunLogger(CSVLogger):
    """Scalars as ``metrics/scalars/NAME.csv`` (lines ``frames,value``) and for TensorBoard.

    What a run that died wrote after its state at ``frames`` frames is cut off, and TensorBoard gets
    the CSV files' lines again: both then go on as those of a run that never died. ``last``
    holds the newest value of each metric.
    """

    def __init__(self, folder: Path, frames: int) -> None:
        metrics, board = FOLDERS
        kept = _cut(folder / metrics / "scalars", frames)
        for events in (folder / board).glob("events.*"):
            events.unlink()
        super().__init__(metrics, str(folder))
        self.board = TensorboardLogger(board, str(folder))
        self.last: dict[str, float] = {}
        for name, step, value in kept:
            self._show(name, value, step)

    def log_scalar(self, name: str, value: float, step: int | None = None) -> None:
        super().log_scalar(name, value, step)
        self._show(name, float(value), step)

    def _show(self, name: str, value: float, step: int | None) -> None:
        self.last[name] = value
        self.board.log_scalar(name, value, step)

    def sync(self) -> None:
        """Put the CSV files on the disk, before a state that goes on from them."""
        for file in self.experiment.files.values():
            os.fsync(file.fileno())

    def close(self) -> None:
        """Write what TensorBoard's writer still holds."""
        self.board.experiment.close()


def _cut(scalars: Path, frames: int) -> list[tuple[str, int, float]]:
    """Keep the lines up to a number of frames, and return them as (name, frames, value)."""
    kept = []
    for file in sorted(scalars.glob("**/*.csv")):
        good = []
        for line in file.read_text(errors="replace").splitlines(keepends=True):
            try:
                step, value = int(line.partition(",")[0]), float(line.partition(",")[2])
            except ValueError:
                break
            if not line.endswith("\n") or step > frames:
                break
            good.append(line)
            kept.append((str(file.relative_to(scalars).with_suffix("")), step, value))
        with staged_file(file) as staged:
            staged.write_text("".join(good))
    return kept
