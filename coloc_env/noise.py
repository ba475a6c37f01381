"""Random numbers as a pure function of (row key, step, stream, index).

A world's noise must not depend on how many worlds share its batch, on how many steps are sensed at
once, or on which other sensors exist. So nothing is ever drawn from a stateful generator: a counter
is hashed (the SplitMix64 finalizer, Steele, Lea & Flood, OOPSLA 2014), once per row, once per step
and once per index, and the hash becomes a uniform or, by Box-Muller, a normal number.

Only elementwise operations whose result does not depend on an element's place in memory are used.
"""

import math
import zlib
from functools import lru_cache

import torch
from jaxtyping import Float, Int64
from torch import Tensor

_GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as a signed 64-bit integer
_MIX_1 = -4658895280553007687  # 0xBF58476D1CE4E5B9
_MIX_2 = -7723592293110705685  # 0x94D049BB133111EB


def mix(z: Int64[Tensor, "*s"]) -> Int64[Tensor, "*s"]:
    """SplitMix64 finalizer: a bijection of 64-bit integers whose outputs look independent.

    torch shifts arithmetically, so the sign bits that a logical shift would clear are masked off.
    """
    z = z ^ (z >> 30).bitwise_and_(0x3FFFFFFFF)
    z.mul_(_MIX_1)
    z.bitwise_xor_((z >> 27).bitwise_and_(0x1FFFFFFFFF))
    z.mul_(_MIX_2)
    return z.bitwise_xor_((z >> 31).bitwise_and_(0x1FFFFFFFF))


def fold(key: Int64[Tensor, "*s"], data: Int64[Tensor, "*s"] | int) -> Int64[Tensor, "*s"]:
    """A new key from ``key`` and an integer (a step, a pair's index, a row's seed)."""
    return mix(key + (data + 1) * _GOLDEN)


def row_keys(seeds: Int64[Tensor, "B"]) -> Int64[Tensor, "B"]:
    """One key per world from its seed."""
    return fold(torch.zeros_like(seeds), seeds)


@lru_cache(maxsize=256)
def _counters(streams: tuple[tuple[str, int], ...], device: torch.device) -> Int64[Tensor, "n"]:
    """The constants of each stream's indices, mixed once: what a key is xored with."""
    parts = []
    for name, count in streams:
        base = torch.tensor(zlib.crc32(name.encode()), device=device, dtype=torch.int64)
        parts.append(fold(base << 20, torch.arange(count, device=device)))
    return torch.cat(parts)


def bits(keys: Int64[Tensor, "*s"], streams: tuple[tuple[str, int], ...]) -> Int64[Tensor, "*s n"]:
    """64 random bits per key and index of every ``(stream, count)``, concatenated."""
    return mix(keys.unsqueeze(-1) ^ _counters(streams, keys.device))


def _unit(word: Int64[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """32-bit integers in [-2^31, 2^31) to float32 in (0, 1): 23 bits, never 0 and never 1."""
    return (word >> 9).to(torch.float32).add_(2**22 + 0.5).mul_(2.0**-23)


def _halves(word: Int64[Tensor, "*s n"]) -> tuple[Tensor, Tensor]:
    """Both signed 32-bit halves of each word."""
    pairs = word.view(torch.int32).unflatten(-1, (-1, 2))
    return pairs[..., 0], pairs[..., 1]


def uniform(keys: Int64[Tensor, "*s"], stream: str, count: int) -> Float[Tensor, "*s n"]:
    """``count`` float32 numbers in (0, 1) per key."""
    return _unit((bits(keys, ((stream, count),)) >> 32).to(torch.int32))


def normal(keys: Int64[Tensor, "*s"], stream: str, count: int) -> Float[Tensor, "*s n"]:
    """``count`` standard normal float32 numbers per key."""
    return normals(keys, ((stream, count),))[stream]


def normals(
    keys: Int64[Tensor, "*s"], streams: tuple[tuple[str, int], ...]
) -> dict[str, Float[Tensor, "*s n"]]:
    """Standard normal float32 numbers for several streams in one pass (Box-Muller, two a hash).

    Within a stream the first half of the numbers are the cosine, the second half the sine branch.
    """
    halves = tuple((name, (count + 1) // 2) for name, count in streams)
    low, high = _halves(bits(keys, halves))
    radius = _unit(low).log_().mul_(-2.0).sqrt_()
    angle = _unit(high).mul_(2.0 * math.pi)
    cosine, sine = angle.cos().mul_(radius), angle.sin_().mul_(radius)
    out, start = {}, 0
    for (name, count), (_, half) in zip(streams, halves, strict=True):
        stop = start + half
        out[name] = torch.cat((cosine[..., start:stop], sine[..., start:stop]), -1)[..., :count]
        start = stop
    return out
