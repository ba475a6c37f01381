"""Pairwise fusion: two UAVs that meet update their joint belief, and keep what they then share.

Luft, Schubert, Roumeliotis & Burgard, "Recursive decentralized localization for multi-robot systems
with asynchronous pairwise communication", IJRR 37(10), 2018. Each end of a pair keeps a factor of
their cross-covariance, Σ_ij = σ_ij σ_jiᵀ, which only its own motion and measurements change:
σ_ij ← F_i σ_ij, σ_ij ← A_i σ_ij. When i and j meet, they exchange their beliefs and factors, and
both (or neither) update the joint belief of the two. Of everybody else, i then keeps
σ_ik ← Σ_ii⁺ Σ_ii⁻¹ σ_ik, which drops what k and j have in common beside that: many meetings a step
lose positive definiteness. An innovation covariance S = (1 + κ) H Σ Hᵀ + R pays for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.filter import Beside
from agents.kalman.fusion import Fusion, Rows, Taken, gains_of, rows_of
from agents.models.biases import kept_share
from agents.models.measurements import Block, Measurement, Neighbours
from agents.models.process import Process
from agents.robust import Prediction, Trust
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

_KAPPA = 3.0  # κ for each partner that is met in a step
_PASSES = 3  # Gauss–Newton iterations of a meeting


@dataclass(frozen=True)
class Meetings:
    """Who meets whom in R rounds: ``partner`` (oneself: nobody), and whether they do."""

    partner: Int64[Tensor, "R B N"]
    met: Bool[Tensor, "R B N"]


class Pairwise(Fusion):
    """``partners``: how many others a UAV meets in a step, at most; they are tried in the order of
    a round robin. ``shared`` holds σ_ij [N, E, E] and how many were met in the last step."""

    def __init__(
        self,
        believed: Believed,
        process: Process,
        models: Sequence[Measurement],
        partners: int = 1,
    ) -> None:
        super().__init__(believed, process, models)
        n = believed.arena.n_uavs
        if believed.slots < n:
            raise NotServed(
                f"fusion=pairwise: a team of {n} with {believed.slots} neighbour slots is too "
                "large for it; raise max_neighbours to the team's size"
            )
        self.partners, self.kappa = partners, _KAPPA

    def initial(self, observation: Observation) -> Float[Tensor, "B N H"]:
        n, e = self.believed.arena.n_uavs, self.process.error_size
        prior = observation["prior"]
        return prior.new_zeros(*prior.shape[:2], n * e * e + 1).double()

    def neighbours(self, prior: Prediction) -> Neighbours:
        d = self.process.dim
        variance = prior.covariance[..., :d, :d].diagonal(dim1=-2, dim2=-1)
        known = _both_ways(prior.observation["links"] > 0) & _sane(prior).unsqueeze(1)
        position, variance = (
            x.unsqueeze(1).expand(*known.shape, d).masked_fill(~known.unsqueeze(-1), 0.0)
            for x in (prior.state[..., :d], variance)
        )
        return Neighbours(position, variance, known)

    def sent(self, shared: Float[Tensor, "B N H"]) -> Float[Tensor, "B N"]:
        """State, half of Σ_ii, σ_ij and a range for each meeting, float32."""
        e, s = self.process.error_size, self.process.state_size
        return 4 * (s + e * (e + 1) // 2 + e * e + 1) * shared[..., -1]

    def scaled(
        self, shared: Float[Tensor, "B N H"], kept: Float[Tensor, "B N E E"]
    ) -> Float[Tensor, "B N H"]:
        factors = kept.unsqueeze(2) @ self.factors(shared)
        return torch.cat((factors.flatten(2), shared[..., -1:]), -1)

    def factors(self, shared: Float[Tensor, "B N H"]) -> Float[Tensor, "B N N E E"]:
        """σ_ij of each UAV i and other UAV j."""
        e = self.process.error_size
        return shared[..., :-1].unflatten(-1, (-1, e, e))

    def fuse(
        self, prior: Prediction, beside: Beside, trusts: Sequence[Trust]
    ) -> tuple[list[Taken], Float[Tensor, "B N H"]]:
        meetings = self.meetings(prior, beside.step)
        met = meetings.met.sum(0)
        x, p, shared, taken = prior.state, prior.covariance, beside.shared, []
        for partner, meets in zip(meetings.partner, meetings.met, strict=True):
            if not bool(meets.any()):
                continue
            kappa = self.kappa * torch.maximum(met, met.gather(1, partner)).to(x.dtype)
            joint = self._joint(p, self.factors(shared), partner)
            found, after = self._meet(x, joint, kappa, partner, prior.observation, trusts)
            taken.append(_where(meets, found, x, p))
            shared = self._shared(shared, p, found.covariance, after, partner, meets)
            x, p = taken[-1].state, taken[-1].covariance
        return taken, torch.cat((shared[..., :-1], met.unsqueeze(-1).to(shared)), -1)

    def meetings(self, prior: Prediction, step: Int64[Tensor, "B N"]) -> Meetings:
        """In each round everybody is offered one partner; they meet if both hear each other, either
        has measured the other, and neither has met enough."""
        observation, n = prior.observation, self.believed.arena.n_uavs
        blocks = self.linearize(prior.state, observation, self._around(prior.state))
        measured = torch.zeros_like(observation["links"], dtype=torch.bool)
        for block in blocks:
            measured |= block.mask.unflatten(2, (-1, n, block.per_slot)).any(-1).any(2)
        ready = _both_ways(observation["links"] > 0) & (measured | measured.mT)
        ready &= _both_ways(_sane(prior).unsqueeze(1).expand_as(ready))
        offers = torch.tensor(_offers(n), device=step.device)  # [R, N]
        own = torch.arange(n, device=step.device)
        count = torch.zeros_like(step)
        partners, met = [], []
        for turn in range(len(offers)):
            partner = offers[(step + turn) % len(offers), own]
            mutual = partner.gather(1, partner) == own
            free = count < self.partners
            meets = ready.gather(2, partner.unsqueeze(-1))[..., 0] & mutual & (partner != own)
            meets = meets & free & free.gather(1, partner)
            count = count + meets
            partners.append(partner)
            met.append(meets)
        return Meetings(torch.stack(partners), torch.stack(met))

    def _around(self, x: Float[Tensor, "B N S"]) -> Neighbours:
        """Everybody where everybody's estimate is, as if known."""
        b, n, d = *x.shape[:2], self.process.dim
        position = x[:, None, :, :d].expand(b, n, n, d)
        known = torch.ones(b, n, n, dtype=torch.bool, device=x.device)
        return Neighbours(position, torch.zeros_like(position), known)

    def _joint(
        self,
        p: Float[Tensor, "B N E E"],
        factors: Float[Tensor, "B N N E E"],
        partner: Int64[Tensor, "B N"],
    ) -> Float[Tensor, "B N 2E 2E"]:
        """Covariance of each UAV and its partner, Σ_ij = σ_ij σ_jiᵀ."""
        world = torch.arange(len(p), device=p.device).unsqueeze(-1)
        own = torch.arange(p.shape[1], device=p.device)
        cross = factors[world, own, partner] @ factors[world, partner, own].mT
        return torch.cat(
            (torch.cat((p, cross), -1), torch.cat((cross.mT, p[world, partner]), -1)), -2
        )

    def _meet(
        self,
        x: Float[Tensor, "B N S"],
        joint: Float[Tensor, "B N 2E 2E"],
        kappa: Float[Tensor, "B N"],
        partner: Int64[Tensor, "B N"],
        observation: Observation,
        trusts: Sequence[Trust],
    ) -> tuple[Taken, Float[Tensor, "B N E E"]]:
        """Everybody's update with its partner, relinearized at the pair, and Σ_ij after it."""
        e, n = self.process.error_size, x.shape[1]
        world = torch.arange(len(x), device=x.device).unsqueeze(-1)
        state, delta, blocks = x, joint.new_zeros(joint.shape[:-1]), []
        pay = (1 + kappa)[..., None, None]
        gain = h = joint
        for _ in range(_PASSES):
            blocks = self.linearize(state, observation, self._around(state))
            mine = rows_of(blocks, trusts, n, partner, halved=True)
            h, residual, noise = _stacked(mine, _at(mine, world, partner))
            s = pay * (h @ joint @ h.mT) + torch.diag_embed(noise)
            gain = torch.linalg.solve(s, h @ joint).mT  # K = Σ Hᵀ S⁻¹
            ahead = residual + (h @ delta.unsqueeze(-1))[..., 0]  # about x, not x ⊞ δ
            delta = (gain @ ahead.unsqueeze(-1))[..., 0]
            state = self.process.boxplus(x, delta[..., :e])
        after = joint - gain @ h @ joint
        own = 0.5 * (after[..., :e, :e] + after[..., :e, :e].mT)
        kept = torch.eye(e, dtype=x.dtype, device=x.device) - (gain @ h)[..., :e, :e]
        gains = self._by_link(blocks, gain[..., :e, :], partner)
        return Taken(state, own, kept, gains), after[..., :e, e:]

    def _by_link(
        self,
        blocks: Sequence[Block],
        gain: Float[Tensor, "B N E 2r"],
        partner: Int64[Tensor, "B N"],
    ) -> dict[Measurement, Float[Tensor, "B N E m k"]]:
        """Gains of what a UAV measured of its partner; with those of the other end where that is
        the same number. (What else the partner measured has biases of the partner's own.)"""
        mine, theirs = gain.chunk(2, -1)
        n, parts, start = partner.shape[1], [], 0
        for block in blocks:
            m, k = block.residual.shape[-2:]
            lead = m // (n * block.per_slot)
            size = lead * block.per_slot * k
            part = mine[..., start : start + size]
            if block.mutual:  # own tag a and their tag b: the other end's (b, a)
                other = theirs[..., start : start + size].unflatten(-1, (lead, block.per_slot))
                part = part + other.mT.flatten(-2)
            parts.append(part)
            start += size
        return gains_of(self.models, blocks, torch.cat(parts, -1), n, partner)

    def _shared(
        self,
        shared: Float[Tensor, "B N H"],
        before: Float[Tensor, "B N E E"],
        own: Float[Tensor, "B N E E"],
        cross: Float[Tensor, "B N E E"],
        partner: Int64[Tensor, "B N"],
        meets: Bool[Tensor, "B N"],
    ) -> Float[Tensor, "B N H"]:
        """σ_ik ← Σ_ii⁺ Σ_ii⁻¹ σ_ik of third parties; of the two that met, the first keeps Σ_ij⁺ and
        the other the identity."""
        e, n = self.process.error_size, partner.shape[1]
        eye = torch.eye(e, dtype=before.dtype, device=before.device)
        first = torch.arange(n, device=partner.device) < partner
        factors = kept_share(before, own).unsqueeze(2) @ self.factors(shared)
        chosen = torch.nn.functional.one_hot(partner, n)[..., None, None] > 0
        mutual = torch.where(first[..., None, None], cross, eye)
        factors = torch.where(chosen, mutual.unsqueeze(2), factors)
        after = torch.cat((factors.flatten(2), shared[..., -1:]), -1)
        return torch.where(meets.unsqueeze(-1), after, shared)


