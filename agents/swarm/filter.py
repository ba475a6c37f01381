"""What localizers of whole swarms share: dead reckoning, position fixes, and weights of links."""

from abc import abstractmethod
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.kalman.filter import elapsed
from agents.localizer import Estimate, Localizer
from agents.models.process import make_process
from agents.swarm import (
    calibration,
    delays,
    drift,
    joint,
    obstruction,
    persistence,
    weights,
    window,
)
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.drift import Drift
from agents.swarm.links import Links, connected, lengths, links_of
from agents.swarm.window import History
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, InsDriven
from coloc_env.sensors import AnchorRanging, Height, Ins, PositionFix, Ranging, SlowFlight

Confidence = Literal["none", "huber", "em", "paper"]


class SwarmFilter(Localizer[SwarmBelief]):
    """Finds the positions of a whole team in every step, from all its ranges at once.

    One localizer acts for the whole team. What a UAV gets depends on the part of the network that
    it is connected to, and on the noise that ranges between UAVs with fixes show anywhere.
    """

    centralized = True
    serves = (Ranging, AnchorRanging, PositionFix, Height, SlowFlight)  # some among anchors only
    window = 0  # steps that are remembered besides the present one
    decay = 0.0  # 1/s: at what rate they fade
    recursive = True  # what it finds has dead reckoning in it, and is not news to that
    dense = True  # many links to each UAV: enough to learn of all, and for over-relaxed steps

    def __init__(
        self,
        believed: Believed,
        confidence: Confidence,
        bias: bool = False,
        delays: bool = False,
    ) -> None:
        """``bias``: estimate the INS's, where the team has one that it believes to be biased;
        ``delays``: estimate what antennas add to ranges, where it believes that they do."""
        super().__init__(believed)
        sensor = believed.sensor(Ranging)
        if sensor is None or sensor.tags:
            raise ValueError("a team with ranges between UAVs, without lever arms, is needed")
        self.std, self.process = sensor.noise.std, make_process(believed)
        self.confidence = confidence
        ins = believed.sensor(Ins) if isinstance(believed.process, InsDriven) else None
        self.ins = ins if bias and ins is not None and ins.bias > 0 else None
        clock = sensor.clock
        self.clock = (
            clock if delays and clock is not None and clock.offset + clock.skew > 0 else None
        )

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
        model = calibration.believed_model(len(state), self.std, state.device)
        chain = persistence.believed_chain(model.share[:, 1])
        width = shape[1] if self.confidence in ("em", "paper") else 0
        usual = model.share[:, 1, None, None] if self.confidence == "em" else 0.0
        drifting = 0.0 if self.ins is None else self.ins.bias**2
        none = torch.zeros_like(variance)
        known = self.joint(variance)
        return SwarmBelief(
            state=state,
            variance=variance,
            joint=known,
            bias=torch.zeros_like(state[..., :d]),
            drift=torch.stack((none, none + drifting), -1),
            step=torch.zeros(shape, dtype=torch.int64, device=state.device),
            errors=_for_each(model.sums, shape),
            chain=_for_each(chain, shape),
            memory=variance.new_zeros(*shape, width) + usual,
            localizable=torch.zeros(shape, dtype=torch.bool, device=state.device),
            past=window.begun(state[..., :d], known, self.window),
            delays=delays.begun(state[..., :d], self.clock),
            batch_size=shape,
        )

    def joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N e K"]:
        """The joint covariance of UAVs with nothing in common; nothing where it is not kept."""
        return variance.new_zeros(*variance.shape, 1, 0)

    def step(self, belief: SwarmBelief, observation: Observation) -> tuple[SwarmBelief, Estimate]:
        now = self.prepared(belief, observation)
        found = self.find(belief, now)
        return self.concluded(belief, now, found), self.estimated(now, found)

    def prepared(self, belief: SwarmBelief, observation: Observation) -> Prepared:
        """What a step has to find positions from."""
        d, dt = self.process.dim, elapsed(self.process, belief.step).double()
        u = self.process.inputs(observation)
        if self.ins is None:
            moving, kept = None, torch.ones_like(dt)
            _, q = self.process.linearize(belief.state, u, dt)
            added = q[..., :d, :d].diagonal(dim1=-2, dim2=-1).mean(-1)
        else:
            moving = drift.aged(Drift(belief.bias, *belief.drift.unbind(-1)), dt, self.ins)
            u = u - moving.bias
            moving, kept, added = drift.reckoned(moving, belief.variance, dt, self.ins)
        state = self.process.propagate(belief.state, u, dt)
        fixed, place, spread = self._fixes(observation, state[..., :d])
        reckoned = kept.square() * belief.variance + added
        variance = torch.where(fixed, spread, reckoned)
        if belief.joint.shape[-1]:
            together = joint.carried(belief.joint, kept, added, fixed, spread)
            between = joint.between(together)
        else:
            together = belief.joint
            between = variance.unsqueeze(-1) + variance.unsqueeze(-2)
        links, late = links_of(observation), belief.delays
        if self.clock is not None:
            late = delays.carried(late, kept, fixed, dt, self.clock)
            off = links.distance - delays.added(late.delay)
            links = Links(torch.where(links.mask, off, 0.0), links.mask)
            between = between + delays.unsure(late)
        now = Prepared(
            state,
            place,
            variance,
            added,
            fixed,
            links,
            calibration.ErrorModel(sums=belief.errors[:, 0], batch_size=belief.errors.shape[:1]),
            reckoned,
            together,
            between,
            moving,
            belief.chain[:, 0],
            late,
            past=self._past(belief, place, kept, added, fixed, spread, dt),
        )
        if self.confidence == "em":
            return obstruction.learned(now, belief.memory, self.std, self.dense)
        if self.confidence == "paper":
            heard = (~links.mask).double()
            silent = belief.memory + (heard - belief.memory) / calibration.FORGET
            return replace(now, silent=silent)
        return now

    def concluded(self, belief: SwarmBelief, now: Prepared, found: Found) -> SwarmBelief:
        """The belief that goes on from what was found."""
        d, shape = self.process.dim, now.fixed.shape
        bias, moments = belief.bias, belief.drift
        if now.drift is not None:
            moved = found.position - now.state[..., :d]
            known = drift.informed(now.drift, moved, now.reckoned, found.variance)
            bias, moments = known.bias, torch.stack((known.cross, known.variance), -1)
        return build(
            SwarmBelief,
            shape,
            state=torch.cat((found.position, now.state[..., d:]), -1),
            variance=found.variance,
            joint=now.joint if found.joint is None else found.joint,
            bias=bias,
            drift=moments,
            step=belief.step + 1,
            errors=_for_each(now.model.sums, shape),
            chain=_for_each(now.chain, shape),
            memory=self._remembered(belief, now, found),
            localizable=_localizable(now, d),
            past=belief.past if found.past is None else found.past,
            delays=now.delays if found.delays is None else found.delays,
        )

    def estimated(self, now: Prepared, found: Found) -> Estimate:
        """What every UAV says of itself by what was found."""
        d = self.process.dim
        eye = torch.eye(d, dtype=found.position.dtype, device=found.position.device)
        covariance = found.variance[..., None, None] * eye
        if found.joint is not None:
            own = joint.own_blocks(found.joint)
            covariance = own if own.shape[-1] == d else own * eye
        return build(
            Estimate,
            now.fixed.shape,
            position=found.position,
            velocity=now.state[..., d : 2 * d],
            covariance=covariance,
        )

    def diagnostics(self, belief: SwarmBelief) -> dict[str, Float64[Tensor, "B N"]]:
        """``localizable``; in calibrated ones what is believed of ranges: share, bias (m) and
        persistence ρ of outliers; the size of the INS's bias (m/s) and the antenna's delay (m) that
        are taken off."""
        own = {"localizable": belief.localizable.double()}
        if self.confidence == "em":
            sums, shape = belief.errors[:, 0], belief.step.shape
            model = calibration.ErrorModel(sums=sums, batch_size=sums.shape[:1])
            mean, _ = model.component(self.std)
            rho = persistence.persistence(belief.chain[:, 0])
            own["outlier_share"] = model.share[:, 1:].expand(shape)
            own["outlier_bias"] = mean[:, 1:].expand(shape)
            own["outlier_persistence"] = rho.unsqueeze(-1).expand(shape)
        if self.ins is not None:
            own["ins_bias"] = belief.bias.norm(dim=-1)
        if self.clock is not None:
            own["antenna_delay"] = belief.delays.delay[..., 0]
        return own

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
        if self.confidence == "em":
            return weights.calibrated(residual, mask, now.between, std, now.model, now.outlier)
        weight, shift = weights.huber(residual, mask, now.between, std)
        if now.silent is not None:
            weight = weight * weights.papers(residual, now.silent, now.between, std)
        return weight, shift

    def told(self, weight: Float64[Tensor, "B N N"], now: Prepared) -> Float64[Tensor, "B N N"]:
        """The information (1/m²) that each link of some weight has: less than the weight in
        calibrated ones, which cannot be sure whether it is obstructed."""
        if self.confidence != "em" or now.outlier is None:
            return weight
        each = calibration.information(now.model, now.outlier.flatten(1), self.std)
        each = each.view_as(weight) * now.links.mask
        return each if now.confidence is None else now.confidence * each

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

    def _past(
        self,
        belief: SwarmBelief,
        place: Float64[Tensor, "B N d"],
        kept: Float64[Tensor, "B N"],
        added: Float64[Tensor, "B N"],
        fixed: Bool[Tensor, "B N"],
        spread: float,
        dt: Float64[Tensor, "B N"],
    ) -> History | None:
        """The window as it looks from now."""
        if not self.window:
            return None
        return window.carried(
            belief.past,
            place - belief.state[..., : self.process.dim],
            kept.masked_fill(fixed, 0.0),
            added.masked_fill(fixed, spread),
            window.fading(self.decay, dt),
        )

    def _remembered(
        self, belief: SwarmBelief, now: Prepared, found: Found
    ) -> Float64[Tensor, "B N L"]:
        """What goes on of each link."""
        if now.outlier is not None:
            return obstruction.seen(now, found, now.outlier, self.std)
        return belief.memory if now.silent is None else now.silent


def _for_each(x: Float64[Tensor, "B *s"], shape: torch.Size) -> Float64[Tensor, "B N *s"]:
    """A world's figures as every UAV has them."""
    return x.unsqueeze(1).expand(*shape, *x.shape[1:]).contiguous()


def _localizable(now: Prepared, dim: int) -> Bool[Tensor, "B N"]:
    """Who is connected, over any number of links, to at least ``dim`` + 1 UAVs with fixes."""
    fixes = connected(now.links.mask).double() @ now.fixed.double().unsqueeze(-1)
    return fixes[..., 0] > dim
