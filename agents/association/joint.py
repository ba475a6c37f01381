"""Joint compatibility: pairings that agree with the prior together, not only each for itself.

Neira & Tardós, IEEE Transactions on Robotics and Automation 17(6), 2001: of the sets of pairings
whose joint innovation lies within the χ² gate, that with the most pairings, of equal ones that with
the smallest joint distance. Their branch and bound is exact; here the search keeps the best
``beams`` partial sets after each measurement (a beam search), for all UAVs at once: every set that
it returns is jointly compatible, the largest may be missed.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from agents.association.candidates import Candidates
from agents.robust.mahalanobis import chi_square, innovation_covariance, whitened_squares

_PAIR = 1e6  # what one pairing more counts beside joint distances


@dataclass(frozen=True)
class Beams:
    """Partial sets of pairings: the landmark of each measurement (−1: none), how many there are,
    their joint squared Mahalanobis distance (∞: no such set), and the error's mean and covariance
    given them."""

    landmark: Int64[Tensor, "R K M"]
    pairs: Int64[Tensor, "R K"]
    distance: Float[Tensor, "R K"]
    delta: Float[Tensor, "R K e"]
    covariance: Float[Tensor, "R K e e"]

    @property
    def score(self) -> Float[Tensor, "R K"]:
        """More pairings first, then smaller distances."""
        return _PAIR * self.pairs - self.distance


def joint(found: Candidates, probability: float, beams: int) -> Int64[Tensor, "B N M"]:
    """The landmark of each measurement, −1 for none. Each pairing, and every set of them on the way
    to the last, lies within the χ² quantile ``probability``."""
    h, p = found.jacobian.flatten(0, 1), found.covariance.flatten(0, 1)
    m, k = found.z.shape[-2:]
    alone = (found.squared <= chi_square(probability, k)) & found.mask.unsqueeze(-1)
    alone, z = alone.flatten(0, 1), found.z.flatten(0, 1)
    expected = found.expected.flatten(0, 1)
    # What fits the fewest landmarks is paired first; what fits none, never.
    choices = alone.sum(-1)
    order = torch.where(choices > 0, choices, m + 1 + alone.shape[-1]).argsort(dim=-1, stable=True)
    rows = torch.arange(len(z), device=z.device)
    now = _none(rows, beams, m, p)
    for turn in range(int((choices > 0).sum(-1).max()) if len(z) else 0):
        which = order[:, turn]
        apart = z[rows, which].unsqueeze(1) - expected
        now = _extended(now, which, apart, h, alone[rows, which], found.variance, probability)
    best = now.score.argmax(-1)
    return now.landmark[rows, best].unflatten(0, found.mask.shape[:2])


def _none(rows: Int64[Tensor, "R"], beams: int, m: int, p: Float[Tensor, "R e e"]) -> Beams:
    """One set without any pairing."""
    shape = (len(rows), beams)
    distance = p.new_full(shape, torch.inf)
    distance[:, 0] = 0.0
    return Beams(
        landmark=torch.full((*shape, m), -1, dtype=torch.int64, device=p.device),
        pairs=torch.zeros(shape, dtype=torch.int64, device=p.device),
        distance=distance,
        delta=p.new_zeros(*shape, p.shape[-1]),
        covariance=p.unsqueeze(1).expand(-1, beams, -1, -1),
    )


def _extended(
    now: Beams,
    which: Int64[Tensor, "R"],
    apart: Float[Tensor, "R L d"],
    h: Float[Tensor, "R L d e"],
    alone: Bool[Tensor, "R L"],
    variance: float,
    probability: float,
) -> Beams:
    """The best sets after one measurement more, paired with any landmark that is free or with
    none. The distance of a pairing given those before adds up to that of all (chain rule)."""
    k, count = apart.shape[-1], apart.shape[-2]
    wide = h.flatten(1, 2).unsqueeze(1)  # [R, 1, L d, e]
    spread = (wide @ now.covariance).unflatten(2, (count, k))
    s = innovation_covariance(spread, h.unsqueeze(1), [variance] * k)
    shift = (wide @ now.delta.unsqueeze(-1))[..., 0].unflatten(2, (count, k))
    innovation = apart.unsqueeze(1) - shift  # [R, K, L, d]
    terms = whitened_squares(innovation.unbind(-1), s)
    distance = now.distance.unsqueeze(-1) + sum(terms[1:], terms[0])
    limits = distance.new_tensor([chi_square(probability, k * (n + 1)) for n in range(count + 1)])
    limit = limits[now.pairs.clamp_max(count)].unsqueeze(-1)
    taken = (now.landmark.unsqueeze(-1) == torch.arange(count, device=h.device)).any(2)
    allowed = alone.unsqueeze(1) & ~taken & (distance <= limit)
    paired = torch.where(allowed, _PAIR * (now.pairs + 1).unsqueeze(-1) - distance, -torch.inf)
    score, index = (
        torch.cat((paired, now.score.unsqueeze(-1)), -1).flatten(1).topk(now.distance.shape[1])
    )
    parent, landmark = index // (count + 1), index % (count + 1)
    pairs = landmark < count
    landmark = landmark.clamp_max(count - 1)
    row = torch.arange(len(which), device=which.device).unsqueeze(-1)
    names = now.landmark[row, parent].clone()
    at = which.view(-1, 1, 1).expand(-1, names.shape[1], 1)
    names.scatter_(2, at, torch.where(pairs, landmark, -1).unsqueeze(-1))
    # Kalman update of the error by the pairing: K = P Hᵀ S⁻¹
    p, chosen = now.covariance[row, parent], h[row, landmark]
    by = chosen @ p
    noise = variance * torch.eye(k, dtype=p.dtype, device=p.device)
    gain = torch.linalg.solve(by @ chosen.mT + noise, by).mT
    moved = (gain @ innovation[row, parent, landmark].unsqueeze(-1))[..., 0]
    before = now.delta[row, parent]
    far = torch.where(pairs, distance[row, parent, landmark], now.distance[row, parent])
    return Beams(
        landmark=names,
        pairs=now.pairs[row, parent] + pairs,
        distance=torch.where(score > -torch.inf, far, torch.inf),
        delta=torch.where(pairs.unsqueeze(-1), before + moved, before),
        covariance=torch.where(pairs[..., None, None], p - gain @ by, p),
    )
