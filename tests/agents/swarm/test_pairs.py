"""Links as lists of pairs: sums, matrices and components agree with those of N × N matrices."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, laplacian
from torch import Tensor

from agents.swarm.links import along_links, connected, lengths
from agents.swarm.pairs import BLOCK, Pairs, pairs_of


def network(seed: int, n: int, share: float) -> tuple[Tensor, Pairs, torch.Generator]:
    """Three worlds with a ``share`` of all links, none of them in the last."""
    generator = torch.Generator().manual_seed(seed)
    mask = torch.rand(3, n, n, generator=generator).triu(1) > 1 - share
    mask[2] = False
    mask = mask | mask.mT
    return mask, pairs_of(mask), generator


@given(st.integers(0, 1000), st.integers(1, 20), st.floats(0.0, 1.0))
@settings(max_examples=20, deadline=None)
def test_lists_and_matrices_say_the_same(seed: int, n: int, share: float) -> None:
    mask, pairs, generator = network(seed, n, share)
    assert pairs.there.shape[1] % BLOCK == 0
    assert torch.equal(pairs.there.sum(-1), mask.triu(1).sum((-2, -1)))
    x = torch.randn(3, n, n, generator=generator, dtype=torch.float64) * mask
    one = pairs.of(x) * pairs.there, pairs.of(x.mT) * pairs.there
    directed = torch.stack(one, 1)
    assert torch.equal(pairs.matrix(directed), x)
    assert torch.allclose(pairs.sums(directed), x.sum(-1))
    alike = x + x.mT
    assert torch.allclose(pairs.sums(sum(one).unsqueeze(1)), alike.sum(-1))
    before = torch.randn(3, n, n, generator=generator, dtype=torch.float64)
    assert torch.equal(pairs.put(before, sum(one)), torch.where(mask, alike, before))
    most = pairs.largest(directed.masked_fill(~pairs.there.unsqueeze(1), -torch.inf))
    assert torch.equal(most, x.masked_fill(~mask, -torch.inf).amax(-1))


@given(st.integers(0, 1000), st.integers(2, 20), st.floats(0.0, 1.0))
@settings(max_examples=20, deadline=None)
def test_forces_along_links(seed: int, n: int, share: float) -> None:
    mask, pairs, generator = network(seed, n, share)
    y = 100 * torch.randn(3, n, 3, generator=generator, dtype=torch.float64)
    unit, length = pairs.units(y)
    assert torch.allclose(length[pairs.there], pairs.of(lengths(y))[pairs.there], rtol=1e-14)
    strength = torch.randn(3, n, n, generator=generator, dtype=torch.float64) * mask
    directed = torch.stack((pairs.of(strength), pairs.of(strength.mT)), 1)
    expected = along_links(y, strength, lengths(y))
    assert torch.allclose(pairs.along(directed * pairs.there.unsqueeze(1), unit), expected)


@given(st.integers(0, 1000), st.integers(2, 20), st.floats(0.0, 1.0))
@settings(max_examples=20, deadline=None)
def test_laplacians_are_scipys(seed: int, n: int, share: float) -> None:
    mask, pairs, generator = network(seed, n, share)
    weight = torch.rand(3, n, n, generator=generator, dtype=torch.float64)
    weight = (weight + weight.mT) * mask
    index = torch.randperm(n, generator=generator)[: 1 + n // 2]
    found = pairs.laplacian(pairs.of(weight), index)
    for one, whole in zip(found, weight, strict=True):
        rows = torch.tensor(laplacian(whole.numpy()))[index][:, index]
        assert torch.allclose(one, rows, rtol=1e-12)


@given(st.integers(0, 1000), st.integers(1, 30), st.floats(0.0, 0.3))
@settings(max_examples=20, deadline=None)
def test_components_are_scipys(seed: int, n: int, share: float) -> None:
    mask, pairs, _ = network(seed, n, share)
    together = connected(mask)
    for world in range(3):
        _, label = connected_components(csr_array(mask[world].numpy()), directed=False)
        assert ((label[:, None] == label) == together[world].numpy()).all()
    assert (pairs.components() <= torch.arange(n)).all()


def test_a_worlds_list_does_not_depend_on_its_batch() -> None:
    mask, pairs, _ = network(3, 15, 0.9)
    alone = pairs_of(mask[1:2])
    count = int(alone.there.sum())
    assert torch.equal(pairs.ends[1, :, :count], alone.ends[0, :, :count])
