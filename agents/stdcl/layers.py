"""Layers of the ST-GNN: topological attention with a gate, dilated causal convolution, fusion.

Each carries scalars h [B, N, F] and vectors v [B, N, d, C] along. Vectors only ever meet the same
linear map on every axis and factors made of scalars, so that turning the world turns them.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from agents.layers import Linear, sigmoid
from agents.stdcl.features import LINKS, Scene
from agents.swarm.links import along_links

FAR_APART = 2.0  # times the mean relative speed of a UAV's links
DOUBTFUL = 0.1  # confidence
_SLOPE = 0.2  # of the leaky rectifier
_CONFIDENCE, _SPEED = LINKS.index("confidence"), LINKS.index("relative_speed")


def bounded(x: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """x σ(1.7 x): smooth, nearly the identity for large x."""
    return x * sigmoid(1.7 * x)


class Gate(nn.Module):
    """Vectors times factors that scalars give, mixed: V' = (V ⊙ g(h)) M, g about 1 at the start."""

    def __init__(self, width: int, inside: int, outside: int) -> None:
        super().__init__()
        self.factors = Linear(width, inside)
        self.mix = nn.Parameter(torch.randn(inside, outside) / inside**0.5)

    def forward(self, h: Float[Tensor, "B N F"], v: Float[Tensor, "B N d C"]) -> Tensor:
        return (v * (1 + self.factors(h)).unsqueeze(-2)) @ self.mix


class TopologicalAttention(nn.Module):
    """Equations 26 to 28: α_ij = softmax_j LeakyReLU(aᵀ[W h_i ‖ W h_j ‖ w_v‖Δv_ij‖ ‖ c_ij]), where
    links between UAVs that fly apart and have little confidence are cut, then
    h' = z ⊙ h + (1 − z) ⊙ Σ_j α_ij W h_j.

    Vectors of neighbours come in two ways: averaged by α, and as far as they act on a UAV through
    its ranges: H⁻¹ Σ_j W_ij u u ᵀ v_j. ``kinematic=False`` leaves ‖Δv‖, c and the cut out: plain
    graph attention (Veličković et al., ICLR 2018).
    """

    def __init__(self, width: int, channels: int, carried: int, kinematic: bool = True) -> None:
        super().__init__()
        self.kinematic = kinematic
        self.map = Linear(width, width)
        self.ends = Linear(width, 2)
        self.relative = nn.Parameter(torch.tensor((-0.5, 1.0)))
        self.keep = Linear(2 * width, width)
        self.carry = nn.Parameter(torch.randn(channels, carried) / channels**0.5)
        self.mix = Gate(width, 2 * channels + carried, channels)

    def forward(
        self, scene: Scene, h: Float[Tensor, "B N F"], v: Float[Tensor, "B N d C"]
    ) -> tuple[Float[Tensor, "B N F"], Float[Tensor, "B N d C"]]:
        mapped = self.map(h)
        share = self.attention(scene, mapped)
        heard = share @ mapped
        z = sigmoid(self.keep(torch.cat((h, heard), -1)))
        h = z * h + (1 - z) * bounded(heard)
        near = (share @ v.flatten(-2)).view_as(v)
        moved = carried_over(scene, v @ self.carry)
        v = v + self.mix(h, torch.cat((v, near, moved), -1))
        return h, torch.where(scene.moves[..., None, None], v, 0.0)

    def attention(self, scene: Scene, mapped: Float[Tensor, "B N F"]) -> Float[Tensor, "B N N"]:
        """α, zero where there is no link, or only doubtful ones between UAVs that fly apart."""
        here, there = self.ends(mapped).unsqueeze(-2).unbind(-1)
        logit, mask = here.mT + there, scene.mask
        if self.kinematic:
            speed, confidence = scene.link[..., _SPEED], scene.link[..., _CONFIDENCE]
            logit = logit + self.relative[0] * speed + self.relative[1] * confidence
            usual = speed.sum(-1, keepdim=True) / mask.sum(-1, keepdim=True).clamp_min(1)
            mask = mask & ~((speed > FAR_APART * usual) & (confidence < DOUBTFUL))
        logit = functional.leaky_relu(logit, _SLOPE).masked_fill(~mask, -1e9)
        return torch.softmax(logit, -1) * mask


def carried_over(scene: Scene, v: Float[Tensor, "B N d C"]) -> Float[Tensor, "B N d C"]:
    """H⁻¹ Σ_j W_ij u_ij u_ijᵀ v_j: where neighbours' displacements push a UAV."""
    y, weight, length, gain = scene.position, scene.weight, scene.length, scene.gain
    at = v.movedim(-1, 1)  # [B, C, N, d]
    along = (
        y.unsqueeze(1) @ at.mT - (y.unsqueeze(1) * at).sum(-1).unsqueeze(-2)
    ) / length.unsqueeze(1)
    pushed = along_links(y.unsqueeze(1), weight.unsqueeze(1) * along, length.unsqueeze(1))
    return gain @ pushed.movedim(1, -1)


class DilatedConvolution(nn.Module):
    """Equation 29: y(t) = Σ_k W_k x(t − k·dilation) + b over the past alone, zeros before the
    start, for scalars and (without b) vectors; with a residual connection.

    One step at a time: ``past`` holds the last (kernel − 1)·dilation inputs, newest first.
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
        h = h + bounded(self.scalars(torch.cat((h, *before_h), -1)))
        return h, v + self.mix(h, torch.cat((v, *before_v), -1))


def pushed_on(past: Float[Tensor, "B N K *r"], new: Float[Tensor, "B N *r"]) -> Tensor:
    """``past`` with the newest in front and the oldest gone."""
    return torch.cat((new.unsqueeze(2), past[:, :, :-1]), 2)
