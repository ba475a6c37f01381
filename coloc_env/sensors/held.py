"""Random numbers that last: drawn anew now and then, and kept in between."""

import math

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from coloc_env import noise

_MEMORY = 10.0  # correlation times looked back


def held_uniform(
    rows: Int64[Tensor, "R"],
    first: Int64[Tensor, "R"],
    count: int,
    links: Int64[Tensor, "*l"],
    stream: str,
    time: float,
) -> Float32[Tensor, "R K *l"]:
    """Numbers in (0, 1) of numbered links, in ``count`` steps from each row's ``first`` on.

    In each step a link's number is drawn anew with probability 1 − exp(−1/``time``), else kept: a
    Markov chain whose correlation falls by e in ``time`` steps. It is a pure function of row, step
    and link all the same: the number is that of the last renewal, looked for in the last
    10 ``time`` steps, else the link's very first. (That of an earlier renewal would be forgotten
    with probability e⁻¹⁰.)
    """
    back = math.ceil(_MEMORY * time)
    renewal = -math.expm1(-1 / time)
    shape = (len(rows), *links.shape)
    start = noise.uniform(noise.fold(_wide(rows, shape), links), f"{stream}.first", 1)[..., 0]
    value, age = start, torch.full(shape, back + 1, device=rows.device)
    held = []
    for step in range(min(0, max(-back, 1 - int(first.max()))), count):
        at = first + step
        keys = noise.fold(_wide(noise.fold(rows, at), shape), links)
        drawn, chance = noise.uniform(keys, f"{stream}.renewal", 2).unbind(-1)
        renewed = (chance < renewal) & (_wide(at, shape) > 0)
        value = torch.where(renewed, drawn, value)
        age = torch.where(renewed, 0, age + 1)
        if step >= 0:
            held.append(torch.where(age <= back, value, start))
    return torch.stack(held, 1)


def _wide(x: Int64[Tensor, "R"], shape: tuple[int, ...]) -> Int64[Tensor, "R *l"]:
    """One number a row, ready to meet those of the links."""
    return x.view(-1, *[1] * (len(shape) - 1))
