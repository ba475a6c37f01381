"""The ST-GNN: encoder, two hops of attention, three dilated convolutions, fusion, correction."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from tensordict import TensorClass
from torch import Tensor, nn

from agents.layers import Linear, sigmoid
from agents.stdcl.features import LINKS, SCALARS, VECTORS, GraphInputs
from agents.stdcl.layers import DilatedConvolution, TopologicalAttention, push, swish
from agents.swarm.pairs import BLOCK
from agents.weights import Learned

_PUSHED = 4  # vector channels of neighbours' displacements through ranges
_EDGE = 8  # hidden units of the links' confidence
_TINY = 1e-9  # m
_MAX_LOG_FACTOR = 3.0  # of a variance


class ConvolutionState(TensorClass):
    """Past inputs of the convolutions, newest first: scalars and vectors (m) of all layers, side by
    side; batch (B, N)."""

    scalars: Float[Tensor, "B N K F"]
    vectors: Float[Tensor, "B N K d C"]


@dataclass(frozen=True)
class Correction:
    """``offset`` γ Δp (m) of each position, the ``variance_factor`` of its variance, and the
    ``confidence`` that each link should have (None: not asked for)."""

    offset: Float[Tensor, "B N d"]
    variance_factor: Float[Tensor, "B N"]
    confidence: Float[Tensor, "B E"] | None


class StGnn(Learned):
    """Equations 27 to 35, with vectors in metres beside the paper's scalars.

    ``width`` d = 64; ``kernel`` K = 3 (the paper has 3 in one place and a field of K = 2 in
    another); ``levels`` L: convolutions with the dilations 1, 2, 4, … 2^(L−1) (0: none);
    ``kinematic=False``: plain graph attention; ``cut=False``: the attention cuts no links, as in
    networks that were trained before it did.
    """

    kind = "stgnn"
    features = (*SCALARS, *VECTORS, *LINKS)

    def __init__(
        self,
        width: int = 64,
        kernel: int = 3,
        hops: int = 2,
        kinematic: bool = True,
        cut: bool = True,
        levels: int = 3,
    ) -> None:
        super().__init__()
        self.architecture = {
            "width": width,
            "kernel": kernel,
            "hops": hops,
            "kinematic": kinematic,
            "cut": cut,
            "levels": levels,
        }
        channels = len(VECTORS)
        self.width, self.channels = width, channels
        self.encode = nn.ModuleList((Linear(len(SCALARS), width), Linear(width, width)))
        self.hops = nn.ModuleList(
            TopologicalAttention(width, channels, _PUSHED, kinematic, cut) for _ in range(hops)
        )
        self.times = nn.ModuleList(
            DilatedConvolution(width, channels, kernel, 2**level) for level in range(levels)
        )
        self.scale = Linear(width, 1)  # logits of equation 32
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

    def start(self, shape: torch.Size, dim: int) -> ConvolutionState:
        """Zeros before the first step (equation 31)."""
        steps = sum(layer.length for layer in self._layers)
        like = self.out.weight
        return ConvolutionState(
            scalars=like.new_zeros(*shape, steps, self.width),
            vectors=like.new_zeros(*shape, steps, dim, self.channels),
            batch_size=shape,
        )

    def forward(
        self, graph: GraphInputs, past: ConvolutionState, judged: bool = True
    ) -> tuple[Correction, ConvolutionState]:
        """The correction, and confidences of links where they are to be ``judged``."""
        graph = graph.to(self.out.weight)
        h, v = graph.scalars, graph.vectors
        for layer in self.encode:  # equation 27
            h = swish(layer(h))
        for hop in self.hops:  # equations 28 and 29
            h, v = hop(graph, h, v)
        h, v, past = self._convolve(h, v, past)
        raw = (v * self.out(h).unsqueeze(-2)).sum(-1)
        size = raw.norm(dim=-1, keepdim=True).clamp_min(_TINY)
        limit = graph.max_offset.clamp_min(_TINY).unsqueeze(-1)
        gamma = self._gamma(graph).unsqueeze(-1)
        offset = gamma * limit * torch.tanh(size / limit) * (raw / size)  # γ δ_max tanh(·), eq. 34
        factor = torch.exp(_MAX_LOG_FACTOR * torch.tanh(self.sure(h)[..., 0] / _MAX_LOG_FACTOR))
        return Correction(offset, factor, self._confidence(graph, h) if judged else None), past

    def _gamma(self, graph: GraphInputs) -> Float[Tensor, "B N"]:
        """γ = σ(w c + b), c the mean confidence of a UAV's links (equation 35)."""
        c = graph.scalars[..., SCALARS.index("confidence")]
        return sigmoid(self.trust[0] * c + self.trust[1])

    def _convolve(
        self, h: Tensor, v: Tensor, past: ConvolutionState
    ) -> tuple[Tensor, Tensor, ConvolutionState]:
        """Dilated causal convolutions (equation 30) and their fusion Σ_m β_m h^(m),
        β = softmax(scale(h^(m))) (equations 32 and 33)."""
        if not self.times:
            return h, v, past
        begin, scalars, vectors = 0, [], []
        outputs_h, outputs_v = [], []
        for layer in self._layers:
            steps = slice(begin, begin + layer.length)
            begin = steps.stop
            before_h, before_v = past.scalars[:, :, steps], past.vectors[:, :, steps]
            scalars.append(push(before_h, h))
            vectors.append(push(before_v, v))
            h, v = layer(h, v, before_h, before_v)
            outputs_h.append(h)
            outputs_v.append(v)
        each_h, each_v = torch.stack(outputs_h, -1), torch.stack(outputs_v, -1)
        beta = torch.softmax(torch.cat([self.scale(h) for h in outputs_h], -1), -1)
        h = (each_h * beta.unsqueeze(-2)).sum(-1)
        v = (each_v * beta[..., None, None, :]).sum(-1)
        after = (torch.cat(scalars, 2), torch.cat(vectors, 2))
        return (
            h,
            v,
            ConvolutionState(scalars=after[0], vectors=after[1], batch_size=past.batch_size),
        )

    def _confidence(self, graph: GraphInputs, h: Tensor) -> Float[Tensor, "B E"]:
        """The confidence of each link, symmetric in its ends. Links are products of ``BLOCK`` rows,
        so that their rounding does not depend on how many there are."""
        ends = graph.pairs.own(self.edge_nodes(h).mT).sum(-2)
        ends, links = (x.mT.unflatten(1, (-1, BLOCK)) for x in (ends, graph.link))
        hidden = torch.tanh(self.edge(links.contiguous()) + ends)
        logit: Tensor = self.edge_out(hidden)[..., 0]
        return sigmoid(logit.flatten(1))
