"""Random numbers as a pure function of (row key, step, stream, index).

A world's noise must not depend on how many worlds share its batch, on how many steps are sensed at
once, or on which other sensors exist. So nothing is ever drawn from a stateful generator: a counter
is hashed (the SplitMix64 finalizer, Steele, Lea & Flood, OOPSLA 2014), once per row, once per step
and once per index, and the hash becomes a uniform or a normal number.

Only elementwise operations whose result does not depend on an element's place in memory are used.
"""

import math
import zlib
from collections.abc import Callable
from functools import lru_cache

import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

_GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as a signed 64-bit integer
_ROUNDS = (  # shift, mask of the bits a logical shift keeps, odd factor
    (30, 0x3FFFFFFFF, -4658895280553007687),  # 0xBF58476D1CE4E5B9
    (27, 0x1FFFFFFFFF, -7723592293110705685),  # 0x94D049BB133111EB
    (31, 0x1FFFFFFFF, 0),
)
_CHUNK = 65536  # 64-bit words hashed at once on a CPU: what stays in cache


def mix(z: Int64[Tensor, "*s"]) -> Int64[Tensor, "*s"]:
    """SplitMix64 finalizer: a bijection of 64-bit integers whose outputs look independent."""
    return _mix_(z.clone(), torch.empty_like(z))


def _mix_(z: Int64[Tensor, "*s"], shifted: Int64[Tensor, "*s"]) -> Int64[Tensor, "*s"]:
    """``mix`` in place, with a scratch tensor of the same shape.

    torch shifts arithmetically, so the sign bits that a logical shift would clear are masked off.
    """
    for bits, mask, factor in _ROUNDS:
        torch.bitwise_right_shift(z, bits, out=shifted)
        z.bitwise_xor_(shifted.bitwise_and_(mask))
        if factor:
            z.mul_(factor)
    return z


def fold(key: Int64[Tensor, "*s"], data: Int64[Tensor, "*s"] | int) -> Int64[Tensor, "*s"]:
    """A new key from ``key`` and an integer (a step, a pair's index, a row's seed)."""
    if isinstance(data, int):
        data = torch.tensor(data, device=key.device)
    return mix(key + (data + 1) * _GOLDEN)


def row_keys(seeds: Int64[Tensor, "B"]) -> Int64[Tensor, "B"]:
    """One key per world from its seed."""
    return fold(torch.zeros_like(seeds), seeds)


@lru_cache(maxsize=256)
def _counters(stream: str, count: int, device: torch.device) -> Int64[Tensor, "n"]:
    """The constants of a stream's indices, mixed once: what a key is xored with."""
    base = torch.tensor(zlib.crc32(stream.encode()) << 20, device=device)
    return fold(base, torch.arange(count, device=device))


def _random(
    keys: Int64[Tensor, "*s"],
    stream: str,
    count: int,
    write: Callable[[Int32[Tensor, "r n"], Float32[Tensor, "r n"]], None],
) -> Float32[Tensor, "*s n"]:
    """``count`` numbers per key: ``write`` turns random 32-bit integers into floats, in place."""
    words = (count + 1) // 2
    counters, flat = _counters(stream, words, keys.device), keys.reshape(-1, 1)
    out = torch.empty(len(flat), count, dtype=torch.float32, device=keys.device)
    rows = max(1, _CHUNK // words) if keys.device.type == "cpu" else max(1, len(flat))
    for start in range(0, len(flat), rows):
        bits = flat[start : start + rows] ^ counters
        _mix_(bits, torch.empty_like(bits))
        write(bits.view(torch.int32)[:, :count], out[start : start + rows])
    return out.view(*keys.shape, count)


def _write_uniform(bits: Int32[Tensor, "r n"], out: Float32[Tensor, "r n"]) -> None:
    """(b + ½) / 2²³ for 23-bit integers b: every value exact, never 0 and never 1."""
    out.copy_(bits.bitwise_right_shift_(9)).add_(0.5).mul_(2.0**-23).add_(0.5)


def _write_normal(bits: Int32[Tensor, "r n"], out: Float32[Tensor, "r n"]) -> None:
    """Inverse distribution function: √2 erf⁻¹(u) of 24-bit u in (−1, 1); at most 5.4 σ."""
    out.copy_(bits.bitwise_right_shift_(8)).add_(0.5).mul_(2.0**-23)
    out.erfinv_().mul_(math.sqrt(2.0))


def uniform(keys: Int64[Tensor, "*s"], stream: str, count: int) -> Float32[Tensor, "*s n"]:
    """``count`` float32 numbers in (0, 1) per key."""
    return _random(keys, stream, count, _write_uniform)


def unit(keys: Int64[Tensor, "*s"]) -> Float32[Tensor, "*s"]:
    """One float32 number in (0, 1) per key, from the key's own bits."""
    bits = (keys >> 41) & 0x7FFFFF
    return (bits.to(torch.float32) + 0.5) * 2.0**-23


def normal(keys: Int64[Tensor, "*s"], stream: str, count: int) -> Float32[Tensor, "*s n"]:
    """``count`` standard normal float32 numbers per key."""
    return _random(keys, stream, count, _write_normal)
