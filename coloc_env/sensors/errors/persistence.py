"""Random numbers that last: redrawn now and then, and kept in between."""

import math

import torch
from jaxtyping import Bool, Float32, Int64
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
