"""Swarm methods among fixed anchors, with lever arms, and with motion that is more than a position.

A swarm filter knows UAVs with positions, velocities that an INS says, and links between centres.
All else is kept around it: the full motion model, heights, lever arms, and anchors, which become
members of the team that know where they are.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import torch
from jaxtyping import Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.kalman.filter import elapsed
from agents.localizer import Estimate, Localizer
from agents.models.process import make_process
from agents.swarm import joint
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.centres import Centres
from agents.swarm.filter import SwarmFilter
from agents.swarm.links import Links
from agents.swarm.reckoning import Reckoning, apart, informed, matched
from agents.tensorclasses import build
from coloc_env.observation import Observation, prior_width
from coloc_env.scenario import Believed, InsDriven
from coloc_env.sensors import AnchorRanging, Ins, PositionFix, Ranging

_M = TypeVar("_M", bound=SwarmFilter)
_SURVEYED = 1e-3  # m: how well anchors' places are known, per axis


class AmongBelief(TensorClass):
    """State and error covariance of each UAV's motion model, steps taken, and the UAVs' part of the
    swarm filter's belief in the team and the anchors; batch (B, N)."""

    state: Float64[Tensor, "B N S"]
    covariance: Float64[Tensor, "B N E E"]
    step: Int64[Tensor, "B N"]
    swarm: SwarmBelief


class AmongAnchors(Localizer[AmongBelief]):
    """A swarm filter (``method``) for N UAVs and A anchors, M = N + A members, whose UAVs are
    dead-reckoned by a Kalman filter each.

    In every step the swarm filter is told the predicted positions with their covariances. Where it
    is ``recursive``, the positions that it finds replace those, and the rest of each state follows
    by what it has in common with them (Jeffrey's rule). Others' positions are fixes.
    """

    name = "among_anchors"
    centralized = True

    def __init__(self, believed: Believed, method: Callable[[Believed], Localizer[Any]]) -> None:
        """Raises ValueError where UAVs have no ranges between them, their motion model lacks its
        sensor, or the method keeps a window of steps."""
        super().__init__(believed)
        ranging = believed.sensor(Ranging)
        if ranging is None:
            raise ValueError("a team with ranges between UAVs is needed")
        self.process = make_process(believed)
        self.reckoning = Reckoning(believed, self.process)
        self.centres = Centres(believed, ranging)
        self.fixed = believed.sensor(PositionFix)
        fixes = self.fixed or PositionFix(_SURVEYED)
        swarm = method(self._team(ranging, fixes))
        assert isinstance(swarm, SwarmFilter)
        self.swarm, self.variance = swarm, fixes.std**2
        if self.swarm.window:
            raise ValueError("a window of steps is for teams without fixed anchors and lever arms")
        self.swarm.dense = False

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> AmongBelief:
        prior, d = observation["prior"].double(), self.process.dim
        state, covariance = self.process.initial(prior)
        anchors = self.centres.places(observation)
        theirs = prior.new_zeros(*anchors.shape[:2], prior_width(d))
        theirs[..., :d], theirs[..., -2 - d : -2] = anchors, self.variance**0.5
        swarm = self.swarm.reset(Observation({"prior": torch.cat((prior, theirs), 1)}))
        return AmongBelief(
            state=state,
            covariance=covariance,
            step=torch.zeros(state.shape[:2], dtype=torch.int64, device=state.device),
            swarm=_uavs(swarm, state.shape[1]),
            batch_size=state.shape[:2],
        )

    def step(self, belief: AmongBelief, observation: Observation) -> tuple[AmongBelief, Estimate]:
        d, dt = self.process.dim, elapsed(self.process, belief.step).double()
        before, shape = belief.state[..., :d], belief.step.shape
        state, covariance = self.reckoning.predicted(
            belief.state, belief.covariance, dt, observation
        )
        own, anchors = covariance[..., :d, :d], self.centres.places(observation)
        rotation = self.process.rotation(state)
        links, worth = self.centres.links(observation, state[..., :d], rotation)
        swarm = self._members(belief.swarm, state[..., :d], own, anchors)
        now = self.swarm.prepared(swarm, self._told(observation, links, anchors))
        now = replace(now, confidence=worth)
        found = self.swarm.find(
            swarm.replace(state=_at_rest(before, anchors)),
            replace(now, links=self.centres.surveyed(links, anchors)),
        )
        known = self.swarm.concluded(swarm, now, found)
        take = self.reckoning.placed if self.swarm.recursive else self.reckoning.fused
        position, block = found.position[:, : shape[1]], self._block(now, found, own)
        state, covariance = take(state, covariance, position, block)
        after = build(
            AmongBelief,
            shape,
            state=state,
            covariance=covariance,
            step=belief.step + 1,
            swarm=_uavs(known, shape[1]),
        )
        estimate = build(
            Estimate,
            shape,
            position=state[..., :d],
            velocity=state[..., d : 2 * d],
            covariance=covariance[..., :d, :d],
        )
        return after, estimate

    def diagnostics(self, belief: AmongBelief) -> dict[str, Float64[Tensor, "B N"]]:
        return self.swarm.diagnostics(belief.swarm)

    def _team(self, ranging: Ranging, fixes: PositionFix) -> Believed:
        """All members as the swarm filter knows them: moved by what it is told, without error."""
        members = self.believed.arena.n_uavs + self.centres.count
        return replace(
            self.believed,
            arena=replace(self.believed.arena, n_uavs=members),
            slots=members,
            process=InsDriven(),
            sensors=(Ranging(ranging.noise), Ins(std=0.0), fixes),
        )

    def _told(
        self, observation: Observation, links: Links, anchors: Float64[Tensor, "B A d"]
    ) -> Observation:
        """What the members observe: links, and fixes of anchors and of UAVs that have any. They are
        where they are by now, and do not move."""
        n = links.mask.shape[-1] - anchors.shape[1]
        known, fixed = (anchors.new_zeros(len(anchors), n, k) for k in (self.process.dim, 1))
        if self.fixed is not None:
            known, fixed = observation["position_fix"].double(), observation["position_fix_mask"]
        known = torch.cat((known, anchors), 1)
        leaves = {
            "ins": torch.zeros_like(known),
            "ranges": links.distance,
            "range_mask": links.mask,
            "position_fix": known,
            "position_fix_mask": torch.cat((fixed > 0, torch.ones_like(anchors[..., :1]) > 0), 1),
        }
        return Observation(leaves)

    def _members(
        self,
        swarm: SwarmBelief,
        place: Float64[Tensor, "B N d"],
        own: Float64[Tensor, "B N d d"],
        anchors: Float64[Tensor, "B A d"],
    ) -> SwarmBelief:
        """The belief in all members, UAVs at a place with their ``own`` covariances (m²) of it."""
        n, count = place.shape[1], anchors.shape[1]
        index = torch.arange(n + count, device=place.device)
        unsure = own.diagonal(dim1=-2, dim2=-1).mean(-1)
        variance = torch.cat((unsure, unsure.new_full((len(own), count), self.variance)), 1)
        every = swarm[:, index.clamp_max(n - 1)]
        memory, together, e = every.memory, every.joint, every.joint.shape[2]
        if memory.shape[-1]:
            theirs = swarm.memory[..., n:].mT  # a link has one memory
            memory = torch.cat((swarm.memory, torch.nn.functional.pad(theirs, (0, count))), 1)
        if together.shape[-1]:
            # One covariance for all axes needs links that surround everybody: here they do not.
            full = e == self.process.dim
            part = apart(own if full else unsure[..., None, None])
            if full and self.swarm.recursive:
                part = matched(swarm.joint, joint.own_blocks(swarm.joint), own)
            together = joint.whole(part, index[:n], variance)
        state = _at_rest(place, anchors)
        return every.replace(state=state, variance=variance, joint=together, memory=memory)

    def _block(
        self, now: Prepared, found: Found, own: Float64[Tensor, "B N d d"]
    ) -> Float64[Tensor, "B N d d"]:
        """How unsure the UAVs' positions are (m²). Where the swarm filter knows it for no single
        axis, ranges tell of their own direction."""
        n, d = own.shape[1:3]
        if found.joint is not None and found.joint.shape[2] == d:
            return joint.own_blocks(found.joint)[:, :n]
        eye = torch.eye(d, dtype=own.dtype, device=own.device)
        block = found.variance[:, :n, None, None] * eye
        if not self.swarm.recursive:
            return block
        weight, _ = self.swarm.weigh(found.position, now)
        told = self.swarm.told(weight, now)
        seen = informed(own, found.position, told, now.variance)
        return torch.where(now.fixed[:, :n, None, None], block, seen)


