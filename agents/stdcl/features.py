"""Inputs of the ST-GNN (equation 27): scalars and vectors of nodes, scalars of links.

All scalars are dimensionless: lengths are in standard deviations of a range or of the UAV's own
position. Sums over links are weighted means, so that networks transfer to teams of other sizes.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm.belief import Solution, StepInput
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
_SECOND = 1.0  # s: relative speeds count as what they add up to in a step of training
_TIMES = (10.0, 40.0)  # steps over which innovations are averaged


class RunningMeans(TensorClass):
    """Per UAV: each link's running mean ``residual`` (m) and count of ranges (``seen``), running
    means of the ``innovations`` over two times (m), and the steps taken; batch (B, N)."""

    residual: Float64[Tensor, "B N N"]
    seen: Float64[Tensor, "B N N"]
    innovations: Float64[Tensor, "B N d 2"]
    steps: Float64[Tensor, "B N"]


@dataclass(frozen=True)
class GraphInputs:
    """Inputs of the network: ``scalars`` and ``vectors`` (m) of nodes, scalars of each ``link`` and
    which links exist (``mask``), how fast their ends move ``apart`` (‖Δv_ij‖, m/s; 0 without a
    link), which nodes are ``free``; of displacements through ranges: the
    ``position`` (m, centred) and ``length`` (m) of links, their ``weight`` W_ij (1/m²), and
    ``gain`` H_i⁻¹ (m²), H_i = Σ_j W_ij u uᵀ + λ I with the prior's ``precision`` λ (1/m²); and the
    ``max_offset`` δ_max of corrections (m)."""

    scalars: Float64[Tensor, "B N F"]
    vectors: Float64[Tensor, "B N d C"]
    link: Float64[Tensor, "B N N L"]
    mask: Bool[Tensor, "B N N"]
    apart: Float64[Tensor, "B N N"]
    free: Bool[Tensor, "B N"]
    position: Float64[Tensor, "B N d"]
    length: Float64[Tensor, "B N N"]
    weight: Float64[Tensor, "B N N"]
    gain: Float64[Tensor, "B N d d"]
    precision: Float64[Tensor, "B N"]
    max_offset: Float64[Tensor, "B N"]

    def to(self, like: Tensor) -> "GraphInputs":
        """The same in another precision."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return GraphInputs(
            **{k: x if x.dtype == torch.bool else x.to(like) for k, x in parts.items()}
        )


def initial_means(worlds: int, n: int, dim: int, device: torch.device) -> RunningMeans:
    """The running means before the first step."""
    zeros = torch.zeros(worlds, n, n, dtype=torch.float64, device=device)
    return RunningMeans(
        residual=zeros,
        seen=zeros.clone(),
        innovations=zeros.new_zeros(worlds, n, dim, len(_TIMES)),
        steps=zeros.new_zeros(worlds, n),
        batch_size=(worlds, n),
    )


def graph_inputs(
    inputs: StepInput,
    solution: Solution,
    weight: Float64[Tensor, "B N N"],
    shift: Float64[Tensor, "B N N"],
    std: float,
    means: RunningMeans,
    max_offset: Float64[Tensor, "B N"],
) -> tuple[GraphInputs, RunningMeans]:
    """The network's inputs for a step and its solution with those weights (1/m²) and shifts (m),
    and the running means after it."""
    mask, d = inputs.links.mask, solution.position.shape[-1]
    y = solution.position - solution.position.mean(1, keepdim=True)
    length = lengths(y)
    residual = (inputs.links.distance - length) * mask
    innovation = torch.where(inputs.fixed.unsqueeze(-1), 0.0, inputs.prior - solution.position)
    means = _updated(means, residual, mask, innovation)
    variance = _own_variance(inputs, weight, d).unsqueeze(-2)
    effective, precision = weight / (1 + weight * variance), 1 / inputs.variance  # W_ij, λ
    eye = torch.eye(d, dtype=y.dtype, device=y.device)
    h = own_information(y, effective, length) + precision[..., None, None] * eye  # H_i
    root = torch.linalg.cholesky_ex(h).L
    gain = torch.cholesky_inverse(root)
    error = (residual / std).clamp(-_CLIP, _CLIP)
    lasting = (means.residual / std).clamp(-_CLIP, _CLIP) * mask
    uniform = std * mask.to(torch.float32) / (std**2 + variance)
    strengths = (  # ψ(e_ij): linear, clipped, Tukey's, positive, averaged over time
        effective * (residual - shift),
        uniform * error.clamp(-_SOFT, _SOFT),
        uniform * error * (1 - (error / _TUKEY).square()).clamp_min(0.0).square(),
        uniform * error.clamp_min(0.0),
        uniform * lasting,
    )
    gradients = along_links(y.unsqueeze(1), torch.stack(strengths, 1), length.unsqueeze(1))
    newton, *others = gradients.unbind(1)
    to_prior = precision.unsqueeze(-1) * innovation
    steps = gain @ torch.stack((newton, to_prior, *others), -1)  # H_i⁻¹ Σ_j ψ(e_ij) u_ij
    vectors = torch.cat((steps, innovation.unsqueeze(-1), means.innovations), -1)
    vectors = torch.where(inputs.fixed[..., None, None], 0.0, vectors)
    confidence = (weight * std**2).clamp_max(1.0)
    apart = lengths(inputs.state[..., d : 2 * d]) * mask
    each = (error, lasting, confidence, torch.log1p(apart * _SECOND / std))
    scalars = _scalars(inputs, solution, std, means, h, root, each)
    error, lasting, confidence, speed = each
    link = (error, error.abs(), lasting, lasting.abs(), torch.log1p(means.seen) / 3, confidence,
            speed / 4)  # fmt: skip
    graph = GraphInputs(
        scalars=scalars,
        vectors=vectors,
        link=torch.stack(link, -1),
        mask=mask,
        apart=apart,
        free=~inputs.fixed,
        position=y,
        length=length,
        weight=effective,
        gain=gain,
        precision=precision,
        max_offset=max_offset,
    )
    return graph, means


