"""One factor graph of the whole team: the reference for UAVs that exchange condensed graphs."""

from typing import Annotated

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.association import AssociationName
from agents.errors import NotServed
from agents.factor_graph.belief import SmootherBelief
from agents.factor_graph.chain import Chain, Smoothed, block_diagonal, diagonal_blocks, smooth
from agents.factor_graph.dfgo import DistributedFactorGraph
from agents.models.measurements import Block, Neighbours, make_measurements
from agents.robust import SoftName
from coloc_env.observation import Observation
from coloc_env.options import PositiveCount, Quantity
from coloc_env.scenario import Believed


class CentralFactorGraph(DistributedFactorGraph):
    """Fixed-lag smoother of the team's joint state over its last ``window`` steps, all ranges in
    one graph, whatever the network. ``iterations``, ``robust`` and ``association`` as ``dfgo`` has
    them.

    Its belief holds each UAV's rows of the joint covariance.
    """

    name = "dfgo_central"
    centralized = True

    def __init__(
        self,
        believed: Believed,
        *,
        window: Annotated[int, Quantity("steps", 2, 200)] = 20,
        iterations: PositiveCount = 4,
        robust: SoftName = "huber",
        association: AssociationName = "joint",
    ) -> None:
        super().__init__(
            believed,
            window=window,
            iterations=iterations,
            robust=robust,
            exchange="none",
            association=association,
        )
        if believed.slots != believed.arena.n_uavs:
            raise NotServed("estimates all UAVs at once: each needs a slot for every other")
        self.own = make_measurements(believed)

    @property
    def exchanges(self) -> bool:
        return True

    @property
    def _hears(self) -> bool:
        return False

    def reset(self, observation: Observation) -> SmootherBelief:
        belief = super().reset(observation)
        b, n, e, _ = belief.prior_covariance.shape
        return belief.replace(
            prior_covariance=block_diagonal(belief.prior_covariance).view(b, n, e, n * e)
        )

    def _solved(
        self,
        x: Float64[Tensor, "B N W S"],
        belief: SmootherBelief,
        leaves: Observation,
        heard: Float64[Tensor, "B N W 0"],
    ) -> Smoothed:
        """The team's graph; of the result each UAV's part."""
        n, e = x.shape[1], self.process.error_size
        found = smooth(self.linearized(x, belief, leaves, heard))
        own = diagonal_blocks(found.covariance[:, -1], n).unsqueeze(2)  # [B, N, 1, E, E]
        return Smoothed(
            found.mean.unflatten(-1, (n, e)).transpose(1, 2),
            own,
            found.gain,
            found.next_mean.unflatten(-1, (n, e)),
            found.next_covariance.unflatten(1, (n, e)),
        )

    def linearized(
        self,
        x: Float64[Tensor, "B N W S"],
        belief: SmootherBelief,
        leaves: Observation,
        heard: Float64[Tensor, "B N W 0"],
    ) -> Chain:
        """The team's graph about its states, as one chain of joint states."""
        b, n, w, _ = x.shape
        e, d = self.process.error_size, self.process.dim
        place = x[:, None, ..., :d].expand(-1, n, -1, -1, -1).transpose(2, 3)  # [B, N, W, N, d]
        everybody = Neighbours(place, torch.zeros_like(place), torch.ones_like(place[..., 0]) > 0)
        blocks = [m.linearize(self.process, x, leaves, everybody) for m in self.own]
        precision, vector = x.new_zeros(b, w, n * e, n * e), x.new_zeros(b, w, n * e)
        for block in blocks:
            h, weight, residual = self._rows(block, n)
            weighted = (h * weight.unsqueeze(-1)).mT
            precision = precision + weighted @ h
            vector = vector + (weighted @ residual.unsqueeze(-1))[..., 0]
        mean, f, offset, q = self._steps(x, belief, leaves)
        return Chain(
            mean.flatten(1),
            belief.prior_covariance.flatten(1, 2),
            block_diagonal(f.transpose(1, 2)),
            offset.transpose(1, 2).flatten(2),
            block_diagonal(q.transpose(1, 2)),
            precision,
            vector,
        )

    def _rows(
        self, block: Block, n: int
    ) -> tuple[
        Float64[Tensor, "B W N*m N*E"], Float64[Tensor, "B W N*m"], Float64[Tensor, "B W N*m"]
    ]:
        """Rows of the joint Jacobian, their weights and residuals. A range is one number that both
        ends read: each end counts half."""
        b, _, w, m, k, e = block.jacobian.shape
        h = block.jacobian.new_zeros(b, n, w, m, k, n, e)
        own = torch.arange(n, device=h.device)
        h[:, own, :, :, :, own] = block.jacobian.movedim(1, 0)
        weight = self.trust(block).information(block)
        if block.partner is not None:  # measurements come as (…, slot, per slot), slot j is UAV j
            by_slot = h.unflatten(3, (-1, n, block.per_slot))
            partner = block.partner.unflatten(3, (-1, n, block.per_slot))
            for j in range(n):
                by_slot[:, :, :, :, j, :, :, j, : self.process.dim] += partner[:, :, :, :, j]
            weight = 0.5 * weight if block.mutual else weight
        rows = h.transpose(1, 2).flatten(5).flatten(2, 4)
        weight, residual = (v.transpose(1, 2).flatten(2) for v in (weight, block.residual))
        return rows, weight, residual
