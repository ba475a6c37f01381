"""The links of a team as a list of pairs i < j: for what concerns each link by itself.

Where few pairs of a large team are in reach, or where a value is the same at both ends, a list is
much shorter than the N × N entries of a matrix. What differs at the ends is [B, *s, 2, E]: for a
link i, j first what i has of j, then what j has of i.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import pad

BLOCK = 64  # lists are padded to a multiple of it: rows of a product (agents.layers.Linear)
_LEAST = 1e-9  # m: length of a link


@dataclass(frozen=True)
class Pairs:
    """The links of each world: their ``ends`` i < j, and which entries are links (``there``).
    Worlds with fewer links than others are padded with pairs of UAV 0 with itself, of which all
    that is summed must be 0. ``n``: UAVs."""

    ends: Int64[Tensor, "B 2 E"]
    there: Bool[Tensor, "B E"]
    n: int

    def own(self, x: Tensor) -> Tensor:
        """What UAVs have, [B, *s, N], at their end of each link, [B, *s, 2, E]."""
        return _read(x, self.ends)

    def other(self, x: Tensor) -> Tensor:
        """What UAVs have, [B, *s, N], at the other end of each link, [B, *s, 2, E]."""
        return _read(x, self.ends.flip(1))

    def apart(self, x: Float[Tensor, "B N d"]) -> Float[Tensor, "B d E"]:
        """x_i − x_j of what UAVs have."""
        i, j = self.ends.unbind(1)
        return torch.stack([of.gather(1, i) - of.gather(1, j) for of in x.unbind(-1)], 1)

    def units(self, y: Float[Tensor, "B N d"]) -> tuple[Float[Tensor, "B d E"], Tensor]:
        """The unit vectors u_ij from j to i, and the lengths [B, E] of links (1e-9 at least)."""
        apart = self.apart(y)
        length = norm(apart).clamp_min(_LEAST)
        return apart / length.unsqueeze(1), length

    def sums(self, x: Tensor) -> Tensor:
        """Σ_j x_ij at every UAV, [B, *s, N], of what links have at both ends, [B, *s, 2, E], or
        have alike, [B, *s, 1, E]."""
        at_i, at_j = both(x).unbind(-2)
        return self._at(0, at_i) + self._at(1, at_j)

    def along(self, strength: Tensor, unit: Float[Tensor, "B d E"]) -> Float[Tensor, "B N d"]:
        """Σ_j s_ij u_ij at every UAV, of strengths at both ends, [B, 2, E], or alike, [B, 1, E]."""
        at_i = strength[:, :1] * unit
        at_j = at_i if strength.shape[1] == 1 else strength[:, 1:] * unit
        return (self._at(0, at_i) - self._at(1, at_j)).mT

    def largest(self, x: Float[Tensor, "B 2 E"]) -> Float[Tensor, "B N"]:
        """max_j x_ij at every UAV; −∞ without a link."""
        total = x.new_full((len(x), self.n), -torch.inf)
        return total.scatter_reduce(1, self.ends.flatten(1), x.flatten(1), "amax")

    def of(self, matrix: Tensor) -> Tensor:
        """Entries i, j of symmetric matrices [B, N, N], as a list [B, E]."""
        return matrix.flatten(1).gather(1, self._places[:, 0])

    def put(self, matrix: Tensor, x: Tensor) -> Tensor:
        """Matrices [B, N, N] with what links have alike, [B, E], in its places i, j and j, i."""
        whole, places = matrix.flatten(1), self._places
        x = torch.where(self.there, x, whole[:, :1])  # padding is UAV 0 with itself
        x = x.unsqueeze(1).expand_as(places).flatten(1)
        return whole.scatter(1, places.flatten(1), x).view_as(matrix)

    def matrix(self, x: Tensor) -> Tensor:
        """What links have at both ends, [B, 2, E], or have alike, [B, 1, E], as matrices
        [B, N, N]; 0 without a link."""
        matrix = x.new_zeros(len(x), self.n**2)
        matrix.scatter_(1, self._places.flatten(1), both(x).flatten(1))
        return matrix.unflatten(1, (self.n, -1))

    def laplacian(
        self, weight: Float[Tensor, "B E"], index: Int64[Tensor, "M"]
    ) -> Float[Tensor, "B M M"]:
        """The rows and columns of the UAVs in ``index`` of Σ W_ij (e_i − e_j)(e_i − e_j)ᵀ."""
        m, weight = len(index), weight.unsqueeze(1)
        place = torch.full((self.n,), m, device=index.device)  # all others are one more
        place[index] = torch.arange(m, device=index.device)
        among = Pairs(place[self.ends], self.there, m + 1)
        matrix = among.matrix(-weight)[:, :m, :m]
        matrix.diagonal(dim1=-2, dim2=-1).add_(self.sums(weight)[:, index])
        return matrix

    def components(self) -> Int64[Tensor, "B N"]:
        """The first UAV of the connected component of the network that each belongs to."""
        label = torch.arange(self.n, device=self.ends.device).expand(len(self.ends), -1)
        while True:
            near = self.other(label).flatten(1)
            lower = label.scatter_reduce(1, self.ends.flatten(1), near, "amin")
            lower = lower.gather(1, lower)
            if torch.equal(lower, label):
                return label
            label = lower

    def _at(self, end: int, x: Tensor) -> Tensor:
        """Sums at every UAV, [B, *s, N], of what links have at one end, [B, *s, E]."""
        total = x.new_zeros(*x.shape[:-1], self.n)
        return total.scatter_add(-1, _over(self.ends[:, end], x), x)

    @cached_property
    def _places(self) -> Int64[Tensor, "B 2 E"]:
        """Of i, j and of j, i in a flat matrix."""
        return self.n * self.ends + self.ends.flip(1)


def pairs_of(mask: Bool[Tensor, "B N N"]) -> Pairs:
    """The links in a symmetric ``mask``, in the order of j − i, then i: neighbours in the list have
    other ends, so that no sum waits for the one before."""
    b, n = mask.shape[:2]
    skewed = pad(mask.triu(1).flatten(1), (0, n)).view(b, n, n + 1).mT.flatten(1)  # [j − i, i]
    count = skewed.sum(-1, keepdim=True)
    width = BLOCK * max(1, -(-int(count.max()) // BLOCK))
    there = torch.arange(width, device=mask.device) < count
    place = skewed.nonzero()[:, 1]
    place = torch.zeros_like(there, dtype=torch.int64).masked_scatter(there, place)
    i = place % n
    return Pairs(torch.stack((i, i + place // n), 1), there, n)


def norm(x: Float[Tensor, "B d E"]) -> Float[Tensor, "B E"]:
    """Lengths of vectors, an axis at a time: ``vector_norm`` is slow across rows."""
    first, *others = x.square().unbind(1)
    return sum(others, first).sqrt()


def both(x: Tensor) -> Tensor:
    """What links have alike, [*s, 1, E], at both ends, [*s, 2, E]."""
    return x.expand(*x.shape[:-2], 2, -1)


def _read(x: Tensor, ends: Int64[Tensor, "B 2 E"]) -> Tensor:
    """What UAVs have, [B, *s, N], at ends of links, [B, *s, 2, E]."""
    return x.contiguous().gather(-1, _over(ends.flatten(1), x)).unflatten(-1, (2, -1))


def _over(end: Int64[Tensor, "B E"], x: Tensor) -> Tensor:
    """Indices [B, E] for all of x [B, *s, N or E]."""
    return end.view(len(end), *[1] * (x.ndim - 2), -1).expand(*x.shape[:-1], -1)
