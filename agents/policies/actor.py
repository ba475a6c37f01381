"""The policy network of a learned agent: from what it reads to a distribution of actions."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from agents.layers import Linear, row_product, sigmoid
from agents.weights import Learned

ACTIVATIONS = {"tanh": torch.tanh, "relu": torch.relu}
SQUASHES = {"tanh": torch.tanh, "clip": lambda x: x.clamp(-1.0, 1.0)}
_STD = (0.3, 1e-3, 2.0)  # of actions: at first, least and most
_FAR = 10.0  # standard deviations at which inputs are cut
_SMALL = 0.01  # times usual weights: the last layer's at first


class Normalizer(nn.Module):
    """(x − shift) / scale, cut at ±10; both are set once, before training."""

    shift: Float32[Tensor, "F"]
    scale: Float32[Tensor, "F"]

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("shift", torch.zeros(width))
        self.register_buffer("scale", torch.ones(width))

    def fit(self, samples: Float32[Tensor, "n F"]) -> None:
        """Median and half the distance from the 16th to the 84th percentile of each input: what is
        usual, whatever the first steps of an episode are like."""
        low, middle, high = samples.quantile(samples.new_tensor((0.16, 0.5, 0.84)), 0)
        self.shift.copy_(middle)
        self.scale.copy_((0.5 * (high - low)).clamp_min(1e-3))

    def forward(self, x: Float32[Tensor, "*s F"]) -> Float32[Tensor, "*s F"]:
        return ((x - self.shift) / self.scale).clamp(-_FAR, _FAR)


class Body(nn.Module):
    """Inputs, normalized, through one or two layers."""

    def __init__(self, width: int, hidden: int, layers: int, activation: str) -> None:
        super().__init__()
        self.normal = Normalizer(width)
        sizes = [width, *[hidden] * layers]
        self.layers = nn.ModuleList(Linear(i, o) for i, o in pairwise(sizes))
        self.activation = ACTIVATIONS[activation]

    def forward(self, x: Float32[Tensor, "*s F"]) -> Float32[Tensor, "*s H"]:
        x = self.normal(x)
        for layer in self.layers:
            x = self.activation(layer(x))
        return x


class Head(nn.Module):
    """Mean and standard deviation of an action, before it is squashed."""

    def __init__(self, hidden: int, outputs: int) -> None:
        super().__init__()
        self.layer = Linear(hidden, 2 * outputs)
        with torch.no_grad():
            self.layer.weight.mul_(_SMALL)
            self.layer.bias.zero_()
            self.layer.bias[outputs:] = torch.tensor(_STD[0], dtype=torch.float32).log()

    def forward(
        self, x: Float32[Tensor, "*s H"]
    ) -> tuple[Float32[Tensor, "*s a"], Float32[Tensor, "*s a"]]:
        mean, log_std = self.layer(x).chunk(2, -1)
        return mean, log_std.exp().clamp(*_STD[1:])


class Actor(Learned):
    """Two layers, the second an LSTM if ``recurrent``, and a linear head for mean and log-std.

    ``mode``: the action mode's settings; ``inputs``: the leaves it reads, with their widths;
    ``outputs``: numbers of an action; ``squash``: how a mean becomes an action in [−1, 1].
    """

    kind = "policy"

    def __init__(
        self,
        mode: Mapping[str, Any],
        inputs: Mapping[str, int],
        outputs: int,
        hidden: int = 64,
        recurrent: bool = False,
        activation: str = "tanh",
        squash: str = "tanh",
    ) -> None:
        super().__init__()
        self.architecture = {
            "mode": dict(mode),
            "inputs": dict(inputs),
            "outputs": outputs,
            "hidden": hidden,
            "recurrent": recurrent,
            "activation": activation,
            "squash": squash,
        }
        self.features = tuple(f"{name}[{width}]" for name, width in inputs.items())
        self.squash = SQUASHES[squash]
        self.body = Body(sum(inputs.values()), hidden, 1 if recurrent else 2, activation)
        self.lstm = nn.LSTM(hidden, hidden, batch_first=True) if recurrent else None
        self.head = Head(hidden, outputs)

    def act(
        self, x: Float32[Tensor, "B N F"], memory: Float32[Tensor, "B N m"]
    ) -> tuple[Float32[Tensor, "B N a"], Float32[Tensor, "B N m"]]:
        """The action that the policy thinks best, and its memory after; every UAV's numbers are
        computed alike whoever shares its batch."""
        x = self.body(x.unsqueeze(-2))
        if self.lstm is not None:
            lstm: Any = self.lstm
            h, c = memory.unsqueeze(-2).chunk(2, -1)
            gates = row_product(x, lstm.weight_ih_l0.mT) + lstm.bias_ih_l0
            gates = gates + (row_product(h, lstm.weight_hh_l0.mT) + lstm.bias_hh_l0)
            i, f, g, o = gates.chunk(4, -1)
            c = sigmoid(f) * c + sigmoid(i) * torch.tanh(g)
            x = sigmoid(o) * torch.tanh(c)
            memory = torch.cat((x, c), -1)[..., 0, :]
        return self.squash(self.head(x)[0])[..., 0, :], memory

    @property
    def memory_size(self) -> int:
        """How many numbers a UAV's memory has."""
        return 0 if self.lstm is None else 2 * self.lstm.hidden_size
