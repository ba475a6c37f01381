"""Wind gusts of Dryden's spectrum, which push UAVs off the paths that they hold to."""

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float64, Int64
from numpy.typing import NDArray
from torch import Tensor

from coloc_env import noise
from coloc_env.motion.base import Arena, Carry, Kinematics, Motion
from coloc_env.motion.draws import constant, fold_each, uav_keys
from coloc_env.motion.fit import positive
from coloc_env.options import Acceleration, Group, PositiveSeconds

_STATES = 4  # of an axis: two of the gust, displacement and its rate


@dataclass(frozen=True)
class Gusts(Motion):
    """A motion whose UAVs are pushed by an acceleration w of the wind, and steer back to their path
    p as a position controller does: they are at p + x with

        ẍ = w − 2 ζ ω ẋ − ω² x,    ω = ``stiffness`` rad/s,    ζ = ``damping``.

    w has standard deviation ``std`` m/s² per axis and the spectra of Dryden's turbulence model
    (MIL-F-8785C, section 3.7.2), with τ = ``time`` for its L / V: along the world's x axis
    σ √(2τ) / (1 + τ s), along the others σ √τ (1 + √3 τ s) / (1 + τ s)², driven by white noise of
    unit density. Every UAV has its own. Each step is exact (Van Loan, IEEE Trans. Automatic Control
    23(3), 1978), and step 0 is of the stationary process. The attitude stays that of the path.

    With the defaults UAVs are 6 cm off along each axis (standard deviation). Nothing keeps them in
    the arena under gusts that are many times as strong.
    """

    motion: Motion
    std: float = 0.3  # m/s²
    time: float = 1.0  # s
    stiffness: float = 2.0  # rad/s
    damping: float = 0.7

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "std", "time", "stiffness", "damping")
        own = uav_keys(keys, arena.n_uavs)
        white = noise.normal(own, "motion.gust.start", arena.dim * _STATES).double()
        _, _, roots = self._tables(arena, keys.device)
        state = _times(roots, white.unflatten(-1, (arena.dim, _STATES)))
        return self.motion.start(keys, arena) | {"gust": state, "gust_keys": own}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        gust = {name: carry[name] for name in ("gust", "gust_keys")}
        path, carry = self.motion.advance(
            {name: value for name, value in carry.items() if name not in gust}, steps, arena
        )
        onward, driven, _ = self._tables(arena, steps.device)
        keys = fold_each(gust["gust_keys"], steps.unsqueeze(-1))
        white = noise.normal(keys, "motion.gust", arena.dim * _STATES).double()
        pushes = _times(driven, white.unflatten(-1, (arena.dim, _STATES)))
        state, states = gust["gust"], []
        for push in pushes.unbind(1):  # the state at a step, then what the step ahead brings
            states.append(state)
            state = _times(onward, state) + push
        away = torch.stack(states, 1)
        blown = Kinematics(
            path.position + away[..., 2],
            path.velocity + away[..., 3],
            path.attitude,
            path.valid,
            path.carried,
        )
        return blown, carry | {"gust": state, "gust_keys": gust["gust_keys"]}

    def _tables(self, arena: Arena, device: torch.device) -> tuple[Float64[Tensor, "d s s"], ...]:
        """Of each axis: transition of a step, root of its noise's covariance, and root of the
        stationary covariance."""
        axes = [
            _discrete(self.std, self.time, self.stiffness, self.damping, axis == 0, arena.dt)
            for axis in range(arena.dim)
        ]
        onward, driven, start = (constant(rows, device) for rows in zip(*axes, strict=True))
        return onward, driven, start


@dataclass(frozen=True)
class GustOptions(Group):
    """Gusts of wind push UAVs with an acceleration of ``gust_std`` per axis that lasts about
    ``gust_time`` (Dryden's spectra); they steer back to their path, and their IMU measures both."""

    title: ClassVar[str] = "wind"

    gust_std: Acceleration = 0.0
    gust_time: PositiveSeconds = 1.0

    def of(self, motion: Motion) -> Motion:
        """The motion, in this wind."""
        return Gusts(motion, self.gust_std, self.gust_time) if self.gust_std else motion


def model(
    std: float, time: float, stiffness: float, damping: float, along: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """An axis in continuous time: ṡ = F s + G e with e white of unit density, and the row that
    gives w; s holds two states of the gust, x and ẋ.

    (1 + τ s)² w = σ √τ (1 + √3 τ s) e in observer form, with states w and b = ẇ + 2 w/τ − g₁ e
    where g₁ = σ √(3/τ): ẇ = −2 w/τ + b + g₁ e, ḃ = −w/τ² + σ τ^(−3/2) e.
    """
    f, g = np.zeros((_STATES, _STATES)), np.zeros((_STATES, 1))
    if along:
        f[0, 0], g[0, 0] = -1 / time, std * np.sqrt(2 / time)
        f[1, 1] = -1 / time  # idle
    else:
        f[0, :2], f[1, 0] = (-2 / time, 1.0), -1 / time**2
        g[:2, 0] = std * np.sqrt(3 / time), std * time**-1.5
    f[2, 3] = 1.0
    f[3] = (1.0, 0.0, -(stiffness**2), -2 * damping * stiffness)
    return f, g, np.eye(1, _STATES)


@lru_cache(maxsize=64)
def _discrete(
    std: float, time: float, stiffness: float, damping: float, along: bool, dt: float
) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """Transition over a step, and roots of the covariances of its noise and of the stationary
    process."""
    from scipy.linalg import expm, solve_continuous_lyapunov

    f, g, _ = model(std, time, stiffness, damping, along)
    block = np.block([[-f, g @ g.T], [np.zeros_like(f), f.T]]) * dt
    grown = expm(block)
    onward = grown[_STATES:, _STATES:].T
    noisy = onward @ grown[:_STATES, _STATES:]
    stationary = solve_continuous_lyapunov(f, -g @ g.T)
    found = (onward, _root(noisy), _root(stationary))
    return tuple(tuple(map(tuple, matrix.tolist())) for matrix in found)


def _root(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """A square root of a covariance that may be singular."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _times(
    matrix: Float64[Tensor, "d s s"], vector: Float64[Tensor, "*b d s"]
) -> Float64[Tensor, "*b d s"]:
    """Each axis' matrix times its vector, summed in a fixed order, whatever the batch's shape."""
    total = matrix[..., 0] * vector[..., :1]
    for column in range(1, matrix.shape[-1]):
        total = total + matrix[..., column] * vector[..., column : column + 1]
    return total
