"""What localizers of whole swarms share: dead reckoning, position fixes, and weights of links."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.ekf import elapsed
from agents.localizer import Estimate, Localizer
from agents.models.process import make_process
from agents.swarm import calibration, weights
from agents.swarm.links import Links, lengths, links_of
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import PositionFix, Ranging

UNKNOWN = 1e12  # m²: variance of a position of which nothing is known
Confidence = Literal["none", "huber", "em"]


class SwarmBelief(TensorClass):
    """Dead-reckoned state with the position last found, that position's variance (m², per axis) and
    its rows of the team's joint covariance (m²; none where a method has no use for it), steps
    taken, and what is remembered of ranges' errors (the same for all); batch (B, N)."""

    state: Float64[Tensor, "B N S"]
    variance: Float64[Tensor, "B N"]
    joint: Float64[Tensor, "B N d K"]
    step: Int64[Tensor, "B N"]
    errors: Float64[Tensor, "B N 2 3"]


@dataclass(frozen=True)
class Prepared:
    """What a step has to find positions from: everybody's dead-reckoned ``state``, its ``place`` by
    dead reckoning or fix (m), that place's ``variance`` (m² per axis) and what the step ``added``
    to it, who is ``fixed``, the ``links``, the ``model`` of their errors, and by what factor each
    link's weight is held down from outside (``confidence``, in [0, 1]; None: not at all)."""

    state: Float64[Tensor, "B N S"]
    place: Float64[Tensor, "B N d"]
    variance: Float64[Tensor, "B N"]
    added: Float64[Tensor, "B N"]
    fixed: Bool[Tensor, "B N"]
    links: Links
    model: calibration.ErrorModel
    confidence: Float64[Tensor, "B N N"] | None = None


@dataclass(frozen=True)
class Found:
    """Positions (m), their variance (m² per axis), and the joint covariance if there is one."""

    position: Float64[Tensor, "B N d"]
    variance: Float64[Tensor, "B N"]
    joint: Float64[Tensor, "B N d K"] | None = None


