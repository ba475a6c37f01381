"""What a picture remembers of an episode: recent trails, and errors over all of it."""

import numpy as np

from coloc_env.render.snapshot import Snapshot

_COLUMNS = 600  # moments of the error chart kept at most


def trail_length(n_uavs: int) -> int:
    """Steps of a trail: 300 for small teams, shorter for large ones."""
    return int(np.clip(6000 // n_uavs, 40, 300))


class History:
    """Trails [T, N, d] of the last T steps and the errors of at most ``_COLUMNS`` moments.

    When the error chart is full, every other moment is dropped and only every other one is kept
    from then on, so memory stays bounded over episodes of any length.
    """

    def __init__(self, n_uavs: int, dim: int) -> None:
        length = trail_length(n_uavs)
        self.latest: Snapshot | None = None
        self.last_seen = np.full((n_uavs, dim), np.nan)  # of each UAV, m
        self._truth, self._estimate = np.full((2, length, n_uavs, dim), np.nan)
        self._end = 0  # where the ring's next entry goes
        self._stride = 1
        self._steps: list[int] = []
        self._errors: list[np.ndarray] = []
        self._squares = 0.0
        self._count = 0

    def add(self, snapshot: Snapshot) -> None:
        """Remember one step."""
        self.latest = snapshot
        self.see(snapshot)
        self._truth[self._end] = snapshot.position
        self._estimate[self._end] = snapshot.estimate
        self._end = (self._end + 1) % len(self._truth)
        error = snapshot.error
        self._squares += float(np.nansum(error**2))
        self._count += int(np.isfinite(error).sum())
        if snapshot.step % self._stride == 0:
            self._steps.append(snapshot.step)
            self._errors.append(error)
        if len(self._steps) > _COLUMNS:
            self._stride *= 2
            kept = [i for i, step in enumerate(self._steps) if step % self._stride == 0]
            self._steps = [self._steps[i] for i in kept]
            self._errors = [self._errors[i] for i in kept]

    def see(self, snapshot: Snapshot) -> None:
        """Note where each UAV was last known to be."""
        known = np.isfinite(snapshot.position)
        self.last_seen = np.where(known, snapshot.position, self.last_seen)

    @property
    def truth(self) -> np.ndarray:
        """True positions [T, N, d] in m, oldest first; NaN before the first step."""
        return np.roll(self._truth, -self._end, axis=0)

    @property
    def estimate(self) -> np.ndarray:
        """Estimated positions [T, N, d] in m, oldest first; NaN before the first step."""
        return np.roll(self._estimate, -self._end, axis=0)

    @property
    def rmse(self) -> float:
        """Team RMSE in m over all steps so far; NaN before the first scored one."""
        return float(np.sqrt(self._squares / self._count)) if self._count else float("nan")

    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Steps [M] and the UAVs' errors [M, N] in m at them, the latest step included."""
        steps, errors = self._steps, self._errors
        if self.latest is not None and (not steps or steps[-1] != self.latest.step):
            steps, errors = [*steps, self.latest.step], [*errors, self.latest.error]
        if not steps:
            return np.empty(0), np.empty((0, self._truth.shape[1]))
        return np.array(steps), np.stack(errors)


def rms(errors: np.ndarray) -> np.ndarray:
    """Root mean square over the last axis of what is finite; NaN where nothing is."""
    count = np.isfinite(errors).sum(-1)
    squares = np.nansum(errors**2, -1)
    return np.sqrt(np.where(count, squares, np.nan) / np.maximum(count, 1))