def _at(rows: Rows, world: Int64[Tensor, "B 1"], which: Int64[Tensor, "B N"]) -> Rows:
    """The rows of the UAVs in ``which``."""
    return Rows(*(x[world, which] for x in (rows.residual, rows.own, rows.partner, rows.variance)))


def _stacked(
    mine: Rows, theirs: Rows
) -> tuple[Float[Tensor, "B N 2r 2E"], Float[Tensor, "B N 2r"], Float[Tensor, "B N 2r"]]:
    """H by the errors of both, residuals and variances of what both ends measured."""
    rest = mine.own.shape[-1] - mine.partner.shape[-1]
    pad = torch.nn.functional.pad
    h = torch.cat(
        (
            torch.cat((mine.own, pad(mine.partner, (0, rest))), -1),
            torch.cat((pad(theirs.partner, (0, rest)), theirs.own), -1),
        ),
        -2,
    )
    residual = torch.cat((mine.residual, theirs.residual), -1)
    return h, residual, torch.cat((mine.variance, theirs.variance), -1)


def _where(
    rows: Bool[Tensor, "B N"], taken: Taken, x: Float[Tensor, "B N S"], p: Float[Tensor, "B N E E"]
) -> Taken:
    """The update where it is taken; elsewhere nothing changes."""
    row = rows[..., None, None]
    eye = torch.eye(p.shape[-1], dtype=p.dtype, device=p.device)
    return Taken(
        torch.where(row[..., 0], taken.state, x),
        torch.where(row, taken.covariance, p),
        torch.where(row, taken.kept, eye),
        {model: torch.where(row.unsqueeze(-1), g, 0.0) for model, g in taken.gains.items()},
    )


def _sane(prior: Prediction) -> Bool[Tensor, "B N"]:
    """Whose belief holds nothing but numbers."""
    return prior.state.isfinite().all(-1) & prior.covariance.isfinite().all(-1).all(-1)


def _both_ways(links: Bool[Tensor, "B N N"]) -> Bool[Tensor, "B N N"]:
    return links & links.mT


@cache
def _offers(n: int) -> list[list[int]]:
    """Partners [R, N] in a round robin of n (the circle method); oneself where there is none."""
    size = n + n % 2
    circle, rounds = list(range(size)), []
    for _ in range(size - 1):
        partner = list(range(n))
        for a, b in zip(circle[: size // 2], reversed(circle[size // 2 :]), strict=True):
            if a < n and b < n:
                partner[a], partner[b] = b, a
        rounds.append(partner)
        circle = [circle[0], circle[-1], *circle[1:-1]]
    return rounds
