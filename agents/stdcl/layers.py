"""Layers of the ST-GNN: attention (equation 28), gate (29), dilated causal convolution (30).

Each maps scalars h [B, N, F] and vectors v [B, N, d, C] (m). Vectors are only multiplied by scalars
and mixed by the same linear map on every axis, so that layers are equivariant to rotations.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from agents.layers import Linear, sigmoid
from agents.stdcl.features import LINKS, GraphInputs
from agents.swarm.links import along_links

FAST = 1.5  # times the mean relative speed of a UAV's links: from here on a link may be cut
DOUBTED = 0.5  # confidence up to which it is: what equation 17 leaves a link flagged as NLOS
_SLOPE = 0.2  # of the leaky rectifier
_CONFIDENCE, _SPEED = LINKS.index("confidence"), LINKS.index("relative_speed")


def swish(x: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """x σ(1.7 x): smooth, nearly the identity for large x."""
    return x * sigmoid(1.7 * x)


class Gate(nn.Module):
    """Vectors gated by scalars: V' = (V ⊙ g(h)) M, g near 1 initially."""

    def __init__(self, width: int, inside: int, outside: int) -> None:
        super().__init__()
        self.factors = Linear(width, inside)
        self.mix = nn.Parameter(torch.randn(inside, outside) / inside**0.5)

    def forward(self, h: Float[Tensor, "B N F"], v: Float[Tensor, "B N d C"]) -> Tensor:
        return (v * (1 + self.factors(h)).unsqueeze(-2)) @ self.mix


class TopologicalAttention(nn.Module):
    """Dynamic topological attention with a gate (ST-DCL paper, section 4.2.1).

    Equation 28: α_ij = softmax_j LeakyReLU(aᵀ [W h_i ‖ W h_j ‖ w_v ‖Δv_ij‖ ‖ c_ij]).

    Equation 29: h_i' = z ⊙ h_i + (1 − z) ⊙ Σ_j α_ij W h_j, z = σ(W_z [h_i ‖ Σ_j α_ij W h_j] + b);
    the sum goes through a swish where it is added.

    Links that are ``FAST`` (‖Δv_ij‖) and ``DOUBTED`` (c_ij) are cut; the paper's thresholds are
    lost with its equation. Vectors of neighbours are averaged by α, and pushed through ranges,
    H_i⁻¹ Σ_j W_ij u_ij u_ijᵀ v_j. ``cut=False``: no link is cut. ``kinematic=False``: without ‖Δv‖
    and c as well, plain graph attention (Veličković et al., ICLR 2018).
    """

    def __init__(
        self, width: int, channels: int, pushed: int, kinematic: bool = True, cut: bool = True
    ) -> None:
        super().__init__()
        self.kinematic, self.cut = kinematic, kinematic and cut
        self.map = Linear(width, width)  # W
        self.ends = Linear(width, 2)  # a, of h_i and of h_j
        self.relative = nn.Parameter(torch.tensor((-0.5, 1.0)))  # a, of ‖Δv‖ and of c
        self.keep = Linear(2 * width, width)  # W_z
        self.carry = nn.Parameter(torch.randn(channels, pushed) / channels**0.5)
        self.mix = Gate(width, 2 * channels + pushed, channels)

    def forward(
        self, graph: GraphInputs, h: Float[Tensor, "B N F"], v: Float[Tensor, "B N d C"]
    ) -> tuple[Float[Tensor, "B N F"], Float[Tensor, "B N d C"]]:
        mapped = self.map(h)
        alpha = self.attention(graph, mapped)
        neighbours = alpha @ mapped
        z = sigmoid(self.keep(torch.cat((h, neighbours), -1)))
        h = z * h + (1 - z) * swish(neighbours)
        mean = (alpha @ v.flatten(-2)).view_as(v)
        pushed = pushed_by_ranges(graph, v @ self.carry)
        v = v + self.mix(h, torch.cat((v, mean, pushed), -1))
        return h, torch.where(graph.free[..., None, None], v, 0.0)

    def attention(
        self, graph: GraphInputs, mapped: Float[Tensor, "B N F"]
    ) -> Float[Tensor, "B N N"]:
        """α_ij of equation 28 from W h; 0 where there is no link, or a cut one."""
        own, other = self.ends(mapped).unsqueeze(-2).unbind(-1)
        logit, mask = own.mT + other, graph.mask
        if self.kinematic:
            speed, confidence = graph.link[..., _SPEED], graph.link[..., _CONFIDENCE]
            logit = logit + self.relative[0] * speed + self.relative[1] * confidence
        if self.cut:
            mask = mask & ~cut_links(graph)
        logit = functional.leaky_relu(logit, _SLOPE).masked_fill(~mask, -1e9)
        return torch.softmax(logit, -1) * mask


def cut_links(graph: GraphInputs) -> Bool[Tensor, "B N N"]:
    """Links that the attention of UAV i cuts: ‖Δv_ij‖ above ``FAST`` times the mean over its links,
    and c_ij at most ``DOUBTED``."""
    apart, count = graph.apart, graph.mask.sum(-1, keepdim=True).clamp_min(1)
    mean = apart.sum(-1, keepdim=True) / count
    doubted = graph.link[..., _CONFIDENCE] <= DOUBTED
    return graph.mask & (apart > FAST * mean) & doubted


def pushed_by_ranges(graph: GraphInputs, v: Float[Tensor, "B N d C"]) -> Float[Tensor, "B N d C"]:
    """H_i⁻¹ Σ_j W_ij u_ij u_ijᵀ v_j: a UAV's displacement by those of its neighbours (m)."""
    y, weight, length, gain = graph.position, graph.weight, graph.length, graph.gain
    at = v.movedim(-1, 1)  # [B, C, N, d]
    along = (
        y.unsqueeze(1) @ at.mT - (y.unsqueeze(1) * at).sum(-1).unsqueeze(-2)
    ) / length.unsqueeze(1)
    pushed = along_links(y.unsqueeze(1), weight.unsqueeze(1) * along, length.unsqueeze(1))
    return gain @ pushed.movedim(1, -1)


class DilatedConvolution(nn.Module):
    """Dilated causal convolution in time (equation 30): y(t) = Σ_k W_k x(t − k·dilation) + b, zeros
    before the start, for scalars and (without b) vectors; with a residual connection.

    One step at a time: ``past_h`` and ``past_v`` hold the last (kernel − 1)·dilation inputs, newest
    first.
    """

    def __init__(self, width: int, channels: int, kernel: int, dilation: int) -> None:
        super().__init__()
        self.taps = range(dilation - 1, (kernel - 1) * dilation, dilation)
        self.length = (kernel - 1) * dilation
        self.scalars = Linear(kernel * width, width)
        self.mix = Gate(width, kernel * channels, channels)

    def forward(
        self,
        h: Float[Tensor, "B N F"],
        v: Float[Tensor, "B N d C"],
        past_h: Float[Tensor, "B N K F"],
        past_v: Float[Tensor, "B N K d C"],
    ) -> tuple[Float[Tensor, "B N F"], Float[Tensor, "B N d C"]]:
        before_h = [past_h[:, :, k] for k in self.taps]
        before_v = [past_v[:, :, k] for k in self.taps]
        h = h + swish(self.scalars(torch.cat((h, *before_h), -1)))
        return h, v + self.mix(h, torch.cat((v, *before_v), -1))


def push(past: Float[Tensor, "B N K *r"], new: Float[Tensor, "B N *r"]) -> Tensor:
    """``past`` with ``new`` in front and without the oldest."""
    return torch.cat((new.unsqueeze(2), past[:, :, :-1]), 2)
