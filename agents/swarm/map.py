"""References for swarms that keep all correlations of a team: the snapshot's and the recursive one.

Gauss–Newton over the joint position of all UAVs, without a prior (``gn``) and with the joint
covariance that dead reckoning has carried on (``map``).
"""

from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.localizer import register
from agents.swarm import delays, joint
from agents.swarm.among_anchors import suited
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.filter import Confidence, SwarmFilter
from agents.swarm.gauss_newton import coordinates, gauss_newton, informed
from agents.swarm.links import lengths
from agents.swarm.obstruction import unsure
from coloc_env.scenario import Believed

_AGAIN = 3  # times that a first step is solved once more


class _Joint(SwarmFilter):
    """Gauss–Newton with ``iterations`` a step."""

    def __init__(
        self,
        believed: Believed,
        confidence: Confidence,
        iterations: int,
        bias: bool = False,
        delays: bool = False,
    ) -> None:
        super().__init__(believed, confidence, bias, delays)
        if iterations < 1:
            raise ValueError(f"iterations={iterations} is not allowed: at least 1")
        self.iterations = iterations

    def joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N d K"]:
        return joint.independent(variance, self.process.dim)

    def solved(
        self, now: Prepared, precision: Float64[Tensor, "B K K"], start: Float64[Tensor, "B N d"]
    ) -> Found:
        """Positions, and the inverse of their joint information."""
        position, late, _ = gauss_newton(
            start,
            now.links.distance,
            lambda residual: self.weigh_residual(residual, now),
            now.fixed,
            now.place,
            precision,
            self.iterations,
        )
        residual = now.links.distance - lengths(position) - delays.added(late)
        weight, _ = self.weigh_residual(residual, now)
        d, size = self.process.dim, precision.shape[-1]
        told = informed(position, self.told(weight, now), self.clock is not None)
        known = now.variance.repeat_interleave(d, -1)
        known = torch.nn.functional.pad(known, (0, size - known.shape[-1]))
        still = coordinates(now.fixed, d, size)
        covariance = joint.left_by(told + precision, still, known)
        together, learned = delays.parts(covariance, now.delays.delay + late, d)
        return Found(position, joint.variances(together), together, delays=learned)


@register("gn", suited)
class Snapshot(_Joint):
    """Gauss–Newton on the ranges of one step, started where dead reckoning is. ``confidence``:
    ``huber``, ``em`` or ``none``, as ``dwmds_st`` has it."""

    name = "gn"
    recursive = False

    def __init__(
        self, believed: Believed, *, confidence: Confidence = "huber", iterations: int = 6
    ) -> None:
        super().__init__(believed, confidence, iterations)

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        return self.solved(now, torch.zeros_like(belief.joint.flatten(1, 2)), now.place)


@register("map", suited)
class RecursiveMap(_Joint):
    """Recursive maximum a posteriori with the team's full covariance. ``confidence``: ``em``,
    ``huber`` or ``none``, and ``bias``, as ``dwmds_st`` has them. ``delays=false`` does not
    estimate what clocks and antennas add to ranges.

    In a swarm's first step ranges are weighed anew by what is unsure of where UAVs are by then: a
    prior of many noises' width cannot tell good ranges from bad. Few links could agree on a wrong
    place: where they are not dense, the first weights stay."""

    name = "map"

    def __init__(
        self,
        believed: Believed,
        *,
        confidence: Confidence = "em",
        iterations: int = 3,
        bias: bool = True,
        delays: bool = True,
    ) -> None:
        super().__init__(believed, confidence, iterations, bias, delays)

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        whole = delays.whole(now.joint, now.delays)
        still = coordinates(now.fixed, self.process.dim, whole.shape[-1])
        known = joint.held_by(whole, still)
        found = self.solved(now, known, now.place)
        begins = (belief.step == 0).any(-1)[:, None, None]
        for _ in range(_AGAIN if self.dense and bool(begins.any()) else 0):
            between = torch.where(begins, unsure(now, found), now.between)
            now = replace(now, between=between)
            found = self.solved(now, known, torch.where(begins, found.position, now.place))
        return found
