"""What the graph network sees of a step: scalars, vectors in metres, and links.

All scalars are free of units: lengths are counted in standard deviations of a range or of the UAV's
own position. Sums over links are weighted means, so that teams of any size look alike.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm.belief import Found, Prepared
from agents.swarm.links import along_links, lengths, own_information

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
    reach: Float64[Tensor, "B N"]

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


def look(
    now: Prepared,
    found: Found,
    weight: Float64[Tensor, "B N N"],
    shift: Float64[Tensor, "B N N"],
    std: float,
    memory: Memory,
    reach: Float64[Tensor, "B N"],
) -> tuple[Scene, Memory]:
    """The scene of a step whose optimizer has ``found`` positions with those weights (1/m²) and
    shifts (m), with corrections up to ``reach`` (m), and the memory after it."""
    mask, d = now.links.mask, found.position.shape[-1]
    y = found.position - found.position.mean(1, keepdim=True)
    length = lengths(y)
    residual = (now.links.distance - length) * mask
    innovation = torch.where(now.fixed.unsqueeze(-1), 0.0, now.place - found.position)
    memory = _remembered(memory, residual, mask, innovation)
    vague = _vagueness(now, weight, d).unsqueeze(-2)
    certain, trust = weight / (1 + weight * vague), 1 / now.variance
    eye = torch.eye(d, dtype=y.dtype, device=y.device)
    told = own_information(y, certain, length) + trust[..., None, None] * eye
    root = torch.linalg.cholesky_ex(told).L
    gain = torch.cholesky_inverse(root)
    error = (residual / std).clamp(-_CLIP, _CLIP)
    lasting = (memory.residual / std).clamp(-_CLIP, _CLIP) * mask
    alike = std * mask.to(torch.float32) / (std**2 + vague)
    strengths = (
        certain * (residual - shift),
        alike * error.clamp(-_SOFT, _SOFT),
        alike * error * (1 - (error / _TUKEY).square()).clamp_min(0.0).square(),
        alike * error.clamp_min(0.0),
        alike * lasting,
    )
    pulls = along_links(y.unsqueeze(1), torch.stack(strengths, 1), length.unsqueeze(1))
    newton, *others = pulls.unbind(1)
    steps = gain @ torch.stack((newton, trust.unsqueeze(-1) * innovation, *others), -1)
    vectors = torch.cat((steps, innovation.unsqueeze(-1), memory.innovations), -1)
    vectors = torch.where(now.fixed[..., None, None], 0.0, vectors)
    confidence = (weight * std**2).clamp_max(1.0)
    apart = lengths(now.state[..., d : 2 * d]) * mask
    each = (error, lasting, confidence, torch.log1p(apart / std))
    scalars = _scalars(now, found, std, memory, told, root, each)
    error, lasting, confidence, speed = each
    link = (error, error.abs(), lasting, lasting.abs(), torch.log1p(memory.seen) / 3, confidence,
            speed / 4)  # fmt: skip
    moves = ~now.fixed
    seen = (scalars, vectors, torch.stack(link, -1), mask, moves, y, length, certain, gain, trust)
    return Scene(*seen, reach), memory


def _vagueness(now: Prepared, weight: Float64[Tensor, "B N N"], dim: int) -> Float64[Tensor, "B N"]:
    """What each UAV is unsure of (m² per axis), by its own links: it is in the way of those that
    range to it."""
    return now.variance / (1 + 0.5 * weight.sum(-1) / dim * now.variance)


def _scalars(
    now: Prepared,
    found: Found,
    std: float,
    memory: Memory,
    told: Float64[Tensor, "B N d d"],
    root: Float64[Tensor, "B N d d"],
    links: tuple[Tensor, ...],
) -> Float64[Tensor, "B N F"]:
    """SCALARS of every UAV; ``told`` is H, ``root`` its Cholesky factor, ``links`` the error, the
    lasting error, the confidence and the relative speed of each link."""
    error, lasting, confidence, speed = links
    count = now.links.mask.sum(-1).double()

    def mean(of: Tensor) -> Tensor:
        return of.sum(-1) / count.clamp_min(1.0)

    d = told.shape[-1]
    volume = 2 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1) / d
    size = (told.diagonal(dim1=-2, dim2=-1).sum(-1) / d).log()
    bias, variance = now.model.component(std)
    everywhere = torch.stack(
        (
            now.model.share[:, 1],
            torch.log(variance[:, 0] / std**2),
            bias[:, 1] / std / 4,
            torch.log(variance[:, 1] / std**2) / 4,
        ),
        -1,
    )
    own = torch.stack(
        (
            torch.log1p(count) / 4,
            mean((now.links.mask & now.fixed.unsqueeze(-2)).double()),
            now.fixed.double(),
            mean(confidence),
            torch.log(now.variance / std**2) / 4,
            torch.log(found.variance / std**2) / 4,
            torch.log(now.added.clamp_min(1e-12) / std**2) / 4,
            size - volume,
            -(torch.log(now.variance) + volume) / 4,
            mean(error),
            mean(error.square()).sqrt(),
            mean((error.abs() > _SOFT).double()),
            mean((error > _SOFT).double()),
            mean(lasting),
            mean(lasting.abs()),
            mean(speed) / 4,
        ),
        -1,
    )
    age = (1 / (1 + memory.steps)).unsqueeze(-1)
    return torch.cat((own, everywhere.unsqueeze(1).expand(-1, own.shape[1], -1), age), -1)


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