def is_plain(believed: Believed) -> bool:
    """Whether a team has ranges between centres alone, and positions that velocities move."""
    ranging = believed.sensor(Ranging)
    lever_arms = ranging is not None and ranging.tags
    process = make_process(believed)
    return not (lever_arms or believed.sensor(AnchorRanging) or process.error_size > process.dim)


def suited(method: type[_M]) -> type[_M]:
    """Decorator of a swarm filter: for teams that are not plain, ``agents.make`` builds what makes
    one fit for them."""

    def build(believed: Believed, **chosen: Any) -> Localizer[Any]:
        if is_plain(believed):
            return method(believed, **chosen)
        return AmongAnchors(believed, partial(method, **chosen))

    method.suited = staticmethod(build)  # type: ignore[attr-defined]
    return method


def _at_rest(
    place: Float64[Tensor, "B N d"], anchors: Float64[Tensor, "B A d"]
) -> Float64[Tensor, "B M 2*d"]:
    """States of all members there, without velocities."""
    every = torch.cat((place, anchors), 1)
    return torch.cat((every, torch.zeros_like(every)), -1)


def _uavs(swarm: SwarmBelief, n: int) -> SwarmBelief:
    """The part of the belief that anchors' own does not follow from."""
    own, e = swarm[:, :n], swarm.joint.shape[2]
    return own.replace(joint=own.joint[..., : n * e].contiguous())
