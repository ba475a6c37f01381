"""The multi-hypothesis Kalman filter: a bank of EKFs, one per guess of where a UAV started.

Alspach & Sorenson 1972 (Gaussian sums); for mobile robots Jensfelt & Kristensen, IEEE Transactions
on Robotics and Automation 17(5), 2001.
"""

import math
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Float64, Int64
from tensordict import TensorClass
from torch import Tensor
from torch.nn.functional import pad

from agents.association import AssociationName
from agents.association.clutter import reach_volume
from agents.kalman import hypotheses
from agents.kalman.ekf import CooperativeEkf
from agents.kalman.filter import GaussianBelief
from agents.kalman.starts import split
from agents.localizer import Estimate, Localizer
from agents.models.measurements import LandmarkVectors, received
from agents.robust import Prediction
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.options import OpenShare, PositiveCount, Quantity
from coloc_env.scenario import Believed
from coloc_env.sensors import UnlabelledLandmarks

Hypotheses = Annotated[int, Quantity("", 1, 1000)]


class HypothesesBelief(TensorClass):
    """K hypotheses, the likeliest first: normalized log-weights (−∞: given up, and the likeliest is
    in its place), mean states, error covariances, and what each EKF keeps beside them (see
    ``GaussianBelief``); batch (B, N)."""

    log_weights: Float64[Tensor, "B N K"]
    state: Float64[Tensor, "B N K S"]
    covariance: Float64[Tensor, "B N K E E"]
    considered: Float[Tensor, "B N K E G"]
    memory: Float[Tensor, "B N K m"]
    step: Int64[Tensor, "B N"]


