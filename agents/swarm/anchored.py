"""Swarm filters for teams with anchors, lever arms, heights, or a full motion model.

A swarm filter estimates positions from an INS's velocities and links between centres. All else is
added around it: the full motion model, heights, slow flight, optical flow and time differences,
lever arms, and anchors, which become members of the team with position fixes.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import torch
from jaxtyping import Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.filter import elapsed
from agents.localizer import Estimate, Localizer
from agents.models.biases import Biases, reported
from agents.models.measurements import make_measurements
from agents.models.process import make_process
from agents.swarm import joint
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.centres import Centres
from agents.swarm.considered import Moments, after_step
from agents.swarm.filter import SwarmFilter
from agents.swarm.links import Links
from agents.swarm.marginals import block_diagonal, range_update, with_marginals
from agents.swarm.navigation import NavigationFilter, all_have_fixes
from agents.tensorclasses import build
from coloc_env.observation import Observation, prior_width
from coloc_env.scenario import Believed, InsDriven
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    Ins,
    OpticalFlow,
    PositionFix,
    Ranging,
    SlowFlight,
    Tdoa,
)
from coloc_env.sensors.base import usable

_M = TypeVar("_M", bound=SwarmFilter)
_SURVEYED = 1e-3  # m: standard deviation of anchors' positions, per axis
_MIN_VARIANCE = 1e-6  # m² per axis: of a position that is believed to be exact


class AnchoredBelief(TensorClass):
    """State and error covariance of each UAV's motion model, what sensors' biases have made of the
    error (see ``agents.models.biases``), steps taken, and the UAVs' part of the swarm filter's
    belief in the team and the anchors; batch (B, N)."""

    state: Float64[Tensor, "B N S"]
    covariance: Float64[Tensor, "B N E E"]
    considered: Float64[Tensor, "B N E G"]
    step: Int64[Tensor, "B N"]
    swarm: SwarmBelief


class AnchoredTeam(Localizer[AnchoredBelief]):
    """A swarm filter (``method``) for N UAVs and A anchors, M = N + A members, with a navigation
    filter for each UAV.

    In every step the swarm filter has the predicted positions with their covariances as its prior.
    If it is ``recursive``, its positions replace them, and the rest of each state follows by its
    covariance with the position (Jeffrey's rule). If not, its positions are measurements.
    """

    name = "anchored"
    centralized = True

    def __init__(self, believed: Believed, method: Callable[[Believed], Localizer[Any]]) -> None:
        """Raises ValueError where UAVs have no ranges between them, their motion model lacks its
        sensor, or the method keeps a window of steps."""
        super().__init__(believed)
        ranging = believed.sensor(Ranging)
        if ranging is None:
            raise NotServed("a team with ranges between UAVs is needed")
        self.process = make_process(believed)
        self.navigation = NavigationFilter(believed, self.process)
        self.centres = Centres(believed, ranging)
        self.fixed = None if all_have_fixes(believed) else believed.sensor(PositionFix)
        fixes = self.fixed or PositionFix(_SURVEYED)
        swarm = method(self._team(ranging, fixes))
        assert isinstance(swarm, SwarmFilter)
        self.swarm = swarm
        self.variance = max(fixes.axis_std(self.process.dim)) ** 2
        if self.swarm.window:
            raise NotServed("a window of steps is for teams without fixed anchors and lever arms")
        self.swarm.dense = False
        models = make_measurements(believed)
        self.biases = Biases([m for m in models if m.bias_std], self.process.dt)

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> AnchoredBelief:
        prior, d = observation["prior"].double(), self.process.dim
        state, covariance = self.process.initial(prior)
        anchors = self.centres.anchor_positions(observation)
        anchor_prior = prior.new_zeros(*anchors.shape[:2], prior_width(d))
        anchor_prior[..., :d], anchor_prior[..., -2 - d : -2] = anchors, self.variance**0.5
        swarm = self.swarm.reset(Observation({"prior": torch.cat((prior, anchor_prior), 1)}))
        return AnchoredBelief(
            state=state,
            covariance=covariance,
            considered=self.biases.initial(observation, covariance),
            step=torch.zeros(state.shape[:2], dtype=torch.int64, device=state.device),
            swarm=_uavs(swarm, state.shape[1]),
            batch_size=state.shape[:2],
        )

    def step(
        self, belief: AnchoredBelief, observation: Observation
    ) -> tuple[AnchoredBelief, Estimate]:
        d, dt = self.process.dim, elapsed(self.process, belief.step).double()
        before, shape = belief.state[..., :d], belief.step.shape
        state, covariance = self.navigation.predict(
            belief.state, belief.covariance, dt, observation
        )
        prior = _regular(covariance[..., :d, :d])
        anchors = self.centres.anchor_positions(observation)
        rotation = self.process.rotation(state)
        links, weight = self.centres.links(observation, state[..., :d], rotation)
        swarm = self._members(belief.swarm, state[..., :d], prior, anchors)
        inputs = self.swarm.predict(swarm, self._member_observation(observation, links, anchors))
        inputs = replace(inputs, confidence=weight)
        solution = self.swarm.solve(
            swarm.replace(state=_at_rest(before, anchors)),
            replace(inputs, links=self.centres.with_surveyed(links, anchors)),
        )
        updated = self.swarm.update(swarm, inputs, solution)
        position = solution.position[:, : shape[1]]
        posterior = self._marginals(inputs, solution, prior)
        recursive = self.swarm.recursive
        take = self.navigation.replace_marginal if recursive else self.navigation.update
        state, covariance = take(state, covariance, position, posterior)
        considered = after_step(
            self.biases,
            self.process,
            belief.considered,
            Moments(belief.state, belief.covariance),
            Moments(state, covariance),
            dt,
            observation,
        )
        after = build(
            AnchoredBelief,
            shape,
            state=state,
            covariance=covariance,
            considered=considered,
            step=belief.step + 1,
            swarm=_uavs(updated, shape[1]),
        )
        estimate = build(
            Estimate,
            shape,
            position=state[..., :d],
            velocity=state[..., d : 2 * d],
            covariance=reported(covariance, considered)[..., :d, :d],
        )
        return after, estimate

    def mean(self, belief: AnchoredBelief) -> Float64[Tensor, "B N S"]:
        return belief.state

    def shifted(self, belief: AnchoredBelief, offset: Float64[Tensor, "B N d"]) -> AnchoredBelief:
        d, state = self.process.dim, belief.state
        position = state[..., :d] + offset
        return belief.replace(state=torch.cat((position, state[..., d:]), -1))

    def diagnostics(self, belief: AnchoredBelief) -> dict[str, Float64[Tensor, "B N"]]:
        return self.swarm.diagnostics(belief.swarm)

    def _team(self, ranging: Ranging, fixes: PositionFix) -> Believed:
        """The team of all members, which the swarm filter does not move."""
        members = self.believed.arena.n_uavs + self.centres.count
        return replace(
            self.believed,
            arena=replace(self.believed.arena, n_uavs=members),
            slots=members,
            process=InsDriven(),
            sensors=(Ranging(replace(ranging.noise, bias_std=0.0)), Ins(std=0.0), fixes),
        )

    def _member_observation(
        self, observation: Observation, links: Links, anchors: Float64[Tensor, "B A d"]
    ) -> Observation:
        """What the members observe: links, and fixes of anchors and of UAVs that have one. Their
        positions are predicted already, so that their velocity is zero."""
        n = links.mask.shape[-1] - anchors.shape[1]
        fix = anchors.new_zeros(len(anchors), n, self.process.dim)
        fixed = torch.zeros_like(fix[..., :1], dtype=torch.bool)
        if self.fixed is not None:
            there = observation["position_fix_mask"] > 0
            z, fixed = usable(observation["position_fix"].double().unsqueeze(-2), there)
            fix = z[..., 0, :]
        fix = torch.cat((fix, anchors), 1)
        leaves = {
            "ins": torch.zeros_like(fix),
            "ranges": links.distance,
            "range_mask": links.mask,
            "position_fix": fix,
            "position_fix_mask": torch.cat((fixed, torch.ones_like(anchors[..., :1]) > 0), 1),
        }
        return Observation(leaves)

    def _members(
        self,
        swarm: SwarmBelief,
        position: Float64[Tensor, "B N d"],
        prior: Float64[Tensor, "B N d d"],
        anchors: Float64[Tensor, "B A d"],
    ) -> SwarmBelief:
        """The belief in all members, UAVs at these positions with ``prior`` covariances (m²)."""
        n, count = position.shape[1], anchors.shape[1]
        index = torch.arange(n + count, device=position.device)
        own = prior.diagonal(dim1=-2, dim2=-1).mean(-1)
        variance = torch.cat((own, own.new_full((len(prior), count), self.variance)), 1)
        members = self.swarm.of_members(swarm, count)
        covariance, e = members.joint, members.joint.shape[2]
        if covariance.shape[-1]:
            # One covariance for all axes needs links in all directions, which are lacking here.
            full = e == self.process.dim
            part = block_diagonal(prior if full else own[..., None, None])
            if full and self.swarm.recursive:
                part = with_marginals(swarm.joint, joint.marginals(swarm.joint), prior)
            covariance = joint.embed(part, index[:n], variance)
        return members.replace(
            state=_at_rest(position, anchors),
            variance=variance,
            joint=covariance,
        )

    def _marginals(
        self, inputs: StepInput, solution: Solution, prior: Float64[Tensor, "B N d d"]
    ) -> Float64[Tensor, "B N d d"]:
        """Covariances of the UAVs' positions (m²). Where the swarm filter has but one variance for
        all axes, they are the prior ones, updated by each range in its direction."""
        n, d = prior.shape[1:3]
        if solution.joint is not None and solution.joint.shape[2] == d:
            return joint.marginals(solution.joint)[:, :n]
        eye = torch.eye(d, dtype=prior.dtype, device=prior.device)
        isotropic = solution.variance[:, :n, None, None] * eye
        if not self.swarm.recursive:
            return isotropic
        weight, _ = self.swarm.weights(solution.position, inputs)
        information = self.swarm.confidence.information(weight, inputs)
        updated = range_update(prior, solution.position, information, inputs.variance)
        return torch.where(inputs.fixed[:, :n, None, None], isotropic, updated)


def is_plain(believed: Believed) -> bool:
    """Whether a swarm filter alone serves a team: ranges between centres only, and no states but
    positions."""
    ranging = believed.sensor(Ranging)
    lever_arms = ranging is not None and ranging.tags
    kinds = (AnchorRanging, Height, OpticalFlow, SlowFlight, Tdoa)
    others = any(believed.sensor(kind) for kind in kinds) or all_have_fixes(believed)
    process = make_process(believed)
    return not (lever_arms or others or process.error_size > process.dim)


def supports_anchors(method: type[_M]) -> type[_M]:
    """Decorator of a swarm filter: for teams that are not plain, ``agents.make`` builds an
    ``AnchoredTeam`` around it."""

    def build(believed: Believed, **chosen: Any) -> Localizer[Any]:
        if is_plain(believed):
            return method(believed, **chosen)
        return AnchoredTeam(believed, partial(method, **chosen))

    method.for_team = staticmethod(build)  # type: ignore[attr-defined]
    return method


def _at_rest(
    position: Float64[Tensor, "B N d"], anchors: Float64[Tensor, "B A d"]
) -> Float64[Tensor, "B M 2*d"]:
    """States of all members at these positions, with velocity zero."""
    members = torch.cat((position, anchors), 1)
    return torch.cat((members, torch.zeros_like(members)), -1)


def _uavs(swarm: SwarmBelief, n: int) -> SwarmBelief:
    """The UAVs' rows of the belief, and their columns of the joint covariance."""
    own, e = swarm[:, :n], swarm.joint.shape[2]
    return own.replace(joint=own.joint[..., : n * e].contiguous())


def _regular(covariance: Float64[Tensor, "B N d d"]) -> Float64[Tensor, "B N d d"]:
    """Covariances of positions (m²), with ``_MIN_VARIANCE`` where they are believed exact."""
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    return covariance + torch.diag_embed(
        (variance < _MIN_VARIANCE).to(torch.float32) * _MIN_VARIANCE
    )
