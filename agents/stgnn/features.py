"""What the graph network sees of a step: scalars, vectors in metres, and links.

All scalars are free of units: lengths are counted in standard deviations of a range or of the UAV's
own position. Sums over links are weighted means, so that teams of any size look alike.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm.filter import Found, Prepared
from agents.swarm.links import lengths

SCALARS = (
    *("log_degree", "fixed_neighbours", "fixed", "confidence"),
    *("prior_spread", "found_spread", "step_spread", "spread_shape", "prior_share"),
    *("residual_mean", "residual_rms", "residual_far", "residual_long"),
    *("lasting_mean", "lasting_size", "relative_speed"),
    *("outlier_share", "clean_std", "outlier_bias", "outlier_std", "age"),
)
VECTORS = (
    *("newton", "prior_pull", "clipped", "tukey", "long", "lasting"),
    *("innovation", "mean_innovation", "slow_innovation"),
)
LINKS = ("residual", "size", "lasting", "lasting_size", "seen", "confidence", "relative_speed")
_CLIP = 5.0  # standard deviations
_SOFT = 2.0
_TUKEY = 4.685
_LINK_TIME = 8.0  # steps over which a link's residual is averaged
_TIMES = (10.0, 40.0)  # steps over which innovations are averaged


class Memory(TensorClass):
    """Per UAV: each link's running mean ``residual`` (m) and how often it was ``seen``, running
    means of the ``innovations`` (m), and the steps taken; batch (B, N)."""

    residual: Float64[Tensor, "B N N"]
    seen: Float64[Tensor, "B N N"]
    innovations: Float64[Tensor, "B N d 2"]
    steps: Float64[Tensor, "B N"]


@dataclass(frozen=True)
class Scene:
    """Inputs of the network: ``scalars`` and ``vectors`` (m) of nodes, ``link`` scalars, which are
    there (``mask``), who ``moves``, and what carries a displacement along links: unit vectors by
    ``position`` (m, centred) and ``length``, ``weight`` (1/m²), and ``gain`` H⁻¹ (m²) of links and
    of the ``trust`` (1/m²) in dead reckoning."""

    scalars: Float64[Tensor, "B N F"]
    vectors: Float64[Tensor, "B N d C"]
    link: Float64[Tensor, "B N N L"]
    mask: Bool[Tensor, "B N N"]
    moves: Bool[Tensor, "B N"]
    position: Float64[Tensor, "B N d"]
    length: Float64[Tensor, "B N N"]
    weight: Float64[Tensor, "B N N"]
    gain: Float64[Tensor, "B N d d"]
    trust: Float64[Tensor, "B N"]

    def to(self, like: Tensor) -> "Scene":
        """The same in another precision."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return Scene(**{k: x if x.dtype == torch.bool else x.to(like) for k, x in parts.items()})


def forgotten(worlds: int, n: int, dim: int, device: torch.device) -> Memory:
    """The memory of teams that have seen nothing."""
    zeros = torch.zeros(worlds, n, n, dtype=torch.float64, device=device)
    return Memory(
        residual=zeros,
        seen=zeros.clone(),
        innovations=zeros.new_zeros(worlds, n, dim, len(_TIMES)),
        steps=zeros.new_zeros(worlds, n),
        batch_size=(worlds, n),
    )


def along_links(
    y: Float64[Tensor, "B N d"], strength: Float64[Tensor, "B *K N N"], length: Tensor
) -> Float64[Tensor, "B *K N d"]:
    """Σ_j s_ij u_ij, u_ij the unit vector from j to i."""
    s = strength / length
    return s.sum(-1, keepdim=True) * y - s @ y


def information(
    y: Float64[Tensor, "B N d"],
    weight: Float64[Tensor, "B N N"],
    length: Float64[Tensor, "B N N"],
) -> Float64[Tensor, "B N d d"]:
    """Σ_j W_ij u_ij u_ijᵀ (1/m²): what links say of a UAV whose neighbours stand still."""
    s = weight / length.square()
    d = y.shape[-1]
    outer = (y.unsqueeze(-1) * y.unsqueeze(-2)).flatten(-2)
    moments = s @ torch.cat((y, outer), -1)
    first, second = moments[..., :d], moments[..., d:].unflatten(-1, (d, d))
    own = outer.unflatten(-1, (d, d)) * s.sum(-1)[..., None, None]
    cross = y.unsqueeze(-1) * first.unsqueeze(-2)
    return own + second - cross - cross.mT


