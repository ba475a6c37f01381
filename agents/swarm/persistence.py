"""How long links stay NLOS: a two-state Markov chain (line of sight, NLOS) for every link.

Between two steps the state is kept with probability ρ and drawn again otherwise. ρ is estimated by
online EM (Dempster, Laird & Rubin 1977; Cappé, J. Comput. Graph. Stat. 2011) from the links whose
length is known best: expected counts of transitions, given all errors so far.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.swarm.calibration import MEMORY_STEPS

_STRENGTH = 20.0  # weight of the initial counts, in links
_MAX_PERSISTENCE = 0.97  # largest ρ
_MIN_PROBABILITY = 1e-3  # of either state


def prior_counts(share: Float64[Tensor, "B"]) -> Float64[Tensor, "B 2 2"]:
    """Expected counts of (state before, state now) without persistence (ρ = 0), a ``share`` of all
    links NLOS."""
    each = torch.stack((1 - share, share), -1)
    return _STRENGTH * each.unsqueeze(-1) * each.unsqueeze(-2)


def persistence(counts: Float64[Tensor, "B 2 2"]) -> Float64[Tensor, "B"]:
    """ρ = P(NLOS | NLOS before) − P(NLOS | line of sight before)."""
    to = counts[..., 1] / counts.sum(-1)
    return (to[:, 1] - to[:, 0]).clamp(0.0, _MAX_PERSISTENCE)


def predict(
    before: Float64[Tensor, "B L"], rho: Float64[Tensor, "B"], share: Float64[Tensor, "B"]
) -> Float64[Tensor, "B L"]:
    """Probability π + ρ (p − π) that a link is NLOS, from its probability p in the step
    ``before``, π the ``share`` of all links."""
    share = share.unsqueeze(-1)
    return (share + rho.unsqueeze(-1) * (before - share)).clamp(
        _MIN_PROBABILITY, 1 - _MIN_PROBABILITY
    )


def update(
    counts: Float64[Tensor, "B 2 2"],
    before: Float64[Tensor, "B L"],
    evidence: Float64[Tensor, "B L"],
    count: Float64[Tensor, "B L"],
    share: Float64[Tensor, "B"],
) -> Float64[Tensor, "B 2 2"]:
    """The counts after a step: expected transitions of links, each taken ``count`` times, given
    ``evidence``, the log-likelihood ratio of NLOS."""
    rho = persistence(counts)
    after = [
        predict(torch.full_like(before, was), rho, share) for was in (0.0, 1.0)
    ]  # P(NLOS | state before)
    likelihood = torch.stack((torch.zeros_like(evidence), evidence), -1).softmax(-1)
    moves = torch.stack([torch.stack((1 - to, to), -1) for to in after], -2)
    joint = torch.stack((1 - before, before), -1).unsqueeze(-1) * moves * likelihood.unsqueeze(-2)
    joint = joint / joint.sum((-2, -1), keepdim=True)
    expected = (joint * count[..., None, None]).sum(1)
    return counts * (1 - 1 / MEMORY_STEPS) + prior_counts(share) / MEMORY_STEPS + expected
