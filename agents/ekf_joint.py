"""One EKF over the whole team, with exact cross-covariances: the reference for cooperation.

It sees every UAV's measurements at once, whatever the network lets through, so it is no method for
a real swarm but what decentralized ones are measured against.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from agents.ekf import (
    GaussianBelief,
    elapsed,
    gaussian_estimate,
)
from agents.localizer import Estimate, Localizer, register
from agents.models.measurements import Block, Neighbours, make_measurements
from agents.models.process import make_process
from agents.models.robust import Robust, check_gate, weigh
from agents.models.update import posterior
from coloc_env.observation import Observation
from coloc_env.scenario import Believed


@register("ekf_joint")
class JointEkf(Localizer[GaussianBelief]):
    """Centralized EKF of the team's joint state; options as ``ekf`` has them.

    Its belief's covariance is [B, N, E, N · E]: each UAV's rows of the joint matrix.
    """

    name = "ekf_joint"
    centralized = True

    def __init__(
        self,
        believed: Believed,
        *,
        robust: Robust = "none",
        gate: float = 0.999,
        iterations: int = 2,
        cooperate: bool = True,
    ) -> None:
        super().__init__(believed)
        if believed.slots < believed.arena.n_uavs:
            raise ValueError(
                f"ekf_joint: a team of {believed.arena.n_uavs} with {believed.slots} neighbour "
                "slots is too large for it; raise max_neighbours to the team's size"
            )
        if iterations < 1:
            raise ValueError(f"ekf_joint: iterations={iterations} is not allowed: at least 1")
        check_gate(gate)
        self.process = make_process(believed)
        self.robust, self.gate, self.iterations = robust, gate, iterations
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]

    def reset(self, observation: Observation) -> GaussianBelief:
        x, own = self.process.initial(observation["prior"].double())
        b, n = x.shape[:2]
        step = torch.zeros(b, n, dtype=torch.int64, device=x.device)
        return GaussianBelief(
            state=x, covariance=_diagonal(own).flatten(-2), step=step, batch_size=[b, n]
        )

    def step(
        self, belief: GaussianBelief, observation: Observation
    ) -> tuple[GaussianBelief, Estimate]:
        b, n, e = *belief.state.shape[:2], self.process.error_size
        dt = elapsed(self.process, belief.step).double()
        u = self.process.inputs(observation)
        f, q = self.process.linearize(belief.state, u, dt)
        x = self.process.propagate(belief.state, u, dt)
        p = belief.covariance.unflatten(-1, (n, e)).transpose(2, 3)  # [B, N, N, E, E]
        p = f.unsqueeze(2) @ p @ f.mT.unsqueeze(1) + _diagonal(q).transpose(2, 3)
        p = p.transpose(2, 3).reshape(b, n * e, n * e)
        x, p = self._update(x, p, observation)
        p = p.view(b, n, e, n * e)
        after = GaussianBelief(state=x, covariance=p, step=belief.step + 1, batch_size=[b, n])
        own = p.unflatten(-1, (n, e)).diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
        return after, gaussian_estimate(self.process, x, own)

    def _update(
        self, x: Float[Tensor, "B N S"], p: Float[Tensor, "B M M"], observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B M M"]]:
        """Iterated update of the joint state; neighbours are where the joint mean has them."""
        b, n, e = *x.shape[:2], self.process.error_size
        own = p.view(b, n, e, n, e).diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
        state, updated, weights, delta = x, p, None, p[..., 0]
        for iteration in range(self.iterations):
            neighbours = self._neighbours(state)
            blocks = [
                m.linearize(self.process, state, observation, neighbours) for m in self.models
            ]
            weights = weigh(self.robust, self.gate, blocks, own, weights)
            precision, vector = self._information(blocks, weights)
            if iteration:
                vector = vector + (precision @ delta.unsqueeze(-1))[..., 0]
            delta, updated = posterior(p, precision, vector)
            state = self.process.boxplus(x, delta.unflatten(-1, (n, e)))
        return state, updated

    def _neighbours(self, x: Float[Tensor, "B N S"]) -> Neighbours:
        b, n, d = *x.shape[:2], self.process.dim
        position = x[:, None, :, :d].expand(b, n, n, d)
        known = torch.ones(b, n, n, dtype=torch.bool, device=x.device)
        return Neighbours(position=position, variance=torch.zeros_like(position), known=known)

    def _information(
        self, blocks: Sequence[Block], weights: Sequence[Float[Tensor, "B N m"]]
    ) -> tuple[Float[Tensor, "B M M"], Float[Tensor, "B M"]]:
        """Joint Λ and η. A range is one number that both ends read: each end counts half."""
        d, e = self.process.dim, self.process.error_size
        rows, scaled, residuals = [], [], []
        for block, weight in zip(blocks, weights, strict=True):
            b, n, m, k = block.residual.shape
            w = (weight * block.mask).unsqueeze(-1) / block.total_variance
            h = block.jacobian.new_zeros(b, n, m, k, n, e)
            own = torch.arange(n, device=h.device)
            h[:, own, :, :, own] = block.jacobian.movedim(1, 0)
            if block.partner is not None:
                # Measurements come as (own tag, slot, their tag) or (depth, slot): slot j is UAV j.
                partner = block.partner.unflatten(2, (-1, n, block.per_slot))
                spread = h.unflatten(2, (-1, n, block.per_slot))
                for slot in range(n):
                    spread[:, :, :, slot, :, :, slot, :d] += partner[:, :, :, slot]
                if block.mutual:
                    w = 0.5 * w
            h = h.flatten(-2).flatten(1, 3)
            rows.append(h)
            scaled.append(h * w.flatten(1).unsqueeze(-1))
            residuals.append(block.residual.flatten(1))
        h, wh = torch.cat(rows, 1), torch.cat(scaled, 1)
        return h.mT @ wh, (wh.mT @ torch.cat(residuals, 1).unsqueeze(-1))[..., 0]


def _diagonal(blocks: Float[Tensor, "B N E E"]) -> Float[Tensor, "B N E N E"]:
    """The block-diagonal matrix of the UAVs' own blocks."""
    b, n, e, _ = blocks.shape
    out = blocks.new_zeros(b, n, e, n, e)
    own = torch.arange(n, device=blocks.device)
    out[:, own, :, own] = blocks.movedim(1, 0)
    return out
