"""What the factor network sees of links and UAVs, and what is remembered of them.

All is dimensionless: lengths are in standard deviations of a range.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.stdcl.features import link_gain
from agents.swarm.belief import StepInput
from agents.swarm.expectation_propagation import Cavity, Sites
from agents.swarm.links import lengths
from agents.swarm.persistence import persistence
from agents.tensorclasses import build

LINKS = (
    *("residual", "size", "log_variance", "log_weight", "shift", "nlos_before", "nlos"),
    *("mean_residual", "mean_size", "mean_nlos", "seen", "relative_speed", "confidence"),
)
NODES = (
    *("log_degree", "fixed_neighbours", "fixed", "prior_spread", "step_spread"),
    *("outlier_share", "clean_std", "outlier_bias", "outlier_std", "persistence", "age"),
)
SPEED, CONFIDENCE = LINKS.index("relative_speed"), LINKS.index("confidence")
_CLIP = 5.0  # standard deviations
_TINY = 1e-3  # of probabilities, and of variances in those of a range


class LinkMeans(TensorClass):
    """Of each link the running means of the normalized ``residual``, its ``magnitude`` and its
    probability of NLOS (``outlier``), and the count of its ranges (``seen``); batch (B, N)."""

    residual: Float64[Tensor, "B N N"]
    magnitude: Float64[Tensor, "B N N"]
    outlier: Float64[Tensor, "B N N"]
    seen: Float64[Tensor, "B N N"]


@dataclass(frozen=True)
class Features:
    """Of each ``link`` (LINKS), each ``node`` (NODES), and which links there are."""

    link: Float64[Tensor, "B N N L"]
    node: Float64[Tensor, "B N F"]
    mask: Bool[Tensor, "B N N"]


def no_means(like: Float64[Tensor, "B N"]) -> LinkMeans:
    """Before any range."""
    n = like.shape[1]
    parts = {
        name: like.new_zeros(*like.shape, n)
        for name in ("residual", "magnitude", "outlier", "seen")
    }
    return build(LinkMeans, like.shape, **parts)


def features(
    inputs: StepInput,
    at: Cavity,
    sites: Sites,
    means: LinkMeans,
    step: Float64[Tensor, "B N"],
    std: float,
) -> tuple[Features, LinkMeans]:
    """The network's inputs at a pass of expectation propagation, and the means with this step;
    ``step``: steps taken before, ``std`` of ranges in m."""
    mask, d = inputs.links.mask, inputs.prior.shape[-1]
    there = mask.double()
    z = (at.residual / (at.variance + std**2).sqrt()).clamp(-_CLIP, _CLIP) * there
    outlier = sites.outlier
    means = _updated(means, mask, z, outlier)
    before = inputs.outlier_probability
    before = inputs.error_model.share[:, 1, None, None] if before is None else before
    confidence = (sites.weight * std**2).clamp_max(1.0)
    speed = torch.log1p(lengths(inputs.state[..., d : 2 * d]) / std)
    link = torch.stack(
        (
            z,
            z.abs(),
            torch.log(at.variance / std**2 + _TINY) / 4,
            torch.log(sites.weight * std**2 + _TINY) / 2,
            (sites.shift / std).clamp(-_CLIP, _CLIP) / 3,
            _logit(before).expand_as(z) / 4,
            _logit(outlier) / 4,
            means.residual,
            means.magnitude,
            means.outlier,
            torch.log1p(means.seen) / 3,
            speed / 4,
            confidence,
        ),
        -1,
    )
    node = _nodes(inputs, there, step, std)
    return Features(link * there.unsqueeze(-1), node, mask), means


def _nodes(
    inputs: StepInput, there: Float64[Tensor, "B N N"], step: Float64[Tensor, "B N"], std: float
) -> Float64[Tensor, "B N F"]:
    count = there.sum(-1)
    fixed = inputs.fixed.double()
    bias, variance = inputs.error_model.component(std)
    everywhere = torch.stack(
        (
            inputs.error_model.share[:, 1],
            torch.log(variance[:, 0] / std**2),
            bias[:, 1] / std / 4,
            torch.log(variance[:, 1] / std**2) / 4,
            persistence(inputs.transitions),
        ),
        -1,
    )
    own = torch.stack(
        (
            torch.log1p(count) / 4,
            (there @ fixed.unsqueeze(-1))[..., 0] / count.clamp_min(1.0),
            fixed,
            torch.log(inputs.variance / std**2 + _TINY) / 4,
            torch.log(inputs.process_noise.clamp_min(0.0) / std**2 + _TINY) / 4,
        ),
        -1,
    )
    age = (1 / (1 + step)).unsqueeze(-1)
    return torch.cat((own, everywhere.unsqueeze(1).expand(-1, own.shape[1], -1), age), -1)


def _updated(
    means: LinkMeans,
    mask: Bool[Tensor, "B N N"],
    z: Float64[Tensor, "B N N"],
    outlier: Float64[Tensor, "B N N"],
) -> LinkMeans:
    """Arithmetic means at first, then exponential; that of a link without ranges loses weight."""
    seen, gain = link_gain(means.seen, mask)
    new = {"residual": z, "magnitude": z.abs(), "outlier": outlier}
    parts = {
        name: getattr(means, name) + gain * (value - getattr(means, name))
        for name, value in new.items()
    }
    return build(LinkMeans, means.batch_size, seen=seen, **parts)


def _logit(probability: Tensor) -> Tensor:
    return torch.logit(probability.clamp(_TINY, 1 - _TINY))
