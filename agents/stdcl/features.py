"""Inputs of the ST-GNN (equation 27): scalars and vectors of nodes, scalars of links.

All scalars are dimensionless: lengths are in standard deviations of a range or of the UAV's own
position. Sums over links are weighted means, so that networks transfer to teams of other sizes.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm.belief import Solution, StepInput
from agents.swarm.confidence import Weights
from agents.swarm.links import own_information
from agents.swarm.pairs import Pairs, norm

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
_KEPT = 1 - 1 / _LINK_TIME  # of what it counts, in a step without a range
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
    """Inputs of the network: ``scalars`` and ``vectors`` (m) of nodes, which of them are ``free``;
    the list of links (``pairs``), scalars of each ``link``, how fast its ends move ``apart``
    (‖Δv_ij‖, m/s), its ``unit`` vector, ``residual`` less its shift (m), and ``weight`` W_ij and
    W_ji (1/m²); of displacements through ranges: the ``position`` y (m, centred), the matrix
    W_ij/‖y_i − y_j‖² of their ``coupling`` (1/m⁴), and the ``gain`` H_i⁻¹ (m²),
    H_i = Σ_j W_ij u uᵀ + λ I with the prior's ``precision`` λ (1/m²); and the ``max_offset`` δ_max
    of corrections (m)."""

    scalars: Float64[Tensor, "B N F"]
    vectors: Float64[Tensor, "B N d C"]
    free: Bool[Tensor, "B N"]
    pairs: Pairs
    link: Float64[Tensor, "B L E"]
    apart: Float64[Tensor, "B E"]
    unit: Float64[Tensor, "B d E"]
    residual: Float64[Tensor, "B E"]
    weight: Float64[Tensor, "B 2 E"]
    position: Float64[Tensor, "B N d"]
    coupling: Float64[Tensor, "B N N"]
    gain: Float64[Tensor, "B N d d"]
    precision: Float64[Tensor, "B N"]
    max_offset: Float64[Tensor, "B N"]

    def to(self, like: Tensor) -> "GraphInputs":
        """The same in another precision."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        floats = {
            name: x.to(like)
            for name, x in parts.items()
            if isinstance(x, Tensor) and x.is_floating_point()
        }
        return replace(self, **floats)  # type: ignore[arg-type]


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
    weights: Callable[[Float64[Tensor, "B E"]], Weights],
    std: float,
    means: RunningMeans,
    max_offset: Float64[Tensor, "B N"],
) -> tuple[GraphInputs, RunningMeans]:
    """The network's inputs for a step and its solution, with ``weights`` (1/m²) and shifts (m) of
    links by their residuals (m), and the running means after it."""
    pairs, d = inputs.links.pairs, solution.position.shape[-1]
    there = pairs.there.double()
    unit, length = pairs.units(solution.position)
    residual = inputs.listed.links.distance - length
    weight, shift = weights(residual)
    residual = residual * there
    innovation = torch.where(inputs.fixed.unsqueeze(-1), 0.0, inputs.prior - solution.position)
    means, mean, seen = _updated(means, pairs, residual, innovation)
    variance = pairs.other(_own_variance(inputs, pairs, weight, d))
    weight = weight.unsqueeze(1)
    effective, precision = weight / (1 + weight * variance), 1 / inputs.variance  # W_ij, λ
    eye = torch.eye(d, dtype=length.dtype, device=length.device)
    y = solution.position - solution.position.mean(1, keepdim=True)
    coupling = pairs.matrix(effective / length.square().unsqueeze(1))
    h = own_information(y, coupling) + precision[..., None, None] * eye  # H_i
    root = torch.linalg.cholesky_ex(h).L
    gain = torch.cholesky_inverse(root)
    error = (residual / std).clamp(-_CLIP, _CLIP)
    lasting = (mean / std).clamp(-_CLIP, _CLIP) * there
    uniform = std * there.unsqueeze(1) / (std**2 + variance)  # [B, 2, E]
    robust = (  # clipped, Tukey's, positive, averaged over time
        error.clamp(-_SOFT, _SOFT),
        error * (1 - (error / _TUKEY).square()).clamp_min(0.0).square(),
        error.clamp_min(0.0),
        lasting,
    )
    psi = (effective * (residual - shift).unsqueeze(1), *(uniform * x.unsqueeze(1) for x in robust))
    newton, *further = (pairs.along(x, unit) for x in psi)  # Σ_j ψ(e_ij) u_ij
    to_prior = precision.unsqueeze(-1) * innovation
    steps = gain @ torch.stack((newton, to_prior, *further), -1)  # H_i⁻¹ Σ_j ψ(e_ij) u_ij
    vectors = torch.cat((steps, innovation.unsqueeze(-1), means.innovations), -1)
    vectors = torch.where(inputs.fixed[..., None, None], 0.0, vectors)
    confidence = (weight[:, 0] * std**2).clamp_max(1.0)
    apart = norm(pairs.apart(inputs.state[..., d : 2 * d]))
    each = (error, lasting, confidence, torch.log1p(apart * _SECOND / std))
    scalars = _scalars(inputs, solution, std, means, h, root, each)
    error, lasting, confidence, speed = each
    link = (error, error.abs(), lasting, lasting.abs(), torch.log1p(seen) / 3, confidence,
            speed / 4)  # fmt: skip
    graph = GraphInputs(
        scalars=scalars,
        vectors=vectors,
        free=~inputs.fixed,
        pairs=pairs,
        link=torch.stack(link, 1),
        apart=apart,
        unit=unit,
        residual=residual - shift,
        weight=effective,
        position=y,
        coupling=coupling,
        gain=gain,
        precision=precision,
        max_offset=max_offset,
    )
    return graph, means