def look(
    now: Prepared,
    found: Found,
    weight: Float64[Tensor, "B N N"],
    shift: Float64[Tensor, "B N N"],
    std: float,
    memory: Memory,
) -> tuple[Scene, Memory]:
    """The scene of a step whose optimizer has ``found`` positions with those weights (1/m²) and
    shifts (m), and the memory after it."""
    mask, d = now.links.mask, found.position.shape[-1]
    there = mask.double()
    y = found.position - found.position.mean(1, keepdim=True)
    length = lengths(y)
    residual = (now.links.distance - length) * there
    innovation = torch.where(now.fixed.unsqueeze(-1), 0.0, now.place - found.position)
    memory = _remembered(memory, residual, mask, innovation)
    # A neighbour that is lost says little: its own variance is in the way.
    vague = (now.variance / (1 + 0.5 * weight.sum(-1) / d * now.variance)).unsqueeze(-2)
    eff = weight / (1 + weight * vague)
    plain = there / (std**2 + vague)
    trust = 1 / now.variance
    eye = torch.eye(d, dtype=y.dtype, device=y.device)
    told = information(y, eff, length)
    h = told + trust[..., None, None] * eye
    root = torch.linalg.cholesky_ex(h).L
    gain = torch.cholesky_inverse(root)
    e = (residual / std).clamp(-_CLIP, _CLIP)
    lasting = (memory.residual / std).clamp(-_CLIP, _CLIP) * there
    tukey = e * (1 - (e / _TUKEY).square()).clamp_min(0.0).square()
    strengths = torch.stack(
        (
            eff * (residual - shift),
            plain * std * e.clamp(-_SOFT, _SOFT),
            plain * std * tukey,
            plain * std * e.clamp_min(0.0),
            plain * std * lasting,
        ),
        1,
    )
    pulls = along_links(y.unsqueeze(1), strengths, length.unsqueeze(1)).movedim(1, -1)
    newton, others = pulls[..., :1], pulls[..., 1:]
    vectors = torch.cat(
        (
            gain
            @ torch.cat((newton, trust[..., None, None] * innovation.unsqueeze(-1), others), -1),
            innovation.unsqueeze(-1),
            memory.innovations,
        ),
        -1,
    )
    vectors = torch.where(now.fixed[..., None, None], 0.0, vectors)
    confidence = (weight * std**2).clamp_max(1.0)
    velocity = now.state[..., d : 2 * d]
    apart = lengths(velocity) * there
    speed = torch.log1p(apart / std)
    count = there.sum(-1)
    some = count.clamp_min(1.0)

    def mean(of: Tensor) -> Tensor:
        return of.sum(-1) / some

    spread = torch.log(now.variance / std**2)
    logdet = 2 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1) / d
    trace = (h.diagonal(dim1=-2, dim2=-1).sum(-1) / d).log()
    model_mean, model_variance = now.model.component(std)
    each = now.variance.new_ones(now.variance.shape)
    scalars = torch.stack(
        (
            torch.log1p(count) / 4,
            mean(there * now.fixed.unsqueeze(-2)),
            now.fixed.double(),
            mean(confidence),
            spread / 4,
            torch.log(found.variance / std**2) / 4,
            torch.log(now.added.clamp_min(1e-12) / std**2) / 4,
            trace - logdet,
            (trust.log() - logdet) / 4,
            mean(e),
            mean(e.square()).sqrt(),
            mean((e.abs() > 2).double() * there),
            mean((e > 2).double()),
            mean(lasting),
            mean(lasting.abs()),
            mean(speed) / 4,
            each * now.model.share[:, 1:],
            each * torch.log(model_variance[:, :1] / std**2),
            each * (model_mean[:, 1:] / std / 4),
            each * (torch.log(model_variance[:, 1:] / std**2) / 4),
            1 / (1 + memory.steps),
        ),
        -1,
    )
    link = torch.stack(
        (e, e.abs(), lasting, lasting.abs(), torch.log1p(memory.seen) / 3, confidence, speed / 4),
        -1,
    )
    return (
        Scene(scalars, vectors, link, mask, ~now.fixed, y, length, eff, gain, trust),
        memory,
    )


def _remembered(
    memory: Memory,
    residual: Float64[Tensor, "B N N"],
    mask: Bool[Tensor, "B N N"],
    innovation: Float64[Tensor, "B N d"],
) -> Memory:
    """Running means, which begin as plain means; a link that is away is forgotten."""
    seen = torch.where(mask, memory.seen + 1, memory.seen * (1 - 1 / _LINK_TIME))
    gain = (1 / seen.clamp_min(1.0)).clamp_min(1 / _LINK_TIME) * mask
    steps = memory.steps + 1
    times = innovation.new_tensor(_TIMES)
    share = torch.maximum(1 / steps[..., None, None], 1 / times)
    means = memory.innovations + share * (innovation.unsqueeze(-1) - memory.innovations)
    return Memory(
        residual=memory.residual + gain * (residual - memory.residual),
        seen=seen,
        innovations=means,
        steps=steps,
        batch_size=memory.batch_size,
    )
