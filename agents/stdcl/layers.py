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
        self.ends = Linear(width, 2)  # a, of h_j and of h_i
        self.relative = nn.Parameter(torch.tensor((-0.5, 1.0)))  # a, of ‖Δv‖ and of c
        self.keep = Linear(2 * width, width)  # W_z
        self.carry = nn.Parameter(torch.randn(channels, pushed) / channels**0.5)
        self.mix = Gate(width, 2 * channels + pushed, channels)

    def forward(
        self, graph: GraphInputs, h: Float[Tensor, "B N F"], v: Float[Tensor, "B N d C"]
    ) -> tuple[Float[Tensor, "B N F"], Float[Tensor, "B N d C"]]:
        mapped = self.map(h)
        alpha = graph.pairs.matrix(self.attention(graph, mapped))
        neighbours = alpha @ mapped
        z = sigmoid(self.keep(torch.cat((h, neighbours), -1)))
        h = z * h + (1 - z) * swish(neighbours)
        mean = (alpha @ v.flatten(-2)).view_as(v)
        pushed = pushed_by_ranges(graph, v @ self.carry)
        v = v + self.mix(h, torch.cat((v, mean, pushed), -1))
        return h, torch.where(graph.free[..., None, None], v, 0.0)

    def attention(
        self, graph: GraphInputs, mapped: Float[Tensor, "B N F"]
    ) -> Float[Tensor, "B 2 E"]:
        """α_ij and α_ji of equation 28 from W h; 0 for a link that is cut."""
        pairs = graph.pairs
        other, own = self.ends(mapped).unbind(-1)
        logit = pairs.own(own) + pairs.other(other)
        if self.kinematic:
            speed, confidence = graph.link[:, _SPEED], graph.link[:, _CONFIDENCE]
            relative = self.relative[0] * speed + self.relative[1] * confidence
            logit = logit + relative.unsqueeze(1)
        kept = pairs.there.unsqueeze(1)
        if self.cut:
            kept = kept & ~cut_links(graph)
        logit = functional.leaky_relu(logit, _SLOPE).masked_fill(~kept, -torch.inf)
        most = pairs.own(pairs.largest(logit.detach()))  # so that no exp overflows
        share = (logit - most.masked_fill(~kept, 0.0)).exp()
        return share / pairs.own(pairs.sums(share)).clamp_min(1.0)


def cut_links(graph: GraphInputs) -> Bool[Tensor, "B 2 E"]:
    """Links that the attention of UAV i cuts, and of j: ‖Δv_ij‖ above ``FAST`` times the mean over
    its links, and c_ij at most ``DOUBTED``."""
    pairs, apart = graph.pairs, graph.apart.unsqueeze(1)
    count = pairs.sums(pairs.there.unsqueeze(1).to(apart)).clamp_min(1)
    mean = pairs.own(pairs.sums(apart) / count)
    doubted = pairs.there & (graph.link[:, _CONFIDENCE] <= DOUBTED)
    return (apart > FAST * mean) & doubted.unsqueeze(1)


def pushed_by_ranges(graph: GraphInputs, v: Float[Tensor, "B N d C"]) -> Float[Tensor, "B N d C"]:
    """H_i⁻¹ Σ_j W_ij u_ij u_ijᵀ v_j: a UAV's displacement by those of its neighbours (m).

    With s_ij = W_ij/‖y_i − y_j‖² the sum is Σ_j s_ij (y_i − y_j) (y_iᵀ v_j − y_jᵀ v_j); multiplied
    out, products of the matrix s with what the neighbours have."""
    y = graph.position.unsqueeze(-1)  # [B, N, d, 1]
    d, own = y.shape[2], (y * v).sum(2, keepdim=True)  # y_jᵀ v_j
    outer = (y.unsqueeze(2) * v.unsqueeze(3)).flatten(2, 3)  # v_j y_jᵀ, [B, N, d d, C]
    parts = torch.cat((v, own, y * own, outer), 2)
    sums = (graph.coupling @ parts.flatten(2)).view_as(parts)  # Σ_j s_ij (…)
    v, own, first, outer = sums.split((d, 1, d, d * d), 2)
    second = (y.unsqueeze(3) * outer.unflatten(2, (d, d))).sum(2)  # Σ_j s_ij y_j v_jᵀ y_i
    return graph.gain @ (y * ((y * v).sum(2, keepdim=True) - own) + first - second)


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
