"""What a swarm's localizer knows between steps, what a step brings, and what is found from it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm.calibration import ErrorModel
from agents.swarm.delays import Delays
from agents.swarm.drift import Drift
from agents.swarm.links import Links
from agents.swarm.window import History

UNKNOWN = 1e12  # m²: variance of a position of which nothing is known


class SwarmBelief(TensorClass):
    """Dead-reckoned state with the position last found, that position's variance (m², per axis) and
    its rows of the team's joint covariance (``agents.swarm.joint``, m²; none where it is not kept);
    the INS's bias (m/s) with its covariance with the position (m²/s) and its variance (m²/s²);
    steps taken; and, the same for all, what is remembered of ranges' errors and of how links change
    between clean and obstructed; of each link how likely it is obstructed (``paper``: how often it
    was silent; none where that is not used); whether the UAV is ``localizable``: connected to so
    many with fixes that they settle a position, d + 1; the ``past`` steps of a sliding window (none
    where there is no such); what antennas add to ranges (``delays``). Batch (B, N)."""

    state: Float64[Tensor, "B N S"]
    variance: Float64[Tensor, "B N"]
    joint: Float64[Tensor, "B N e K"]
    bias: Float64[Tensor, "B N d"]
    drift: Float64[Tensor, "B N 2"]
    step: Int64[Tensor, "B N"]
    errors: Float64[Tensor, "B N 2 3"]
    chain: Float64[Tensor, "B N 2 2"]
    memory: Float64[Tensor, "B N L"]
    localizable: Bool[Tensor, "B N"]
    past: History
    delays: Delays


@dataclass(frozen=True)
class Prepared:
    """What a step has to find positions from: everybody's dead-reckoned ``state``, its ``place`` by
    dead reckoning or fix (m), that place's ``variance`` (m² per axis) and what the step ``added``
    to it, who is ``fixed``, the ``links``, the ``model`` of their errors; the variance that dead
    reckoning alone has (``reckoned``), the joint covariance of the places (none where it is not
    kept), the variance of the vectors ``between`` them (m² per axis), the INS's ``drift`` (None:
    not estimated), how links change (``chain``), the probability that each is an ``outlier``
    beforehand (None: as many as there are in all), how often each was ``silent`` (``paper`` only);
    and by what factor each link's weight is changed from outside (``confidence``: held down in
    [0, 1], above where it stands for several ranges; None: not at all); the ``past`` steps as they
    look from now (None: no window); what antennas add to ranges (``delays``), taken off the links'
    distances as far as it is known."""

    state: Float64[Tensor, "B N S"]
    place: Float64[Tensor, "B N d"]
    variance: Float64[Tensor, "B N"]
    added: Float64[Tensor, "B N"]
    fixed: Bool[Tensor, "B N"]
    links: Links
    model: ErrorModel
    reckoned: Float64[Tensor, "B N"]
    joint: Float64[Tensor, "B N e K"]
    between: Float64[Tensor, "B N N"]
    drift: Drift | None
    chain: Float64[Tensor, "B 2 2"]
    delays: Delays
    outlier: Float64[Tensor, "B N N"] | None = None
    silent: Float64[Tensor, "B N N"] | None = None
    confidence: Float64[Tensor, "B N N"] | None = None
    past: History | None = None


@dataclass(frozen=True)
class Found:
    """Positions (m), their variance (m² per axis), the joint covariance if there is one, the window
    of steps with this one in it and what antennas add to ranges (None: as it was)."""

    position: Float64[Tensor, "B N d"]
    variance: Float64[Tensor, "B N"]
    joint: Float64[Tensor, "B N e K"] | None = None
    past: History | None = None
    delays: Delays | None = None


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
        between=torch.where(known.unsqueeze(-1) & known.unsqueeze(-2), now.between, UNKNOWN),
    )
