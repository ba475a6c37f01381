"""Covariance intersection, one neighbour after the other: safe whatever estimates have in common.

Split covariance intersection (Julier & Uhlmann 2001; Li & Nashashibi 2013) of a UAV's belief P with
what it measures of one neighbour, whose position has covariance M: the prior counts as P / ω, the
neighbour as M / (1 − ω), and the measurement's own noise, which nothing shares, in full. What the
linearization of a distance neglects counts as noise (``Block.bent``); without it, teams are lost.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from agents.kalman.filter import Beside
from agents.kalman.fusion import Fusion, Rows, Taken, gains_of, rows_of
from agents.models.measurements import Neighbours, received
from agents.robust import Prediction, Trust
from coloc_env.observation import Observation

_OMEGAS = (  # tried, beside 1: no update
    *(0.998, 0.995, 0.99, 0.98, 0.96, 0.93, 0.9, 0.85),
    *(0.8, 0.75, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2),
)


class Intersection(Fusion):
    """Beside its estimate a UAV sends the correlations of its position's errors; ``shared`` holds
    those that are under way, the oldest first."""

    def initial(self, observation: Observation) -> Float[Tensor, "B N H"]:
        d, shape = self.process.dim, observation["prior"].shape[:2]
        eye = torch.eye(d, dtype=torch.float64, device=observation.device).flatten()
        return eye.repeat(1 + self.believed.message_delay).expand(*shape, -1).contiguous()

    def neighbours(self, prior: Prediction) -> Neighbours:
        return received(self.believed, prior.observation)

    def remember(
        self, shared: Float[Tensor, "B N H"], covariance: Float[Tensor, "B N E E"]
    ) -> Float[Tensor, "B N H"]:
        d = self.process.dim
        own = covariance[..., :d, :d]
        std = own.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).sqrt()
        sent = own / (std.unsqueeze(-1) * std.unsqueeze(-2))
        return torch.cat((shared[..., d * d :], sent.flatten(-2)), -1)

    def sent(self, shared: Float[Tensor, "B N H"]) -> Float[Tensor, "B N"]:
        d = self.process.dim
        return torch.full_like(shared[..., 0], 4 * (3 * d + d * (d - 1) // 2))

    def fuse(
        self, prior: Prediction, beside: Beside, trusts: Sequence[Trust]
    ) -> tuple[list[Taken], Float[Tensor, "B N H"]]:
        x, p, d, seen = prior.state, prior.covariance, self.process.dim, prior.observation
        heard = self.neighbours(prior)
        theirs = self._covariances(heard, beside.shared, seen)  # M
        sound = theirs.isfinite().all(-1).all(-1)
        theirs = torch.where(sound[..., None, None], theirs, 0.0)
        heard = replace(heard, known=heard.known & sound)
        around = replace(heard, variance=torch.zeros_like(heard.variance))
        taken = []
        world, uav = (torch.arange(size, device=x.device) for size in x.shape[:2])
        first = heard.known.to(torch.int8).sort(dim=-1, descending=True, stable=True).indices
        for turn in range(int(heard.known.sum(-1).max())):
            which = first[..., turn]  # each UAV's next neighbour that is known, if there is one
            one = theirs[world[:, None], uav, which]
            apart = p[..., None, :d, :d] + theirs
            blocks = [b.bent(apart, 1.0) for b in self.linearize(x, seen, around)]
            rows = rows_of(blocks, trusts, self.believed.slots, which)
            omega = self._omega(p, one, rows)
            wide = p / omega[..., None, None]
            share = (1 - omega).clamp_min(1e-9)[..., None, None]
            noise = rows.partner @ one @ rows.partner.mT / share
            s = rows.own @ wide @ rows.own.mT + noise + torch.diag_embed(rows.variance)
            used = (omega < 1)[..., None, None]
            gain = torch.where(used, torch.linalg.solve(s, rows.own @ wide).mT, 0.0)
            x = self.process.boxplus(x, (gain @ rows.residual.unsqueeze(-1))[..., 0])
            p = wide - gain @ rows.own @ wide
            p = 0.5 * (p + p.mT)
            kept = torch.eye(p.shape[-1], dtype=p.dtype, device=p.device) - gain @ rows.own
            gains = gains_of(self.models, blocks, gain, self.believed.slots, which)
            taken.append(Taken(x, p, kept, gains))
        return taken, beside.shared

    def _covariances(
        self, heard: Neighbours, shared: Float[Tensor, "B N H"], observation: Observation
    ) -> Float[Tensor, "B N S d d"]:
        """Covariances (m²) of the positions in slots, from the deviations and correlations sent."""
        d = self.process.dim
        correlation = shared[..., : d * d].unflatten(-1, (d, d))
        if "neighbours" in observation:
            world = torch.arange(len(shared), device=shared.device)[:, None, None]
            correlation = correlation[world, observation["neighbours"].long()]
        else:
            correlation = correlation.unsqueeze(1)
        std = heard.variance.sqrt()
        return correlation * std.unsqueeze(-1) * std.unsqueeze(-2)

    def _omega(
        self, p: Float[Tensor, "B N E E"], theirs: Float[Tensor, "B N d d"], rows: Rows
    ) -> Float[Tensor, "B N"]:
        """The weight ω that leaves the position the least variance; 1 where none is better."""
        d = self.process.dim
        omega = p.new_tensor(_OMEGAS)[:, None, None, None, None]
        own = rows.own @ p
        s = own @ rows.own.mT / omega + rows.partner @ theirs @ rows.partner.mT / (1 - omega)
        root = torch.linalg.cholesky_ex(s + torch.diag_embed(rows.variance)).L
        ahead_of = own[..., :d].expand(len(_OMEGAS), -1, -1, -1, -1)
        half = torch.linalg.solve_triangular(root, ahead_of, upper=False)
        total = p[..., :d, :d].diagonal(dim1=-2, dim2=-1).sum(-1)
        ahead = total / omega[..., 0, 0] - half.square().sum((-2, -1)) / omega[..., 0, 0] ** 2
        least, at = ahead.min(0)
        return torch.where(least < total, p.new_tensor(_OMEGAS)[at], 1.0)
