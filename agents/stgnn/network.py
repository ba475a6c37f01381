"""The ST-GNN: encoder, two hops of attention, three dilated convolutions, fusion, correction."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from tensordict import TensorClass
from torch import Tensor, nn

from agents.checkpoint import Learned
from agents.layers import Linear, sigmoid
from agents.stgnn.features import LINKS, SCALARS, VECTORS, Scene
from agents.stgnn.layers import DilatedConvolution, TopologicalAttention, bounded, pushed_on

DILATIONS = (1, 2, 4)
_CARRIED = 4  # vector channels that neighbours' displacements come in
_EDGE = 8
_REACH = 3.0  # standard deviations of a UAV's dead reckoning: the largest correction
_WIDEST = 3.0  # of a factor of a standard deviation, as a logarithm


class Past(TensorClass):
    """Inputs of the convolutions in the last steps, newest first: scalars and vectors (m) side by
    side for each layer; batch (B, N)."""

    scalars: Float[Tensor, "B N K F"]
    vectors: Float[Tensor, "B N K d C"]


@dataclass(frozen=True)
class Correction:
    """Shift ``offset`` (m) of each position, the factor ``spread`` of its variance, and what the
    network wants each link's ``confidence`` to become."""

    offset: Float[Tensor, "B N d"]
    spread: Float[Tensor, "B N"]
    confidence: Float[Tensor, "B N N"]


class StGnn(Learned):
    """Equations 25 to 35, with vectors in metres beside the paper's scalars.

    ``width`` d = 64; ``kernel`` 3 (the paper says 3 in one place, and means 2 in another);
    ``kinematic=False``: plain graph attention.
    """

    kind = "stgnn"
    features = (*SCALARS, *VECTORS, *LINKS)

    def __init__(
        self,
        width: int = 64,
        kernel: int = 3,
        hops: int = 2,
        kinematic: bool = True,
        temporal: bool = True,
    ) -> None:
        super().__init__()
        self.architecture = {
            "width": width,
            "kernel": kernel,
            "hops": hops,
            "kinematic": kinematic,
            "temporal": temporal,
        }
        channels = len(VECTORS)
        self.width, self.channels = width, channels
        self.encode = nn.ModuleList((Linear(len(SCALARS), width), Linear(width, width)))
        self.hops = nn.ModuleList(
            TopologicalAttention(width, channels, _CARRIED, kinematic) for _ in range(hops)
        )
        self.times = (
            nn.ModuleList(
                DilatedConvolution(width, channels, kernel, dilation) for dilation in DILATIONS
            )
            if temporal
            else nn.ModuleList()
        )
        self.scale = Linear(width, 1)  # of eq. 30: which time scale counts
        self.out = Linear(width, channels)
        self.trust = nn.Parameter(torch.tensor((1.0, 0.0)))  # w, b of γ = σ(w c + b)
        self.sure = Linear(width, 1)
        self.edge_nodes = Linear(width, _EDGE)
        self.edge = Linear(len(LINKS), _EDGE)
        self.edge_out = Linear(_EDGE, 1)
        for layer in (self.out, self.sure, self.edge_out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        nn.init.constant_(self.edge_out.bias, 4.0)

    def start(self, shape: torch.Size, dim: int) -> Past:
        """Zeros: nothing before the first step."""
        steps = sum(one.length for one in self.times)
        like = self.out.weight
        return Past(
            scalars=like.new_zeros(*shape, steps, self.width),
            vectors=like.new_zeros(*shape, steps, dim, self.channels),
            batch_size=shape,
        )

    def forward(self, scene: Scene, past: Past) -> tuple[Correction, Past]:
        scene = scene.to(self.out.weight)
        h, v = scene.scalars, scene.vectors
        for layer in self.encode:
            h = bounded(layer(h))
        for hop in self.hops:
            h, v = hop(scene, h, v)
        h, v, past = self._in_time(h, v, past)
        raw = (v * self.out(h).unsqueeze(-2)).sum(-1)
        most = (_REACH / scene.trust.sqrt()).unsqueeze(-1)
        size = raw.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        trust = self._gamma(scene).unsqueeze(-1)
        offset = trust * most * torch.tanh(size / most) * (raw / size)
        spread = torch.exp(_WIDEST * torch.tanh(self.sure(h)[..., 0] / _WIDEST))
        return Correction(offset, spread, self._confidence(scene, h)), past

    def _gamma(self, scene: Scene) -> Tensor:
        """γ = σ(w c + b) with the mean confidence of a UAV's links (eq. 34)."""
        c = scene.scalars[..., SCALARS.index("confidence")]
        return sigmoid(self.trust[0] * c + self.trust[1])

    def _in_time(self, h: Tensor, v: Tensor, past: Past) -> tuple[Tensor, Tensor, Past]:
        """Dilated convolutions and their fusion by softmax (eqs. 29 to 31)."""
        if not self.times:
            return h, v, past
        begin, scalars, vectors = 0, [], []
        found: list[tuple[Tensor, Tensor]] = []
        for layer in self.times:
            end = begin + layer.length
            past_h, past_v = past.scalars[:, :, begin:end], past.vectors[:, :, begin:end]
            scalars.append(pushed_on(past_h, h))
            vectors.append(pushed_on(past_v, v))
            h, v = layer(h, v, past_h, past_v)
            found.append((h, v))
            begin = end
        shares = torch.softmax(torch.cat([self.scale(h) for h, _ in found], -1), -1).unbind(-1)
        h = sum(s.unsqueeze(-1) * h for s, (h, _) in zip(shares, found, strict=True))
        v = sum(s[..., None, None] * v for s, (_, v) in zip(shares, found, strict=True))
        past = Past(
            scalars=torch.cat(scalars, 2), vectors=torch.cat(vectors, 2), batch_size=past.batch_size
        )
        return h, v, past

    def _confidence(self, scene: Scene, h: Tensor) -> Float[Tensor, "B N N"]:
        """What either end says of a link, alike from both."""
        ends = self.edge_nodes(h)
        seen = self.edge(scene.link.to(h).flatten(1, 2)).unflatten(1, scene.mask.shape[1:])
        inside = torch.tanh(seen + ends.unsqueeze(1) + ends.unsqueeze(2))
        return sigmoid(
            self.edge_out(inside.flatten(1, 2))[..., 0].unflatten(1, scene.mask.shape[1:])
        )