class SwarmFilter(Localizer[SwarmBelief]):
    """Finds the positions of a whole team in every step, from all its ranges at once.

    One localizer acts for the whole team. What a UAV gets depends on the part of the network that
    it is connected to, and on the noise that ranges between UAVs with fixes show anywhere.
    """

    centralized = True

    def __init__(self, believed: Believed, confidence: Confidence) -> None:
        super().__init__(believed)
        sensor = believed.sensor(Ranging)
        if sensor is None or sensor.tags:
            raise ValueError("a team with ranges between UAVs, without lever arms, is needed")
        self.std, self.process = sensor.noise.std, make_process(believed)
        self.confidence = confidence

    @abstractmethod
    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        """Positions from what a step brings."""

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> SwarmBelief:
        state, covariance = self.process.initial(observation["prior"].double())
        d, shape = self.process.dim, state.shape[:2]
        variance = covariance[..., :d, :d].diagonal(dim1=-2, dim2=-1).mean(-1)
        errors = calibration.believed_model(len(state), self.std, state.device).sums
        return SwarmBelief(
            state=state,
            variance=variance,
            joint=self.joint(variance),
            step=torch.zeros(shape, dtype=torch.int64, device=state.device),
            errors=errors.unsqueeze(1).expand(-1, shape[1], -1, -1).contiguous(),
            batch_size=shape,
        )

    def joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N d K"]:
        """The joint covariance of UAVs with nothing in common; nothing where it is not kept."""
        return variance.new_zeros(*variance.shape, self.process.dim, 0)

    def step(self, belief: SwarmBelief, observation: Observation) -> tuple[SwarmBelief, Estimate]:
        now = self.prepared(belief, observation)
        return self.concluded(belief, now, self.find(belief, now))

    def prepared(self, belief: SwarmBelief, observation: Observation) -> Prepared:
        """What a step has to find positions from."""
        d, dt = self.process.dim, elapsed(self.process, belief.step).double()
        u = self.process.inputs(observation)
        state = self.process.propagate(belief.state, u, dt)
        _, q = self.process.linearize(belief.state, u, dt)
        added = q[..., :d, :d].diagonal(dim1=-2, dim2=-1).mean(-1)
        fixed, place, spread = self._fixes(observation, state[..., :d])
        variance = torch.where(fixed, spread, belief.variance + added)
        links = links_of(observation)
        model = self._learned(belief, links, place, fixed)
        return Prepared(state, place, variance, added, fixed, links, model)

    def concluded(
        self, belief: SwarmBelief, now: Prepared, found: Found
    ) -> tuple[SwarmBelief, Estimate]:
        """The belief that goes on from what was found, and the estimate."""
        d, shape = self.process.dim, now.fixed.shape
        state = torch.cat((found.position, now.state[..., d:]), -1)
        after = build(
            SwarmBelief,
            shape,
            state=state,
            variance=found.variance,
            joint=belief.joint if found.joint is None else found.joint,
            step=belief.step + 1,
            errors=now.model.sums.unsqueeze(1).expand_as(belief.errors).contiguous(),
        )
        eye = torch.eye(d, dtype=state.dtype, device=state.device)
        covariance = found.variance[..., None, None] * eye
        if found.joint is not None:
            covariance = own_blocks(found.joint)
        estimate = build(
            Estimate,
            shape,
            position=found.position,
            velocity=state[..., d : 2 * d],
            covariance=covariance,
        )
        return after, estimate

    def diagnostics(self, belief: SwarmBelief) -> dict[str, Float64[Tensor, "B N"]]:
        if self.confidence != "em":
            return {}
        model, shape = self._model(belief), belief.step.shape
        mean, _ = model.component(self.std)
        return {
            "outlier_share": model.share[:, 1:].expand(shape),
            "outlier_bias": mean[:, 1:].expand(shape),
        }

    def weigh(
        self, y: Float64[Tensor, "B N d"], now: Prepared
    ) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
        """Each link's weight (1/m²) and shift (m) at some positions."""
        return self.weigh_residual(now.links.distance - lengths(y), now)

    def weigh_residual(
        self, residual: Float64[Tensor, "B N N"], now: Prepared
    ) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
        """The same for residuals (m)."""
        weight, shift = self._weighed(residual, now)
        return (weight if now.confidence is None else now.confidence * weight), shift

    def _weighed(
        self, residual: Float64[Tensor, "B N N"], now: Prepared
    ) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
        mask, std = now.links.mask, self.std
        if self.confidence == "none":
            return weights.plain(residual, mask, std)
        added = now.variance.unsqueeze(-1) + now.variance.unsqueeze(-2)
        if self.confidence == "huber":
            return weights.huber(residual, mask, added, std)
        return weights.calibrated(residual, mask, added, std, now.model)

    def _fixes(
        self, observation: Observation, position: Float64[Tensor, "B N d"]
    ) -> tuple[Bool[Tensor, "B N"], Float64[Tensor, "B N d"], float]:
        """Who knows where it is, everybody's place with theirs in it, and the variance of those."""
        sensor = self.believed.sensor(PositionFix)
        if sensor is None:
            return torch.zeros_like(position[..., 0], dtype=torch.bool), position, 0.0
        fixed = observation["position_fix_mask"][..., 0] > 0
        known = observation["position_fix"].double()
        return fixed, torch.where(fixed.unsqueeze(-1), known, position), sensor.std**2

    def _model(self, belief: SwarmBelief) -> calibration.ErrorModel:
        return calibration.ErrorModel(sums=belief.errors[:, 0], batch_size=belief.errors.shape[:1])

    def _learned(
        self,
        belief: SwarmBelief,
        links: Links,
        place: Float64[Tensor, "B N d"],
        fixed: Bool[Tensor, "B N"],
    ) -> calibration.ErrorModel:
        """The error model after this step's links between those who know where they are."""
        model = self._model(belief)
        known = links.mask & fixed.unsqueeze(-1) & fixed.unsqueeze(-2)
        if self.confidence != "em" or not bool(known.any()):
            return model
        error = links.distance - lengths(place)
        once = torch.triu(known, 1)
        return calibration.learned(model, error.flatten(1), once.flatten(1), self.std)


def begun(now: Prepared) -> Prepared:
    """The same where every UAV has a place to start from: who has none (a prior that is no number)
    gets the middle of its neighbours', or of all, with a variance of ``UNKNOWN``."""
    known = now.place.isfinite().all(-1)
    if bool(known.all()):
        return now
    place = torch.where(known.unsqueeze(-1), now.place, 0.0)
    count = known.double().unsqueeze(-1)
    linked = now.links.mask.double()
    near, everywhere = linked @ count, count.sum(1, keepdim=True).clamp_min(1.0)
    middle = torch.where(
        near > 0, linked @ place / near.clamp_min(1.0), place.sum(1, keepdim=True) / everywhere
    )
    return replace(
        now,
        place=torch.where(known.unsqueeze(-1), place, middle),
        variance=torch.where(known, now.variance, UNKNOWN),
    )


def own_blocks(joint: Float64[Tensor, "B N d N*d"]) -> Float64[Tensor, "B N d d"]:
    """Each UAV's own block of a joint covariance."""
    d = joint.shape[2]
    return joint.unflatten(-1, (-1, d)).diagonal(dim1=1, dim2=3).movedim(-1, 1)