def _own_variance(
    inputs: StepInput, pairs: Pairs, weight: Float64[Tensor, "B E"], dim: int
) -> Float64[Tensor, "B N"]:
    """Variance of each UAV (m² per axis) after its own links, which it adds to its neighbours'
    ranges: P⁻¹ ← P⁻¹ + ½ Σ_j W_ij / d."""
    return inputs.variance / (1 + 0.5 * pairs.sums(weight.unsqueeze(1)) / dim * inputs.variance)


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
    pairs, there = inputs.links.pairs, inputs.links.pairs.there.double()
    alike = (
        *(there, confidence, error, error.square(), (error.abs() > _SOFT).double()),
        *((error > _SOFT).double(), lasting, lasting.abs(), speed),
    )
    count, *sums = pairs.sums(torch.stack(alike, 1).unsqueeze(2)).unbind(1)
    sums.append(pairs.sums(pairs.other(inputs.fixed.double()) * there.unsqueeze(1)))
    trust, residual, square, far, long, lasts, lasts_size, parting, anchors = (
        x / count.clamp_min(1.0) for x in sums
    )
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
            anchors,
            inputs.fixed.double(),
            trust,
            torch.log(inputs.variance / std**2) / 4,
            torch.log(solution.variance / std**2) / 4,
            torch.log(inputs.process_noise.clamp_min(1e-12) / std**2) / 4,
            size - volume,
            -(torch.log(inputs.variance) + volume) / 4,
            residual,
            square.sqrt(),
            far,
            long,
            lasts,
            lasts_size,
            parting / 4,
        ),
        -1,
    )
    age = (1 / (1 + means.steps)).unsqueeze(-1)
    return torch.cat((own, everywhere.unsqueeze(1).expand(-1, own.shape[1], -1), age), -1)


def link_gain(
    seen: Float64[Tensor, "B *L"], mask: Bool[Tensor, "B *L"]
) -> tuple[Float64[Tensor, "B *L"], Float64[Tensor, "B *L"]]:
    """How many steps the running mean of each link holds after one, and what that counts in it:
    arithmetic at first, then exponential; the mean of a link without ranges loses its weight."""
    seen = torch.where(mask, seen + 1, seen * _KEPT)
    return seen, (1 / seen.clamp_min(1.0)).clamp_min(1 / _LINK_TIME) * mask


def _updated(
    means: RunningMeans,
    pairs: Pairs,
    residual: Float64[Tensor, "B E"],
    innovation: Float64[Tensor, "B N d"],
) -> tuple[RunningMeans, Float64[Tensor, "B E"], Float64[Tensor, "B E"]]:
    """The running means after a step, and those of its links' residuals and how often they were
    seen: arithmetic at first, then exponential; the mean of a link without ranges loses its
    weight."""
    seen, gain = link_gain(pairs.of(means.seen), pairs.there)
    mean = pairs.of(means.residual)
    mean = mean + gain * (residual - mean)
    steps = means.steps + 1
    times = innovation.new_tensor(_TIMES)
    share = torch.maximum(1 / steps[..., None, None], 1 / times)
    innovations = means.innovations + share * (innovation.unsqueeze(-1) - means.innovations)
    means = RunningMeans(
        residual=pairs.put(means.residual, mean),
        seen=pairs.put(means.seen * _KEPT, seen),
        innovations=innovations,
        steps=steps,
        batch_size=means.batch_size,
    )
    return means, mean, seen
