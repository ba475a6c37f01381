"""The factor network: attention over links, gate, dilated causal convolutions, fusion (ST-DCL
paper, section 4.2), whose output is factors of ranges instead of positions."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from agents.layers import Linear, sigmoid
from agents.stdcl.factors.features import CONFIDENCE, LINKS, NODES, SPEED
from agents.stdcl.layers import push, swish
from agents.weights import Learned

DILATIONS = (1, 2, 4)
KERNEL = 2  # of the convolutions: a field of t − 7 … t
MAX_LOG_WEIGHT, MAX_SHIFT, MAX_MEMORY, MAX_LOG_NOISE = 2.5, 3.0, 2.0, 2.0
_SLOPE = 0.2  # of the leaky rectifier
_FAST, _UNSURE = 2.0, 0.1  # links are cut at so many mean relative speeds, if they weigh less

Output = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


class FactorNetwork(Learned):
    """Tensors in, tensors out, for teams of any size; with new weights all outputs are 0."""

    kind = "range_factors"
    features = (*LINKS, *NODES)

    def __init__(self, width: int = 20) -> None:
        super().__init__()
        self.architecture = {"width": width}
        self.width = width
        self.encode_link = Linear(len(LINKS), width)
        self.encode_node = Linear(len(NODES) + width, width)
        self.map = Linear(width, width)  # W of equation 28
        self.ends = Linear(width, 2)  # a, of h_i and of h_j
        self.relative = nn.Parameter(torch.tensor((-0.5, 1.0)))  # a, of ‖Δv‖ and of c
        self.keep = Linear(2 * width, width)  # W_z of equation 29
        self.times = nn.ModuleList(Linear(KERNEL * width, width) for _ in DILATIONS)
        self.scale = Linear(width, 1)  # logits of equation 32
        self.link_hidden = Linear(width, width)
        self.node_hidden = Linear(width, width)
        self.link_out = Linear(width, 3)
        self.node_out = Linear(width, 1)
        for layer in (self.link_out, self.node_out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    @property
    def steps(self) -> int:
        """Past steps that the convolutions see."""
        return sum((KERNEL - 1) * dilation for dilation in DILATIONS)

    def start(self, shape: torch.Size) -> Float[Tensor, "B N K F"]:
        """What the convolutions have seen before the first step: zeros (equation 31)."""
        return self.link_out.weight.new_zeros(*shape, self.steps, self.width)

    def forward(
        self,
        link: Float[Tensor, "B N N L"],
        node: Float[Tensor, "B N F"],
        mask: Bool[Tensor, "B N N"],
        past: Float[Tensor, "B N K F"],
    ) -> Output:
        """For every link the logarithm of a factor on its weight (±2.5), a shift (±3, in standard
        deviations of a range) and what is added to the logit of its NLOS probability for the next
        step (±2); for every UAV the logarithm of a factor on its next process noise (±2); and what
        the convolutions have seen after this step."""
        there = mask.to(link.dtype).unsqueeze(-1)
        count = there.sum(-2).clamp_min(1.0)
        e = swish(self.encode_link(link)) * there
        h = swish(self.encode_node(torch.cat((node, e.sum(-2) / count), -1)))  # equation 27
        h = self._attended(h, link, mask)
        h, past = self._convolved(h, past)
        ends = self.node_hidden(h)
        hidden = swish(self.link_hidden(e) + ends.unsqueeze(1) + ends.unsqueeze(2))
        out = self.link_out(hidden)
        out = 0.5 * (out + out.transpose(1, 2)) * there  # both ends of a link say the same
        weight, shift, memory = (
            _bounded(part, limit)
            for part, limit in zip(
                out.unbind(-1), (MAX_LOG_WEIGHT, MAX_SHIFT, MAX_MEMORY), strict=True
            )
        )
        return weight, shift, memory, _bounded(self.node_out(h)[..., 0], MAX_LOG_NOISE), past

    def _attended(
        self, h: Float[Tensor, "B N F"], link: Float[Tensor, "B N N L"], mask: Tensor
    ) -> Float[Tensor, "B N F"]:
        """Equation 28: α_ij = softmax_j LeakyReLU(aᵀ [W h_i ‖ W h_j ‖ w_v ‖Δv_ij‖ ‖ c_ij]), links
        of large ‖Δv_ij‖ and small c_ij cut; equation 29: h' = z ⊙ h + (1 − z) ⊙ Σ_j α_ij W h_j."""
        mapped = self.map(h)
        own, other = self.ends(mapped).unsqueeze(-2).unbind(-1)
        speed, confidence = link[..., SPEED], link[..., CONFIDENCE]
        logit = own.mT + other + self.relative[0] * speed + self.relative[1] * confidence
        mean = speed.sum(-1, keepdim=True) / mask.sum(-1, keepdim=True).clamp_min(1)
        mask = mask & ~((speed > _FAST * mean) & (confidence < _UNSURE))
        logit = functional.leaky_relu(logit, _SLOPE).masked_fill(~mask, -1e9)
        neighbours = (torch.softmax(logit, -1) * mask) @ mapped
        z = sigmoid(self.keep(torch.cat((h, neighbours), -1)))
        return z * h + (1 - z) * swish(neighbours)

    def _convolved(
        self, h: Float[Tensor, "B N F"], past: Float[Tensor, "B N K F"]
    ) -> tuple[Float[Tensor, "B N F"], Float[Tensor, "B N K F"]]:
        """Dilated causal convolutions (equation 30) and their fusion Σ_m β_m h^(m),
        β = softmax(scale(h^(m))) (equations 32 and 33)."""
        begin, after, outputs = 0, [], []
        for layer, dilation in zip(self.times, DILATIONS, strict=True):
            before = past[:, :, begin : begin + dilation]
            begin += dilation
            after.append(push(before, h))
            h = h + swish(layer(torch.cat((h, before[:, :, -1]), -1)))
            outputs.append(h)
        beta = torch.softmax(torch.cat([self.scale(one) for one in outputs], -1), -1)
        fused = (torch.stack(outputs, -1) * beta.unsqueeze(-2)).sum(-1)
        return fused, torch.cat(after, 2)


def _bounded(x: Tensor, limit: float) -> Tensor:
    return limit * torch.tanh(x / limit)
