"""One EKF over the whole team, with exact cross-covariances: the reference for cooperation.

It sees every UAV's measurements at once, whatever the network lets through, so it is no method for
a real swarm but what decentralized ones are measured against.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.filter import GaussianBelief, elapsed, gaussian_estimate
from agents.localizer import Estimate, Localizer
from agents.models.biases import Biases, Considered, kept_share, reported
from agents.models.measurements import Block, Neighbours, make_measurements
from agents.models.measurements.second_order import expanded
from agents.models.ordered_update import Estimation, by_kind, ordered_update, pick
from agents.models.process import make_process
from agents.models.update import posterior
from agents.robust import Prediction, RobustScreen, Trust
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.options import OpenShare, PositiveCount
from coloc_env.scenario import Believed


class JointEkf(Localizer[GaussianBelief]):
    """Centralized EKF of the team's joint state; options as ``ekf`` has them.

    ``second_order``: ranges are expanded to the second order, so that what is uncertain across a
    line of sight makes its range longer and less certain (Jazwinski 1970, section 9.3; without
    tags' lever arms only), where priors are broad too.

    Its belief's covariance is [B, N, E, N · E]: each UAV's rows of the joint matrix; so is what it
    considers of biases. A leaf ``heard`` [B, N, 1] of an observation says whose measurements there
    are; the others' states stay as they are.
    """

    name = "ekf_joint"
    centralized = True

    def __init__(
        self,
        believed: Believed,
        *,
        robust: str = "none",
        gate: OpenShare = 0.999,
        iterations: PositiveCount = 2,
        cooperate: bool = True,
        second_order: bool = False,
    ) -> None:
        super().__init__(believed)
        if believed.slots < believed.arena.n_uavs:
            raise NotServed(
                f"ekf_joint: a team of {believed.arena.n_uavs} with {believed.slots} neighbour "
                "slots is too large for it; raise max_neighbours to the team's size"
            )
        self.process, self.iterations = make_process(believed), iterations
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]
        self.screen = RobustScreen(self.process, self.models, robust, gate)
        self.second_order = second_order

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> GaussianBelief:
        x, own = self.process.initial(observation["prior"].double())
        b, n = x.shape[:2]
        step = torch.zeros(b, n, dtype=torch.int64, device=x.device)
        covariance = _diagonal(own).flatten(-2)
        return GaussianBelief(
            state=x,
            covariance=covariance,
            considered=self._considered(observation, covariance),
            shared=observation["prior"][..., :0].double(),
            step=step,
            memory=self.screen.memory(observation),
            batch_size=[b, n],
        )

    def step(
        self, belief: GaussianBelief, observation: Observation
    ) -> tuple[GaussianBelief, Estimate]:
        b, n, e = *belief.state.shape[:2], self.process.error_size
        dt = elapsed(self.process, belief.step).double()
        u = self.process.inputs(observation)
        f, q = self.process.linearize(belief.state, u, dt)
        x = self.process.propagate(belief.state, u, dt)
        heard = _heard(observation)
        if heard is not None:
            there = heard[..., None, None]
            f, q = torch.where(there, f, torch.eye(e).to(f)), torch.where(there, q, 0.0)
            x = torch.where(there[..., 0], x, belief.state)
        p = belief.covariance.unflatten(-1, (n, e)).transpose(2, 3)  # [B, N, N, E, E]
        # P_ij ← F_i P_ij F_jᵀ + δ_ij Q_i
        p = f.unsqueeze(2) @ p @ f.mT.unsqueeze(1) + _diagonal(q).transpose(2, 3)
        p = p.transpose(2, 3).reshape(b, n * e, n * e)
        considered = belief.considered
        if self.biases:
            wide = _diagonal(f).flatten(3).flatten(1, 2)
            considered = self.biases.predict(considered.flatten(1, 2), wide, observation)
        x, p, memory, considered = self._update(x, p, observation, belief.memory, considered)
        after = build(
            GaussianBelief,
            x.shape[:2],
            state=x,
            covariance=p.view(b, n, e, n * e),
            considered=considered.view(b, n, e, -1) if self.biases else considered,
            shared=belief.shared,
            step=belief.step + 1,
            memory=memory,
        )
        return after, gaussian_estimate(self.process, x, self._own(reported(p, considered)))

    @property
    def biases(self) -> Biases:
        return Biases(self.models, self.process.dt)

    def mean(self, belief: GaussianBelief) -> Float[Tensor, "B N S"]:
        return belief.state

    def shifted(self, belief: GaussianBelief, offset: Float[Tensor, "B N d"]) -> GaussianBelief:
        return belief.shifted(offset)

    def _update(
        self,
        x: Float[Tensor, "B N S"],
        p: Float[Tensor, "B M M"],
        observation: Observation,
        memory: Float[Tensor, "B N K"],
        considered: Considered,
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B M M"], Float[Tensor, "B N K"], Considered]:
        """Iterated update of the joint state; neighbours are where the joint mean has them."""
        if not self.models:
            return x, p, memory, considered
        n, e = x.shape[1], self.process.error_size
        prior = Prediction(x, self._own(p), observation, memory)
        state, updated, delta = x, p, torch.zeros_like(p[..., 0])
        evidence: Any = None
        blocks: list[Block] = []
        trusts: list[Trust] = []
        broad = self._broad(prior)
        extra = self.screen.extra if bool(broad.any()) else 0
        for iteration in range(-extra, self.iterations):
            blocks = self._blocks(state, prior)
            if self.second_order:
                blocks = self._expanded(blocks, p, observation)
            judged = blocks
            if self.screen.judges:
                judged = [self._with_partners(block, updated) for block in blocks]
            if iteration == -extra:
                evidence = self.screen.judge(judged, prior)
            trusts = self.screen.weigh(judged, evidence, iteration == self.iterations - 1)
            precision, vector = self._information(blocks, trusts)
            if iteration > -extra:
                vector = vector + (precision @ delta.unsqueeze(-1))[..., 0]
            delta, updated = posterior(p, precision, vector)
            state = self.process.boxplus(x, delta.unflatten(-1, (n, e)))
            if iteration < 0:  # extra iterations are for broad priors alone
                delta = torch.where(broad, delta, 0.0)
                state = torch.where(broad.unsqueeze(-1), state, x)
        vague = self._broad(prior, self.process.vague)
        if bool(vague.any()) and not self.second_order:
            own, shared = by_kind(self.models)
            model = Estimation(
                lambda at, cooperative: pick(
                    self._blocks(at, prior), shared if cooperative else own
                ),
                self._information,
                lambda at, delta: self.process.boxplus(at, delta.unflatten(-1, (n, e))),
                self._apart,
                self.process.dt,
            )
            found = ordered_update(x, p, model, pick(trusts, own), pick(trusts, shared))
            state = torch.where(vague.unsqueeze(-1), found[0], state)
            updated = torch.where(vague.unsqueeze(-1), found[1], updated)
        if self.biases:
            gain = updated @ self._by_bias(blocks, trusts, observation)
            kept = kept_share(p, updated)
            considered = self.biases.update(considered, kept, gain, observation)
        memory = self.screen.remember(prior, evidence, lambda: self._blocks(state, prior))
        return state, updated, memory, considered

    def _considered(
        self, observation: Observation, covariance: Float[Tensor, "B N E M"]
    ) -> Float[Tensor, "B N E G"]:
        """What biases have made of the error before anything is measured: nothing."""
        if not self.biases:
            return covariance[..., :0]
        n = covariance.shape[1]
        width = covariance.shape[-1] + n * self.biases.count(observation)
        return covariance.new_zeros(*covariance.shape[:-1], width)

    def _broad(self, prior: Prediction, *std: float) -> Bool[Tensor, "B 1"]:
        """Whether anybody's position is hardly known, of those of whom anything is heard."""
        broad, heard = prior.broad(self.process.dim, *std), _heard(prior.observation)
        return (broad if heard is None else broad & heard).any(-1, keepdim=True)

    def _own(self, p: Float[Tensor, "B M M"]) -> Float[Tensor, "B N E E"]:
        """Each UAV's own block of the joint covariance."""
        e = self.process.error_size
        split = p.unflatten(-1, (-1, e)).unflatten(1, (-1, e))
        return split.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)

    def _apart(self, p: Float[Tensor, "B M M"]) -> Float[Tensor, "B N N d d"]:
        """Covariance of the UAVs' relative positions: M_ij = P_ii + P_jj − P_ij − P_ji."""
        n, d = p.shape[-1] // self.process.error_size, self.process.dim
        cross = p.unflatten(-1, (n, -1)).unflatten(1, (n, -1)).transpose(2, 3)[..., :d, :d]
        own = cross.diagonal(dim1=1, dim2=2).movedim(-1, 1)
        return own.unsqueeze(2) + own.unsqueeze(1) - cross - cross.mT

    def _blocks(self, x: Float[Tensor, "B N S"], prior: Prediction) -> list[Block]:
        observation, d = prior.observation, self.process.dim
        neighbours, heard = self._neighbours(x), _heard(observation)
        if heard is not None:
            known = neighbours.known & heard.unsqueeze(1)
            neighbours = replace(neighbours, known=known)
        known = prior.covariance[..., :d, :d]
        blocks = [
            m.linearize(self.process, x, observation, neighbours).curved(known) for m in self.models
        ]
        if heard is None:
            return blocks
        return [replace(block, mask=block.mask & heard.unsqueeze(-1)) for block in blocks]

    def _expanded(
        self, blocks: Sequence[Block], p: Float[Tensor, "B M M"], observation: Observation
    ) -> list[Block]:
        """The blocks with ranges' second-order terms."""
        d, e = self.process.dim, self.process.error_size
        joint = p.unflatten(-1, (-1, e)).unflatten(1, (-1, e))[:, :, :d, :, :d]
        joint = joint.transpose(2, 3)  # [B, N, N, d, d]
        own = joint.diagonal(dim1=1, dim2=2).movedim(-1, 1).unsqueeze(2)  # [B, N, 1, d, d]
        apart = own + own.transpose(1, 2) - joint - joint.transpose(1, 2)
        return [
            expanded(model, block, apart if model.cooperative else own, observation)
            for model, block in zip(self.models, blocks, strict=True)
        ]

    def _with_partners(self, block: Block, p: Float[Tensor, "B M M"]) -> Block:
        """The block as one UAV alone would judge it: with what its partners do not know of
        themselves as noise."""
        if block.partner is None or block.partner_variance is None:
            return block
        d = self.process.dim
        variance = self._own(p)[..., :d, :d].diagonal(dim1=-2, dim2=-1)  # [B, N, d]
        n = variance.shape[1]
        by_slot = block.partner.unflatten(2, (-1, n, block.per_slot))
        added = (by_slot**2 * variance[:, None, None, :, None, None]).sum(-1).flatten(2, 4)
        return replace(block, partner_variance=block.partner_variance + added)

    def _neighbours(self, x: Float[Tensor, "B N S"]) -> Neighbours:
        b, n, d = *x.shape[:2], self.process.dim
        position = x[:, None, :, :d].expand(b, n, n, d)
        known = torch.ones(b, n, n, dtype=torch.bool, device=x.device)
        return Neighbours(position=position, variance=torch.zeros_like(position), known=known)

    def _information(
        self, blocks: Sequence[Block], trusts: Sequence[Trust]
    ) -> tuple[Float[Tensor, "B M M"], Float[Tensor, "B M"]]:
        """Joint Λ and η."""
        rows, scaled, residuals = [], [], []
        for block, trust in zip(blocks, trusts, strict=True):
            h, wh = self._joint_rows(block, trust)
            rows.append(h.flatten(1, 3))
            scaled.append(wh.flatten(1, 3))
            residuals.append(trust.residual(block).flatten(1))
        h, wh = torch.cat(rows, 1), torch.cat(scaled, 1)
        return h.mT @ wh, (wh.mT @ torch.cat(residuals, 1).unsqueeze(-1))[..., 0]

    def _joint_rows(
        self, block: Block, trust: Trust
    ) -> tuple[Float[Tensor, "B N m k M"], Float[Tensor, "B N m k M"]]:
        """H by the joint error, and W R⁻¹ H. A range is one number that both ends read: each end
        counts half."""
        d, e = self.process.dim, self.process.error_size
        b, n, m, k = block.residual.shape
        w = trust.information(block)
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
        h = h.flatten(-2)
        return h, h * w.unsqueeze(-1)

    def _by_bias(
        self, blocks: Sequence[Block], trusts: Sequence[Trust], observation: Observation
    ) -> Float[Tensor, "B M N*b"]:
        """Hᵀ W R⁻¹ B: a range's bias is one for both ends, the first one's."""
        gains = {}
        for model, block, trust in zip(self.models, blocks, trusts, strict=True):
            each = self._joint_rows(block, trust)[1].movedim(-1, 2)  # [B, N, M, m, k]
            if block.mutual:
                n = each.shape[1]
                split = each.unflatten(3, (-1, n, block.per_slot)).movedim(4, 2)
                both = split + split.transpose(1, 2).transpose(4, 5)  # [B, i, j, M, a, b, k]
                first = torch.ones(n, n, dtype=both.dtype, device=both.device).triu(1)
                both = both * first[..., None, None, None, None]
                each = both.movedim(2, 4).flatten(3, 5)
            gains[model] = each
        return self.biases.by_bias(gains, observation).transpose(1, 2).flatten(2)


def _heard(observation: Observation) -> Bool[Tensor, "B N"] | None:
    """Whose measurements there are; None: everybody's."""
    return observation["heard"][..., 0] > 0 if "heard" in observation else None


def _diagonal(blocks: Float[Tensor, "B N E E"]) -> Float[Tensor, "B N E N E"]:
    """The block-diagonal matrix of the UAVs' own blocks."""
    b, n, e, _ = blocks.shape
    out = blocks.new_zeros(b, n, e, n, e)
    own = torch.arange(n, device=blocks.device)
    out[:, own, :, own] = blocks.movedim(1, 0)
    return out
