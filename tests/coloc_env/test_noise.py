"""Noise is a pure function of (key, stream, index), and looks like what it claims to be."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from coloc_env import noise

MASK = (1 << 64) - 1
MANY = 200_000


def keys_of(count: int, seed: int = 0) -> torch.Tensor:
    return noise.row_keys(torch.arange(seed, seed + count))


def splitmix(z: int) -> int:
    """The reference: SplitMix64's finalizer on Python integers."""
    z &= MASK
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & MASK
    return z ^ (z >> 31)


@given(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=1, max_size=20))
@settings(max_examples=15, deadline=None)
def test_mix_is_the_splitmix64_finalizer(values: list[int]) -> None:
    mixed = noise.mix(torch.tensor(values)).tolist()
    assert [m & MASK for m in mixed] == [splitmix(v) for v in values]


def test_fold_differs_for_every_integer_and_key() -> None:
    keys = keys_of(100)
    folded = noise.fold(keys.unsqueeze(-1), torch.arange(-50, 50))
    assert len(folded.unique()) == 100 * 100
    assert torch.equal(folded[:, 53], noise.fold(keys, 3))


@pytest.mark.parametrize("draw", [noise.uniform, noise.normal])
@pytest.mark.parametrize("count", [1, 2, 3, 7, 64])
def test_numbers_do_not_depend_on_shape_batch_or_chunk(
    draw: object, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert callable(draw)
    keys = keys_of(37)
    every = draw(keys, "stream", count)
    for row in (0, 13, 36):
        assert torch.equal(draw(keys[row : row + 1], "stream", count)[0], every[row])
    assert torch.equal(draw(keys[:36].view(3, 3, 4), "stream", count).flatten(0, 2), every[:36])
    # The first numbers of a stream are the same however many are drawn.
    assert torch.equal(draw(keys, "stream", count + 5)[:, :count], every)
    monkeypatch.setattr(noise, "_CHUNK", 5)
    assert torch.equal(draw(keys, "stream", count), every)


def test_global_generators_are_neither_read_nor_advanced() -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = noise.normal(keys_of(4), "a", 5)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert torch.equal(noise.normal(keys_of(4), "a", 5), first)


def test_streams_indices_and_keys_are_independent() -> None:
    n = MANY // 10
    columns = [
        noise.normal(keys_of(n), "a", 3),
        noise.normal(keys_of(n), "b", 3),
        noise.normal(noise.fold(keys_of(n), 0), "a", 3),
        noise.normal(noise.fold(keys_of(n), 1), "a", 3),
        noise.normal(keys_of(n, 1), "a", 3),  # neighbouring seeds
        noise.uniform(keys_of(n), "a", 3),
    ]
    together = torch.cat([c.T for c in columns]).double()
    correlation = torch.corrcoef(together)
    # One draw as normal and as uniform is the same bits: the only pairs that may correlate.
    same = torch.eye(len(correlation), dtype=torch.bool)
    for i in range(3):
        same[i, 15 + i] = same[15 + i, i] = True
    assert correlation[~same].abs().max() < 5 / math.sqrt(n)
    # Nor do magnitudes: variances of one do not follow the other.
    squared = torch.corrcoef(together[:15] ** 2)
    assert squared[~torch.eye(15, dtype=torch.bool)].abs().max() < 6 / math.sqrt(n)


def test_normal_is_standard_normal() -> None:
    x = noise.normal(keys_of(1), "n", MANY)[0].double()
    assert abs(float(x.mean())) < 5 / math.sqrt(MANY)
    assert abs(float(x.std()) - 1) < 5 / math.sqrt(2 * MANY)
    assert stats.kstest(x.numpy(), "norm").pvalue > 1e-3
    # Tails: the share beyond 3 σ, within five of its own standard deviations.
    share, tail = 2 * stats.norm.sf(3.0), float((x.abs() > 3).double().mean())
    assert abs(tail - share) < 5 * math.sqrt(share / MANY)
    assert 4.2 < float(x.abs().max()) < 5.5


def test_uniform_is_uniform_and_strictly_inside() -> None:
    x = noise.uniform(keys_of(1), "u", MANY)[0].double()
    assert float(x.min()) > 0.0
    assert float(x.max()) < 1.0
    assert stats.kstest(x.numpy(), "uniform").pvalue > 1e-3
    counts = torch.histc(x, 64, 0.0, 1.0)
    assert stats.chisquare(counts.numpy()).pvalue > 1e-3


def test_uniform_keeps_off_the_ends_at_its_extreme_bits() -> None:
    bits = torch.tensor([[-(2**31), 2**31 - 1, 0, -1]], dtype=torch.int32)
    out = torch.empty(1, 4)
    noise._write_uniform(bits.clone(), out)
    assert 0.0 < float(out.min()) < 1e-6
    assert 1 - 1e-6 < float(out.max()) < 1.0
    noise._write_normal(bits.clone(), out)
    assert out.isfinite().all()
    assert float(out.abs().max()) < 5.5
