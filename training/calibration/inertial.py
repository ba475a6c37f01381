"""IMUs: noise by Allan variance where they stand still, biases and noise against truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coloc_env.datasets.noise_model import ImuBias, ImuModel
from coloc_env.datasets.recording import Floats, Recording, Stamps, Table, Track
from coloc_env.datasets.residuals import pose_at, turned

_DT = 0.1  # s, of the steps whose noise is estimated
_STILL = 2.0  # s: shorter than this nothing is learnt from standing
_QUIET = (0.02, 0.15)  # rad/s, m/s²: a second with less spread than this is one of standing still
_G = 9.80665
_TILT = np.radians(3.0)  # of an IMU in its body, before anything is measured
_BASE = 0.5  # s, of the shortest increments that are compared with truth,
_WINDOWS = (2, 6, 12)  # of these are the windows over which errors are watched grow


@dataclass(frozen=True)
class Allan:
    """Allan deviations [M, 6] at averaging times [M] (s): of gyro (rad/s), accelerometer (m/s²).

    ``white``: noise density per √Hz [6], ``instability``: the least deviation over 0.664 [6].
    """

    tau: Floats
    deviation: Floats

    @property
    def white(self) -> Floats:
        """N = σ(τ) √τ where averaging helps: at the shortest times."""
        short: Floats = np.median(self.deviation[:3] * np.sqrt(self.tau[:3, None]), axis=0)
        return short

    @property
    def instability(self) -> Floats:
        least: Floats = self.deviation.min(0) / 0.664
        return least


def allan(values: Floats, rate: float) -> Allan:
    """Overlapping Allan deviation of samples [T, 6] at ``rate`` Hz, at times up to a fifth of all.

    σ²(τ) = ⟨(θ_{k+2m} − 2 θ_{k+m} + θ_k)²⟩ / (2 τ²), θ the integral (IEEE Std 952-1997, annex C).
    """
    theta = np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(values, 0))) / rate
    most = max(2, len(values) // 5)
    sizes = np.unique(np.logspace(0, np.log10(most), 24).astype(int))
    deviation = []
    for m in sizes:
        bend = theta[2 * m :] - 2 * theta[m:-m] + theta[: -2 * m]
        tau = m / rate
        deviation.append(np.sqrt((bend**2).mean(0) / (2 * tau**2)))
    return Allan(sizes / rate, np.stack(deviation))


def standing(table: Table) -> tuple[int, int] | None:
    """First and last index of the longest stretch in which an IMU stands still; None if there is
    none of 2 s."""
    if len(table.time) < 100:
        return None
    second = ((table.time - table.time[0]) // 10**9).astype(np.int64)
    starts = np.searchsorted(second, np.arange(second[-1] + 2))
    quiet = []
    for a, b in pairwise(starts):
        part = table.values[a:b]
        calm = len(part) > 5 and part[:, :3].std(0).max() < _QUIET[0]
        quiet.append(calm and part[:, 3:].std(0).max() < _QUIET[1])
    best, length, run = None, 0, 0
    for i, calm in enumerate([*quiet, False]):
        run = run + 1 if calm else 0
        if run > length:
            best, length = (int(starts[i + 1 - run]), int(starts[i + 1])), run
    return best if length >= _STILL else None


def allan_of(table: Table) -> Allan | None:
    """Of the longest stretch that an IMU stands still."""
    found = standing(table)
    if found is None:
        return None
    first, last = found
    rate = (last - first - 1) / ((table.time[last - 1] - table.time[first]) * 1e-9)
    return allan(table.values[first:last], float(rate))


def calibrate_imu(recording: Recording) -> ImuModel | None:
    """The team's IMUs: each one's biases and the noise of all, against truth where there is any,
    else from standing still."""
    biases: dict[str, ImuBias] = {}
    gyro_noise, accel_noise, left = [], [], []
    for robot, name in enumerate(recording.robots):
        table, track = recording.streams["imu"][robot], recording.truth[robot]
        if len(track.time) > 1 and recording.dim == 3:
            found = _against_truth(table, track)
            if found is None:
                continue
            biases[name] = found.bias
            gyro_noise.append(found.gyro)
            accel_noise.append(found.accel)
            left.append(found.left)
        else:
            still = standing(table)
            density = allan_of(table)
            if still is None or density is None:
                continue
            mean = table.values[still[0] : still[1], :3].mean(0)
            biases[name] = ImuBias(gyro=tuple(mean.tolist()))
            gyro_noise.append(float(density.white[:3].mean()) / _DT**0.5)
            accel_noise.append(float(density.white[3:].mean()) / _DT**0.5)
    if not biases:
        return None
    defaults = ImuModel()
    gyro_left = root([each[0] for each in left]) if left else defaults.gyro_bias
    accel_left = root([each[1] for each in left]) if left else defaults.accel_bias
    return ImuModel(
        accel_std=root(accel_noise),
        gyro_std=root(gyro_noise),
        accel_bias=max(accel_left, defaults.accel_bias),
        gyro_bias=max(gyro_left, defaults.gyro_bias),
        robots=biases,
    )


def root(values: Sequence[float]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


# ------------------------------------------------------------------ against truth


@dataclass(frozen=True)
class _Found:
    bias: ImuBias
    gyro: float
    accel: float
    left: tuple[float, float]


def _against_truth(table: Table, track: Track) -> _Found | None:
    """Biases by least squares on increments of attitude and velocity, and the noise that is left:
    Var(τ) = c² + σ² dt τ, c the truth's own error, which does not add up."""
    start, end = max(table.time[0], track.time[0]), min(table.time[-1], track.time[-1])
    if (end - start) * 1e-9 < 2 * _BASE * max(_WINDOWS):
        return None
    edges = np.arange(start + 10**8, end - 10**8, round(_BASE * 1e9))
    aligned, axes = _aligned(table, track, edges)
    parts = [_increments(aligned, track, edges, size) for size in _WINDOWS]
    if any(len(turn) < 4 for turn, _ in parts):
        return None
    spans = [size * _BASE for size in _WINDOWS]
    biases, noises, left = [], [], []
    for which in (0, 1):
        rate = parts[0][which] / spans[0]
        bias, half = np.median(rate, 0), len(rate) // 2
        early, late = np.median(rate[:half], 0), np.median(rate[half:], 0)
        variance = [
            float(np.median((part[which] - bias * span) ** 2) / 0.4549)
            for part, span in zip(parts, spans, strict=True)
        ]
        slope = float(np.polyfit(spans, variance, 1)[0])
        biases.append(tuple((axes @ bias).tolist()))
        noises.append(float(np.sqrt(max(slope, 0.02 * variance[0] / spans[0]) / _DT)))
        left.append(float(np.abs(early - late).mean() / 2))
    turn = tuple(Rotation.from_matrix(axes).as_rotvec().tolist())
    return _Found(ImuBias(biases[0], biases[1], turn), noises[0], noises[1], (left[0], left[1]))