def _own_variance(
    inputs: StepInput, weight: Float64[Tensor, "B N N"], dim: int
) -> Float64[Tensor, "B N"]:
    """Variance of each UAV (m² per axis) after its own links, which it adds to its neighbours'
    ranges: P⁻¹ ← P⁻¹ + ½ Σ_j W_ij / d."""
    return inputs.variance / (1 + 0.5 * weight.sum(-1) / dim * inputs.variance)


def _scalars(
    inputs: StepInput,
    solution: Solution,
    std: float,
    means: RunningMeans,
    h: Float64[Tensor, "B N d d"],
    root: Float64[Tensor, "B N d d"],
    links: tuple[Tensor, ...],
) -> Float64[Tensor, "B N F"]:
    """SCALARS of every UAV; ``root`` is the Cholesky factor of H, ``links`` the error, the mean
    error, the confidence and the relative speed of each link."""
    error, lasting, confidence, speed = links
    count = inputs.links.mask.sum(-1).double()

    def mean(of: Tensor) -> Tensor:
        return of.sum(-1) / count.clamp_min(1.0)

    d = h.shape[-1]
    volume = 2 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1) / d
    size = (h.diagonal(dim1=-2, dim2=-1).sum(-1) / d).log()
    bias, variance = inputs.error_model.component(std)
    everywhere = torch.stack(
        (
            inputs.error_model.share[:, 1],
            torch.log(variance[:, 0] / std**2),
            bias[:, 1] / std / 4,
            torch.log(variance[:, 1] / std**2) / 4,
        ),
        -1,
    )
    own = torch.stack(
        (
            torch.log1p(count) / 4,
            mean((inputs.links.mask & inputs.fixed.unsqueeze(-2)).double()),
            inputs.fixed.double(),
            mean(confidence),
            torch.log(inputs.variance / std**2) / 4,
            torch.log(solution.variance / std**2) / 4,
            torch.log(inputs.process_noise.clamp_min(1e-12) / std**2) / 4,
            size - volume,
            -(torch.log(inputs.variance) + volume) / 4,
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
    age = (1 / (1 + means.steps)).unsqueeze(-1)
    return torch.cat((own, everywhere.unsqueeze(1).expand(-1, own.shape[1], -1), age), -1)


def link_gain(
    seen: Float64[Tensor, "B N N"], mask: Bool[Tensor, "B N N"]
) -> tuple[Float64[Tensor, "B N N"], Float64[Tensor, "B N N"]]:
    """How many steps the running mean of each link holds after one, and what that counts in it:
    arithmetic at first, then exponential; the mean of a link without ranges loses its weight."""
    seen = torch.where(mask, seen + 1, seen * (1 - 1 / _LINK_TIME))
    return seen, (1 / seen.clamp_min(1.0)).clamp_min(1 / _LINK_TIME) * mask


def _updated(
    means: RunningMeans,
    residual: Float64[Tensor, "B N N"],
    mask: Bool[Tensor, "B N N"],
    innovation: Float64[Tensor, "B N d"],
) -> RunningMeans:
    """The running means after a step: arithmetic at first, then exponential; the mean of a link
    without ranges loses its weight."""
    seen, gain = link_gain(means.seen, mask)
    steps = means.steps + 1
    times = innovation.new_tensor(_TIMES)
    share = torch.maximum(1 / steps[..., None, None], 1 / times)
    innovations = means.innovations + share * (innovation.unsqueeze(-1) - means.innovations)
    return RunningMeans(
        residual=means.residual + gain * (residual - means.residual),
        seen=seen,
        innovations=innovations,
        steps=steps,
        batch_size=means.batch_size,
    )
