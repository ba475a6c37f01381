"""A broad prior as a sum of narrow Gaussians: where a bank of Kalman filters starts from."""

import math

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.process import Process
from coloc_env.scenario import Believed
from coloc_env.sensors import UnlabelledLandmarks

_TURN = 0.3  # rad, of the attitude: beyond, one linearization does not serve all headings
_EACH = 16  # starts along one direction, at most


def split(
    believed: Believed,
    process: Process,
    x: Float64[Tensor, "B N S"],
    covariance: Float64[Tensor, "B N E E"],
    count: int,
) -> tuple[Float64[Tensor, "B N K S"], Float64[Tensor, "B N K E E"]]:
    """Up to ``count`` starts, equally likely, with the prior's moments as a whole: horizontal
    places where the prior is uniform or nothing says which landmark is seen, and headings where
    they are not known to 0.3 rad.

    Along each direction of standard deviation σ starts are at t σ, t from a low-discrepancy
    sequence (the generalized golden ratio), each with σ_k = s σ, s = K^(−1/D) for K starts in D
    directions (Gaussian sum approximation, Alspach & Sorenson 1972).
    """
    prior = believed.prior
    uniform, e = prior.kind == "uniform", process.attitude_error
    place = uniform or believed.sensor(UnlabelledLandmarks) is not None
    turn = e is not None and (process.any_yaw or prior.attitude_std > _TURN)
    ways = [*(_axes(x, process)[:2] if place else []), *([_vertical(x, process)] if turn else [])]
    flat = [*([uniform] * 2 if place else []), *([process.any_yaw] if turn else [])]
    k = min(count, _EACH ** len(ways))
    if k <= max(1, len(ways)):  # too few to say anything about every direction
        return x.unsqueeze(2), covariance.unsqueeze(2)
    share = k ** (-1 / len(ways))
    p = covariance
    delta = torch.zeros(*x.shape[:2], k, process.error_size, dtype=x.dtype, device=x.device)
    spread = _standardized(_spread(k, flat)).T.to(x.device) * math.sqrt(1 - share**2)
    for way, at in zip(ways, spread, strict=True):
        inside = ((covariance * way.unsqueeze(-2)).sum(-1) * way).sum(-1, keepdim=True)  # σ²
        delta = delta + (at * inside.sqrt()).unsqueeze(-1) * way.unsqueeze(2)
        less = (1 - share**2) * inside.unsqueeze(-1)
        p = p - less * way.unsqueeze(-1) * way.unsqueeze(-2)
    states = process.boxplus(x.unsqueeze(2).expand(-1, -1, k, -1), delta)
    return states, p.unsqueeze(2).expand(-1, -1, k, -1, -1)


def _axes(x: Float64[Tensor, "B N S"], process: Process) -> list[Float64[Tensor, "B N E"]]:
    """The position's directions in the error."""
    eye = torch.eye(process.error_size, dtype=x.dtype, device=x.device)[: process.dim]
    return [way.expand(*x.shape[:2], -1) for way in eye]


def _vertical(x: Float64[Tensor, "B N S"], process: Process) -> Float64[Tensor, "B N E"]:
    """The direction of a turn about the world's vertical, as the body sees it."""
    way = torch.zeros(*x.shape[:2], process.error_size, dtype=x.dtype, device=x.device)
    rotation = process.rotation(x)
    assert rotation is not None
    way[..., process.attitude_error] = rotation[..., -1, :] if process.dim == 3 else 1.0
    return way


def _spread(count: int, even: list[bool]) -> Float64[Tensor, "K D"]:
    """Points that fill space evenly, or as a normal distribution does: the fractions of
    ½ + k (1/φ, 1/φ², …), φ being the positive root of φ^(D+1) = φ + 1, and their quantiles."""
    phi, size = 2.0, len(even)
    for _ in range(60):
        phi = (1 + phi) ** (1 / (size + 1))
    steps = torch.arange(count, dtype=torch.float64).unsqueeze(-1)
    by = torch.tensor([phi ** -(i + 1) for i in range(size)], dtype=torch.float64)
    unit = (0.5 + steps * by) % 1.0
    return torch.where(torch.tensor(even), unit, torch.erfinv(2 * unit - 1))


def _standardized(t: Float64[Tensor, "K D"]) -> Float64[Tensor, "K D"]:
    """The points with mean 0 and covariance I."""
    t = t - t.mean(0)
    root = torch.linalg.cholesky(t.T @ t / len(t))
    return torch.linalg.solve_triangular(root, t.T, upper=False).T
