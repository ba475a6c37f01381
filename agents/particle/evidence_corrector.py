"""A correction of a particle filter's likelihood from what its particles leave of the
measurements."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn

from agents.layers import Linear
from agents.models.measurements import AnchorRanges, Measurement, UavRanges, per_state
from agents.models.process import Process
from agents.particle.belief import Step
from agents.particle.cloud import effective_sample_size, select
from agents.particle.corrector import motion_features
from agents.weights import Learned

HIDDEN = 16
MOST = 3.0  # the largest correction of a log-weight
LARGEST_SCALE = 4.0  # of a log-likelihood; its inverse is the smallest
_SOON = 5.0  # s, in which the time since the start is told apart
_LIKELY = 10.0  # of a log-likelihood below the best, in which particles are told apart
_MOVED = ("dx", "dy", "dz", "dvx", "dvy", "dvz")  # m, m/s: f of the PF-NN paper's equation 11
FEATURES = (
    *_MOVED,  # as ± log(1 + |f|)
    *("anchors_signed", "anchors_size", "anchors_largest"),  # ranges to anchors
    *("neighbours_signed", "neighbours_size", "neighbours_largest"),  # and to other UAVs
    *("others_signed", "others_size", "others_largest"),  # landmarks and all else
    "likelihood",  # below that of the cloud's best particle, bounded
    "ess",  # effective sample size as a share of the count, with this step's likelihood
    "time",  # since the start, bounded
    "spread",  # log(1 + the cloud's root mean square distance (m) from its mean, before)
)
"""What the corrector sees of a particle. Residuals are divided by their standard deviation; of a
kind of measurements it sees the mean of ± log(1 + |r|), the mean of log(1 + r²), and the largest
log(1 + r²), which are free of how many measurements there are."""
Residuals = tuple[Float[Tensor, "B N M m k"], Bool[Tensor, "B N #M m"]]  # and which there are


class EvidenceCorrector(Learned):
    """Two networks, 19–16–16–1 with tanh: of a particle's features, and of the cloud's mean
    features. Untrained they correct nothing."""

    kind = "pf_corrected"
    features = FEATURES

    def __init__(self) -> None:
        super().__init__()
        self.particle, self.cloud = _layers(), _layers()

    def forward(
        self, features: Float[Tensor, "B N M F"], mean: Float[Tensor, "B N F"]
    ) -> tuple[Float[Tensor, "B N M"], Float[Tensor, "B N"]]:
        """The correction of each particle's log-weight, within ± MOST, and the factor of all
        log-likelihoods, between 1 / LARGEST_SCALE and LARGEST_SCALE."""
        correction = MOST * torch.tanh(self.particle(features)[..., 0])
        exponent = torch.tanh(self.cloud(mean.unsqueeze(-2))[..., 0, 0])
        return correction, (math.log(LARGEST_SCALE) * exponent).exp()


def _layers() -> nn.Sequential:
    last = Linear(HIDDEN, 1)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(
        Linear(len(FEATURES), HIDDEN), nn.Tanh(), Linear(HIDDEN, HIDDEN), nn.Tanh(), last
    )


@dataclass(frozen=True)
class Seen:
    """Features of all particles, and their mean by weight after the evidence."""

    features: Float32[Tensor, "B N M F"]
    mean: Float32[Tensor, "B N F"]


def evidence_features(
    models: Sequence[Measurement],
    process: Process,
    particles: Float32[Tensor, "B N M S"],
    log_weights: Float32[Tensor, "B N M"],
    gain: Float32[Tensor, "B N M"],
    now: Step,
) -> Seen:
    """FEATURES of particles whose log-likelihoods are ``gain``; 0 where nothing was measured.

    Dead particles (of weight 0) get features, too, which count nowhere.
    """
    live, d, belief = log_weights > -torch.inf, process.dim, now.belief
    shape = particles.shape[:-1]
    centre = select(particles, log_weights.argmax(-1, keepdim=True))[..., 0, :]
    best = gain.masked_fill(~live, -torch.inf).amax(-1, keepdim=True)
    after = log_weights + gain
    ess = effective_sample_size(after) / live.sum(-1)
    time = 1 - torch.exp(-(process.dt / _SOON) * belief.step.to(gain.dtype))
    spread = _spread(particles[..., :d], log_weights).log1p()
    columns = [
        compressed(motion_features(particles, belief.last, d)),
        *residual_features(models, process, particles, centre, now),
        torch.tanh((gain - best).clamp_max(0.0) / _LIKELY).unsqueeze(-1),
        *(x[..., None, None].expand(*shape, 1) for x in (ess, time, spread)),
    ]
    features = torch.cat(columns, -1)
    weights = after.double().softmax(-1)
    mean = (weights.unsqueeze(-1) * features.double()).sum(-2)
    return Seen(features, mean.to(features.dtype))


def residual_features(
    models: Sequence[Measurement],
    process: Process,
    particles: Float32[Tensor, "B N M S"],
    centre: Float32[Tensor, "B N S"],
    now: Step,
) -> list[Float32[Tensor, "B N M 3"]]:
    """Summaries of normalized residuals to anchors, to other UAVs, and of all else. Variances of
    ranges are those at the ``centre``, as in the likelihood."""
    seen, near = now.observation, now.neighbours
    kinds: list[list[Residuals]] = [[], [], []]
    for model in models:
        if isinstance(model, AnchorRanges | UavRanges) and not model.tags:
            at_centre = model.linearize(process, centre, seen, near, derivatives=False)
            ranges, points = model.ends(seen, near)
            own, points = particles[..., : process.dim], points.to(particles.dtype)
            residual = ranges.to(own.dtype).unsqueeze(-2) - distances(own, points)
            std = at_centre.total_variance.sqrt()[..., 0].to(own.dtype).unsqueeze(-2)
            found = (residual / std).unsqueeze(-1), at_centre.mask.unsqueeze(-2)
        else:
            around = per_state(seen, near)
            block = model.linearize(process, particles, *around, derivatives=False)
            found = block.residual / block.total_variance.sqrt(), block.mask
        kind = 0 if isinstance(model, AnchorRanges) else 1 if isinstance(model, UavRanges) else 2
        kinds[kind].append(found)
    none = torch.zeros_like(particles[..., :3])
    return [summary(found).to(none.dtype) if found else none for found in kinds]


def distances(
    own: Float[Tensor, "B N M d"], points: Float[Tensor, "B N m d"]
) -> Float[Tensor, "B N M m"]:
    """From each particle to each point, m."""
    axes = zip(own.unbind(-1), points.unbind(-1), strict=True)
    squares = ((mine.unsqueeze(-1) - theirs.unsqueeze(-2)).square() for mine, theirs in axes)
    return sum(squares, torch.zeros_like(points[..., None, :, 0])).sqrt()


def summary(found: Sequence[Residuals]) -> Float[Tensor, "B N M 3"]:
    """Mean of ± log(1 + |r|), mean and largest of log(1 + r²) over all measurements; r² is the mean
    over a measurement's components."""
    signed, size, there = [], [], []
    for r, mask in found:
        signed.append(compressed(r).mean(-1))
        size.append(r.square().mean(-1).log1p())
        there.append(mask.expand(r.shape[:-1]))
    exists = torch.cat(there, -1)
    count = exists.sum(-1).clamp_min(1)
    means = [torch.cat(x, -1).masked_fill(~exists, 0.0) for x in (signed, size)]
    largest = means[1].amax(-1) if exists.shape[-1] else torch.zeros_like(means[1].sum(-1))
    return torch.stack((*(x.sum(-1) / count for x in means), largest), -1)


def compressed(x: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """± log(1 + |x|)."""
    return x.sign() * x.abs().log1p()


def _spread(
    position: Float32[Tensor, "B N M d"], log_weights: Float32[Tensor, "B N M"]
) -> Float32[Tensor, "B N"]:
    """Root mean square distance (m) from the weighted mean."""
    weights = log_weights.double().softmax(-1).unsqueeze(-1)
    exact = position.double()
    mean = (weights * exact).sum(-2, keepdim=True)
    return (weights * (exact - mean).square()).sum((-2, -1)).sqrt().to(position.dtype)