def _aligned(table: Table, track: Track, edges: Stamps) -> tuple[Table, Floats]:
    """The samples in the axes of the truth's body, and the rotation from those to the IMU's.

    Turns that are read are θ × ω beside those that are true: least squares on increments, with a
    bias, θ being 3° at most or so before anything is measured.
    """
    step = np.diff(table.time, append=table.time[-1:]) * 1e-9
    read = _turns(table, np.searchsorted(table.time, edges), step).as_rotvec()
    _, pose, there = pose_at(track, edges)
    pose_of = _rotation(pose)
    true = (pose_of[:-1].inv() * pose_of[1:]).as_rotvec()
    sound = there[:-1] & there[1:]
    read, true = read[sound], true[sound]
    # θ × ω = −[ω]× θ
    x, y, z = true.T
    zero = np.zeros_like(x)
    cross = np.stack((zero, z, -y, -z, zero, x, y, -x, zero), 1).reshape(-1, 3)
    rows = np.hstack((cross, np.tile(np.eye(3), (len(true), 1))))
    off = (read - true).ravel()
    noise = max(1.4826 * float(np.median(np.abs(off))), 1e-5)
    prior = np.diag([noise / _TILT] * 3 + [0.0] * 3)
    whole = np.vstack((rows, prior))
    found = np.linalg.lstsq(whole, np.append(off, np.zeros(6)), rcond=None)[0]
    axes: Floats = Rotation.from_rotvec(found[:3]).as_matrix()
    turned_back = np.hstack((table.values[:, :3] @ axes, table.values[:, 3:] @ axes))
    return Table(table.time, turned_back, table.columns), axes


def _increments(table: Table, track: Track, edges: Stamps, size: int) -> tuple[Floats, Floats]:
    """What is read less what is true over overlapping windows of ``size`` edges: turn (rad) and
    speed gained (m/s) in the body frame at the start, [T, 3] each."""
    _, attitude, known = pose_at(track, table.time)
    _, pose, there = pose_at(track, edges)
    velocity = _velocity(track, edges)
    step = np.diff(table.time, append=table.time[-1:]) * 1e-9
    force = turned(attitude, table.values[:, 3:]) * step[:, None]
    total = np.concatenate((np.zeros((1, 3)), np.cumsum(force, 0)))
    at = np.searchsorted(table.time, edges)
    lasted = (edges[size:] - edges[:-size]) * 1e-9
    gained = total[at[size:]] - total[at[:-size]]
    true = velocity[size:] - velocity[:-size] + np.array((0.0, 0.0, _G)) * lasted[:, None]
    speed = turned(pose[:-size] * (1, -1, -1, -1), gained - true)
    first, last = _rotation(pose[:-size]), _rotation(pose[size:])
    pieces = _turns(table, at, step)
    whole = pieces[: len(first)]
    for i in range(1, size):
        whole = whole * pieces[i : i + len(first)]
    turn = ((first.inv() * last).inv() * whole).as_rotvec()
    back = ((first.inv() * last) ** 0.5).inv()  # to the frame in the middle, where biases are meant
    turn, speed = back.inv().apply(turn), back.apply(speed)
    sound = there[:-size] & there[size:] & known[at[:-size].clip(max=len(known) - 1)]
    return turn[sound], speed[sound]


def _velocity(track: Track, at: Stamps) -> Floats:
    """Velocities by the truth's positions 0.1 s around."""
    ahead, behind = (pose_at(track, at + by)[0] for by in (50_000_000, -50_000_000))
    return (ahead - behind) / 0.1


def _turns(table: Table, at: np.ndarray, step: Floats) -> Any:
    """Rotations between neighbouring samples ``at``, by the gyro."""
    found = []
    for a, b in pairwise(at):
        whole = Rotation.identity()
        for piece in Rotation.from_rotvec(table.values[a:b, :3] * step[a:b, None]):
            whole = whole * piece
        found.append(whole.as_quat())
    return Rotation.from_quat(np.array(found))


def _rotation(attitude: Floats) -> Any:
    """Attitudes [T, 4] wxyz as scipy has them."""
    return Rotation.from_quat(np.roll(attitude, -1, 1))