class MultiHypothesisEkf(Localizer[HypothesesBelief]):
    """A bank of up to ``hypotheses`` cooperative EKFs a UAV, started all over a prior that is too
    broad for one: headings, and places where landmarks come without names or the prior is uniform.

    Each is weighted by how well it predicts what is measured (a share of it may be clutter),
    given up when its weight falls below 1e-8, and merged with a likelier one that has come to the
    same pose. The estimate is the mean of all. ``robust``, ``gate``, ``iterations``,
    ``association``, ``cooperate``: as ``ekf`` has them.
    """

    name = "mhekf"
    associates = True

    def __init__(
        self,
        believed: Believed,
        *,
        hypotheses: Hypotheses = 64,
        robust: str = "none",
        gate: OpenShare = 0.999,
        iterations: PositiveCount = 2,
        association: AssociationName = "nearest",
        cooperate: bool = True,
    ) -> None:
        super().__init__(believed)
        self.count = hypotheses
        self.ekf = CooperativeEkf(
            believed,
            robust=robust,
            gate=gate,
            iterations=iterations,
            association=association,
            cooperate=cooperate,
        )
        if self.ekf.exchanges:
            raise ValueError("robust=cross is not allowed: each hypothesis judges for itself")
        self.process = self.ekf.process
        sensor = believed.sensor(UnlabelledLandmarks)
        self.volume = 1.0 if sensor is None else reach_volume(sensor, believed.arena.dim)

    def reset(self, observation: Observation) -> HypothesesBelief:
        one = self.ekf.reset(observation)
        state, covariance = split(
            self.believed, self.process, one.state, one.covariance, self.count
        )
        k = state.shape[2]
        return HypothesesBelief(
            log_weights=torch.full_like(state[..., 0], -math.log(k)),
            state=state,
            covariance=covariance.contiguous(),
            considered=_repeated(one.considered, k),
            memory=_repeated(one.memory, k),
            step=one.step,
            batch_size=one.batch_size,
        )

    def step(
        self, belief: HypothesesBelief, observation: Observation
    ) -> tuple[HypothesesBelief, Estimate]:
        k = int((belief.log_weights > -torch.inf).sum(-1).max()) if belief.step.numel() else 1
        rows = self._rows(belief, k)
        leaves = {name: leaf.repeat(k, 1, 1) for name, leaf in observation.leaves.items()}
        prior, beside = self.ekf.predicted(rows, Observation(leaves).kept())
        evidence = _columns(self._evidence(prior), k)
        after, _ = self.ekf.corrected(prior, beside)
        state, covariance = _columns(after.state, k), _columns(after.covariance, k)
        log_weights = hypotheses.reweighed(belief.log_weights[..., :k] + evidence)
        log_weights = hypotheses.merged(self.process, state, covariance, log_weights)
        order = hypotheses.by_weight(log_weights)
        log_weights = log_weights.gather(-1, order)
        gone = log_weights == -torch.inf
        slots = belief.log_weights.shape[-1]

        def kept(x: Tensor) -> Tensor:
            return _in_slots(_ordered(x, order), gone, slots)

        now = build(
            HypothesesBelief,
            belief.step.shape,
            log_weights=pad(log_weights, (0, slots - k), value=-torch.inf),
            state=kept(state),
            covariance=kept(covariance),
            considered=kept(_columns(after.considered, k)),
            memory=kept(_columns(after.memory, k)),
            step=belief.step + 1,
        )
        return now, self._estimate(now)

    def mean(self, belief: HypothesesBelief) -> Float[Tensor, "B N S"]:
        """The likeliest hypothesis."""
        return belief.state[..., 0, :]

    def shifted(self, belief: HypothesesBelief, offset: Float[Tensor, "B N d"]) -> HypothesesBelief:
        d = offset.shape[-1]
        moved = belief.state[..., :d] + offset.unsqueeze(-2)
        return belief.replace(state=torch.cat((moved, belief.state[..., d:]), -1))

    def gaussian(
        self, belief: HypothesesBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        return belief.state[..., 0, :], belief.covariance[..., 0, :, :]

    def restart_from(
        self,
        belief: HypothesesBelief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> HypothesesBelief:
        row = rows.unsqueeze(-1)
        sure = torch.full_like(belief.log_weights, -torch.inf)
        sure[..., 0] = 0.0
        wide = row[..., None, None]
        return belief.replace(
            log_weights=torch.where(row, sure, belief.log_weights),
            state=torch.where(row.unsqueeze(-1), state.unsqueeze(2), belief.state),
            covariance=torch.where(wide, covariance.unsqueeze(2), belief.covariance),
            considered=torch.where(wide, 0.0, belief.considered),
        )

    def diagnostics(self, belief: HypothesesBelief) -> dict[str, Float[Tensor, "B N"]]:
        live = (belief.log_weights > -torch.inf).sum(-1)
        own = {"hypotheses": live.to(torch.float32)}
        if self.ekf.kinds[1]:
            own["bytes"] = torch.full_like(own["hypotheses"], 4 * 3 * self.process.dim)
        return own

    def _rows(self, belief: HypothesesBelief, k: int) -> GaussianBelief:
        """The first K hypotheses as worlds of one batch [K · B, N]."""
        step = belief.step.repeat(k, 1)
        considered = _tall(belief.considered, k)
        return build(
            GaussianBelief,
            step.shape,
            state=_tall(belief.state, k),
            covariance=_tall(belief.covariance, k),
            considered=considered,
            shared=considered.flatten(2)[..., :0].double(),
            step=step,
            memory=_tall(belief.memory, k),
        )

    def _evidence(self, prior: Prediction) -> Float64[Tensor, "B N"]:
        """log p of what is measured, before it is used."""
        seen, ekf = prior.observation, self.ekf
        neighbours = received(self.believed, seen)
        total = torch.zeros_like(prior.state[..., 0])
        for model in ekf.models:
            if ekf.association is not None and isinstance(model, LandmarkVectors):
                found = ekf.association.candidates(prior)
                total = total + hypotheses.log_any_landmark(found, self.volume)
            elif model.testable:
                block = model.linearize(self.process, prior.state, seen, neighbours)
                total = total + hypotheses.log_predictive(block, prior.covariance)
        return total

    def _estimate(self, belief: HypothesesBelief) -> Estimate:
        """Mean and covariance of the position over all hypotheses."""
        d = self.process.dim
        weight = belief.log_weights.exp().unsqueeze(-1)
        mean = (weight * belief.state[..., : 2 * d]).sum(2)
        apart = belief.state[..., :d] - mean[..., None, :d]
        own = (weight.unsqueeze(-1) * belief.covariance[..., :d, :d]).sum(2)
        return build(
            Estimate,
            belief.step.shape,
            position=mean[..., :d],
            velocity=mean[..., d:],
            covariance=own + apart.mT @ (weight * apart),
        )


def _repeated(x: Float[Tensor, "B N *s"], k: int) -> Float[Tensor, "B N K *s"]:
    return x.unsqueeze(2).expand(-1, -1, k, *x.shape[2:]).contiguous()


def _tall(x: Float[Tensor, "B N K *s"], k: int) -> Float[Tensor, "k*B N *s"]:
    """Hypotheses as worlds."""
    return x[:, :, :k].movedim(2, 0).flatten(0, 1)


def _columns(x: Float[Tensor, "k*B N *s"], k: int) -> Float[Tensor, "B N k *s"]:
    """Worlds as hypotheses."""
    return x.unflatten(0, (k, -1)).movedim(0, 2)


def _ordered(x: Float[Tensor, "B N k *s"], order: Int64[Tensor, "B N k"]) -> Tensor:
    wide = order.reshape(*order.shape, *[1] * (x.dim() - 3)).expand_as(x)
    return x.gather(2, wide)


def _in_slots(x: Tensor, gone: Bool[Tensor, "B N k"], slots: int) -> Tensor:
    """With the likeliest in the places of those given up, and in slots that were not computed."""
    first = x[:, :, :1]
    live = torch.where(gone.reshape(*gone.shape, *[1] * (x.dim() - 3)), first, x)
    return torch.cat((live, first.expand(-1, -1, slots - x.shape[2], *x.shape[3:])), 2)
