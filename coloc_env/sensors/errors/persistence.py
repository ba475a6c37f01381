"""Random numbers that last: redrawn now and then and kept in between, or drifting."""

import math

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from coloc_env import noise

_MEMORY = 10.0  # correlation times looked back
_KNOTS = 64  # steps between the knots of a Gauss–Markov process


def held_uniform(
    rows: Int64[Tensor, "R"],
    first: Int64[Tensor, "R"],
    count: int,
    links: Int64[Tensor, "*l"],
    stream: str,
    time: float,
) -> Float32[Tensor, "R K *l"]:
    """Numbers in (0, 1) of numbered links, in ``count`` steps from each row's ``first`` on.

    In each step a link's number is redrawn with probability 1 − exp(−1/``time``), else kept: a
    Markov chain whose correlation falls by e in ``time`` steps. It is a pure function of row, step
    and link all the same: the number is that of the last renewal, looked for in the last
    10 ``time`` steps, else the link's very first. (That of an earlier renewal would be forgotten
    with probability e⁻¹⁰.)
    """
    back, renewal = math.ceil(_MEMORY * time), -math.expm1(-1 / time)
    numbers = links.flatten()

    def draw(
        at: Int64[Tensor, "*#m"], keys: Int64[Tensor, "*#m"], link: Int64[Tensor, "*#m"]
    ) -> tuple[Float32[Tensor, "*m"], Bool[Tensor, "*m"]]:
        """What would be drawn at a step, and whether it is."""
        drawn, chance = noise.uniform(noise.fold(keys, link), f"{stream}.renewal", 2).unbind(-1)
        return drawn, (chance < renewal) & (at > 0)

    every = noise.fold(rows.unsqueeze(-1), numbers)
    very_first = noise.uniform(every, f"{stream}.first", 1)[..., 0]
    value, age = very_first.clone(), torch.full_like(every, back + 1)
    row, link = torch.ones_like(every).nonzero().unbind(-1)
    for ago in range(back + 1):  # back to the last renewal, for links where it is yet to be found
        if not len(row):
            break
        at = first - ago
        drawn, renewed = draw(at[row], noise.fold(rows, at)[row], numbers[link])
        found = renewed.nonzero()[:, 0]
        value[row[found], link[found]] = drawn[found]
        age[row[found], link[found]] = ago
        left = (~renewed & (at > 1)[row]).nonzero()[:, 0]
        row, link = row[left], link[left]
    held = [value]
    for step in range(1, count):
        at = (first + step).unsqueeze(-1)
        drawn, renewed = draw(at, noise.fold(rows.unsqueeze(-1), at), numbers)
        value = torch.where(renewed, drawn, value)
        age = torch.where(renewed, 0, age + 1)
        held.append(torch.where(age <= back, value, very_first))
    return torch.stack(held, 1).unflatten(-1, links.shape)


def gauss_markov(
    rows: Int64[Tensor, "R"],
    first: Int64[Tensor, "R"],
    count: int,
    links: Int64[Tensor, "*l"],
    stream: str,
    time: float,
) -> Float32[Tensor, "R K *l"]:
    """Standard normal numbers of numbered links, in ``count`` steps from each row's ``first`` on:
    the stationary Gauss–Markov process x ← φ x + √(1 − φ²) e with φ = exp(−1/``time``).

    A pure function of row, step (step 0 before it) and link: the process at every 64th step, which
    is one of its kind itself, and between two such knots a path from the first that is bent to meet
    the second (conditional simulation, Chilès & Delfiner, Geostatistics, 2012, section 7.3):
    b_k = x_k + r_k (c′ − x_C), r_k = Cov(x_k, x_C) / Var(x_C) = φ^(C−k) (1 − φ^2k) / (1 − φ^2C).
    """
    numbers, phi, size = links.flatten(), math.exp(-1 / time), _KNOTS
    start = first.clamp_min(0).div(size, rounding_mode="floor")
    blocks = (size + count - 2) // size + 1
    keys = noise.fold(rows.unsqueeze(-1), numbers).unsqueeze(1)  # [R, 1, L]
    every = torch.arange(int(start.max()) + blocks + 1, device=rows.device).unsqueeze(-1)
    fresh = noise.normal(noise.fold(keys, every), f"{stream}.knot", 1)[..., 0]  # [R, M, L]
    knots, kept = [fresh[:, 0]], phi**size
    for drawn in fresh.unbind(1)[1:]:
        knots.append(kept * knots[-1] + math.sqrt(1 - kept**2) * drawn)
    knot = torch.stack(knots, 1)
    which = start.unsqueeze(-1) + torch.arange(blocks, device=rows.device)  # [R, blocks]
    row = torch.arange(len(rows), device=rows.device).unsqueeze(-1)
    left, right = knot[row, which], knot[row, which + 1]
    white = noise.normal(noise.fold(keys, which.unsqueeze(-1)), f"{stream}.path", size)
    path = [left]
    for drawn in white.unbind(-1):
        path.append(phi * path[-1] + math.sqrt(1 - phi**2) * drawn)
    short = right - path[-1]
    back = math.expm1(-2 * size / time)
    share = [phi ** (size - k) * math.expm1(-2 * k / time) / back for k in range(size)]  # r_k
    short = right - path[-1]
    bent = [x + r * short for x, r in zip(path[:-1], share, strict=True)]
    whole = torch.stack(bent, 2).flatten(1, 2)  # [R, blocks · 64, L]
    steps = first.unsqueeze(-1) + torch.arange(count, device=rows.device)
    at = steps.clamp_min(0) - size * start.unsqueeze(-1)
    return whole[row, at].unflatten(-1, links.shape)
