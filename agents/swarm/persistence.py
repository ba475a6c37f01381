"""How long links stay obstructed: a two-state Markov chain (clean, obstructed) for every link.

Between two steps the state is drawn anew with probability 1 − ρ, and kept otherwise. ρ is learned
by EM on the links whose length is known, whose state is seen best (Dempster, Laird & Rubin 1977;
online as in Cappé, J. Comput. Graph. Stat. 2011): expected transitions, given all errors so far.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.swarm.calibration import FORGET

_STRENGTH = 20.0  # links' worth of belief in chance at the start
_LONGEST = 0.97  # ρ: the state is never taken for granted
_LEAST = 1e-3  # probability of either state, at least


def believed_chain(share: Float64[Tensor, "B"]) -> Float64[Tensor, "B 2 2"]:
    """Expected counts of (state before, state now) when it is pure chance, ``share`` of all
    obstructed."""
    each = torch.stack((1 - share, share), -1)
    return _STRENGTH * each.unsqueeze(-1) * each.unsqueeze(-2)


def persistence(counts: Float64[Tensor, "B 2 2"]) -> Float64[Tensor, "B"]:
    """ρ = P(obstructed | obstructed before) − P(obstructed | clean before)."""
    to = counts[..., 1] / counts.sum(-1)
    return (to[:, 1] - to[:, 0]).clamp(0.0, _LONGEST)


def forecast(
    before: Float64[Tensor, "B L"], rho: Float64[Tensor, "B"], share: Float64[Tensor, "B"]
) -> Float64[Tensor, "B L"]:
    """Probability that a link is obstructed, from what it was in the step ``before``."""
    share = share.unsqueeze(-1)
    return (share + rho.unsqueeze(-1) * (before - share)).clamp(_LEAST, 1 - _LEAST)


def learned(
    counts: Float64[Tensor, "B 2 2"],
    before: Float64[Tensor, "B L"],
    evidence: Float64[Tensor, "B L"],
    count: Float64[Tensor, "B L"],
    share: Float64[Tensor, "B"],
) -> Float64[Tensor, "B 2 2"]:
    """The counts after a step, with the expected transitions of links, each taken ``count``
    times."""
    rho = persistence(counts)
    after = [
        forecast(torch.full_like(before, was), rho, share) for was in (0.0, 1.0)
    ]  # P(obstructed | state before)
    likely = torch.stack((torch.zeros_like(evidence), evidence), -1).softmax(-1)
    moves = torch.stack([torch.stack((1 - to, to), -1) for to in after], -2)
    joint = torch.stack((1 - before, before), -1).unsqueeze(-1) * moves * likely.unsqueeze(-2)
    joint = joint / joint.sum((-2, -1), keepdim=True)
    seen = (joint * count[..., None, None]).sum(1)
    return counts * (1 - 1 / FORGET) + believed_chain(share) / FORGET + seen
