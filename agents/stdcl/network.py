"""The ST-GNN: encoder, two hops of attention, three dilated convolutions, fusion, correction."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from tensordict import TensorClass
from torch import Tensor, nn

from agents.layers import Linear, sigmoid
from agents.stdcl.features import LINKS, SCALARS, VECTORS, Scene
from agents.stdcl.layers import DilatedConvolution, TopologicalAttention, bounded, pushed_on
from agents.weights import Learned

DILATIONS = (1, 2, 4)
_CARRIED = 4  # vector channels that neighbours' displacements come in
_EDGE = 8
_LEAST = 1e-9  # m
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
    ``kinematic=False``: plain graph attention; ``temporal=False``: no convolutions.
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
        self.times = nn.ModuleList(
            DilatedConvolution(width, channels, kernel, dilation)
            for dilation in (DILATIONS if temporal else ())
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

    @property
    def _layers(self) -> list[DilatedConvolution]:
        return [layer for layer in self.times if isinstance(layer, DilatedConvolution)]

    def start(self, shape: torch.Size, dim: int) -> Past:
        """Zeros: nothing before the first step."""
        steps = sum(layer.length for layer in self._layers)
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
        most = scene.reach.clamp_min(_LEAST).unsqueeze(-1)
        size = raw.norm(dim=-1, keepdim=True).clamp_min(_LEAST)
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
        found_h, found_v = [], []
        for layer in self._layers:
            steps = slice(begin, begin + layer.length)
            begin = steps.stop
            before_h, before_v = past.scalars[:, :, steps], past.vectors[:, :, steps]
            scalars.append(pushed_on(before_h, h))
            vectors.append(pushed_on(before_v, v))
            h, v = layer(h, v, before_h, before_v)
            found_h.append(h)
            found_v.append(v)
        each_h, each_v = torch.stack(found_h, -1), torch.stack(found_v, -1)
        share = torch.softmax(torch.cat([self.scale(h) for h in found_h], -1), -1)
        h = (each_h * share.unsqueeze(-2)).sum(-1)
        v = (each_v * share[..., None, None, :]).sum(-1)
        after = (torch.cat(scalars, 2), torch.cat(vectors, 2))
        return h, v, Past(scalars=after[0], vectors=after[1], batch_size=past.batch_size)

    def _confidence(self, scene: Scene, h: Tensor) -> Float[Tensor, "B N N"]:
        """What either end says of a link, alike from both."""
        n = h.shape[1]
        ends, seen = self.edge_nodes(h), self.edge(scene.link.flatten(1, 2))
        inside = torch.tanh(seen.unflatten(1, (n, n)) + ends.unsqueeze(1) + ends.unsqueeze(2))
        logit: Tensor = self.edge_out(inside.flatten(1, 2))[..., 0]
        return sigmoid(logit.unflatten(1, (n, n)))
