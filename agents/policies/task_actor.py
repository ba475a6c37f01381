"""The policy network of a task: from what the team sees to what each UAV does."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float32
from torch import Tensor, nn

from agents.layers import Linear
from agents.policies.actor import SQUASHES
from agents.weights import Learned

NETWORKS = ("feedforward", "recurrent", "attention", "candidates")
RELATIONS = {"attention": "apart", "candidates": "candidates"}  # what networks read besides
_SMALL = 0.01  # times usual weights: the last layer's at first
_STD = (-3.0, 0.7)  # least and most log standard deviation of an action, before it is squashed
_NEVER = -1e9  # logit of what is not allowed
_SILENCE = 1.0  # logit of a candidate network's first choice at first: channels are easily crowded


class Layer(Linear):
    """``agents.layers.Linear``, one product for all rows while it is trained."""

    def forward(self, x: Float32[Tensor, "*s m i"]) -> Float32[Tensor, "*s m o"]:
        if self.training:
            return nn.functional.linear(x, self.weight, self.bias)
        return super().forward(x)


class Neighbours(nn.Module):
    """One round of graph attention (Veličković et al. 2018, with dot products): each UAV attends to
    the embeddings of those within reach, and to where they are."""

    def __init__(self, hidden: int, dim: int) -> None:
        super().__init__()
        self.query, self.key, self.value = (Layer(hidden, hidden) for _ in range(3))
        self.place = Layer(dim + 1, hidden)

    def forward(
        self, x: Float32[Tensor, "*s n H"], apart: Float32[Tensor, "*s n n d"]
    ) -> Float32[Tensor, "*s n H"]:
        """What each receives; 0 for one without neighbours. ``apart``: from each to each, in
        reaches."""
        distance = (apart * apart).sum(-1, keepdim=True).sqrt()
        edge = self.place(torch.cat((apart, distance), -1))  # [*s, n, n, H]
        keys = self.key(x).unsqueeze(-3) + edge
        scores = (self.query(x).unsqueeze(-2) * keys).sum(-1) / x.shape[-1] ** 0.5
        n = x.shape[-2]
        alone = torch.eye(n, dtype=torch.bool, device=x.device)
        scores = scores.masked_fill(alone | (distance[..., 0] > 1.0), _NEVER)
        # Nobody in reach: the score 0 of nobody takes all the weight.
        weights = torch.cat((scores, torch.zeros_like(scores[..., :1])), -1).softmax(-1)[..., :-1]
        return (weights.unsqueeze(-1) * (self.value(x).unsqueeze(-3) + edge)).sum(-2)


class TaskActor(Learned):
    """Two layers, tanh, and a linear head; the same for every UAV.

    ``network``: ``feedforward``; ``recurrent``, the second layer a GRU; ``attention``, a round of
    graph attention over neighbours between the layers; ``candidates``, every choice scored by one
    network from what its exchange would do. ``outputs``: choices, or numbers of an action where
    ``discrete`` is not set. ``task``: with its options; ``moves`` and ``hold``: the menu that
    choices stand for, and for how many steps each is held. ``sampled``: actions are drawn, not the
    likeliest taken, as those on a channel that equals share must be. ``squash``: how means become
    numbers in [−1, 1].
    """

    kind = "task policy"

    def __init__(
        self,
        task: str,
        observation: int,
        outputs: int,
        discrete: bool,
        network: str = "feedforward",
        hidden: int = 64,
        moves: str = "none",
        hold: int = 1,
        features: int = 0,
        sampled: bool = False,
        squash: str = "tanh",
    ) -> None:
        super().__init__()
        self.architecture: Mapping[str, Any] = {
            "task": task,
            "observation": observation,
            "outputs": outputs,
            "discrete": discrete,
            "network": network,
            "hidden": hidden,
            "moves": moves,
            "hold": hold,
            "features": features,
            "sampled": sampled,
            "squash": squash,
        }
        more = (f"{RELATIONS[network]}[{features}]",) if features else ()
        self.features = (f"observation[{observation}]", *more)
        self.network, self.discrete, self.squash = network, discrete, SQUASHES[squash]
        self.first = Layer(observation, hidden)
        self.neighbours = Neighbours(hidden, features) if network == "attention" else None
        self.memory = nn.GRUCell(hidden, hidden) if network == "recurrent" else None
        self.candidate = Layer(features, hidden) if network == "candidates" else None
        wide = 2 * hidden if network == "attention" else hidden
        self.second = Layer(wide, hidden)
        self.head = Layer(hidden, 1 if self.candidate is not None else outputs)
        with torch.no_grad():
            self.head.weight.mul_(_SMALL)
            self.head.bias.zero_()
        if not discrete:
            self.log_std = nn.Parameter(torch.full((outputs,), -0.5))

    def forward(
        self,
        observation: Float32[Tensor, "*s n F"],
        mask: Bool[Tensor, "*s n C"] | None = None,
        relations: Float32[Tensor, "*s n r K"] | None = None,
        memory: Float32[Tensor, "*s n H"] | None = None,
    ) -> tuple[Float32[Tensor, "*s n o"], Float32[Tensor, "*s n H"] | None]:
        """Logits of choices, or the means of numbers (not squashed); and the memory after.

        ``relations``: what the network reads besides (``RELATIONS``).
        """
        x = torch.tanh(self.first(observation))
        if self.neighbours is not None:
            assert relations is not None
            x = torch.cat((x, self.neighbours(x, relations)), -1)
        if self.memory is not None:
            before = torch.zeros_like(x) if memory is None else memory
            x = memory = self.memory(x.flatten(0, -2), before.flatten(0, -2)).view_as(x)
        return self._out(x, mask, relations), memory

    def sequence(
        self, observation: Float32[Tensor, "B T n F"], mask: Bool[Tensor, "B T n C"] | None = None
    ) -> Float32[Tensor, "B T n o"]:
        """Logits or means at all steps of whole episodes, of a recurrent network."""
        assert self.memory is not None
        x = torch.tanh(self.first(observation)).transpose(0, 1).flatten(1, 2)  # [T, B n, H]
        memory, each = torch.zeros_like(x[0]), []
        for step in x:
            memory = self.memory(step, memory)
            each.append(memory)
        b, t, n = observation.shape[:3]
        return self._out(torch.stack(each).view(t, b, n, -1).transpose(0, 1), mask, None)

    def _out(
        self,
        x: Float32[Tensor, "*s n H"],
        mask: Bool[Tensor, "*s n C"] | None,
        relations: Float32[Tensor, "*s n r K"] | None,
    ) -> Float32[Tensor, "*s n o"]:
        if self.candidate is not None:
            assert relations is not None
            x = torch.tanh(x.unsqueeze(-2) + self.candidate(relations))
            out = self.head(torch.tanh(self.second(x)))[..., 0]
            out = torch.cat((out[..., :1] + _SILENCE, out[..., 1:]), -1)
        else:
            out = self.head(torch.tanh(self.second(x)))
        return out if mask is None else out.masked_fill(~mask, _NEVER)

    def scale(self, mean: Float32[Tensor, "*s o"]) -> Float32[Tensor, "*s o"]:
        """Standard deviations of numbers with these means, before they are squashed."""
        return self.log_std.clamp(*_STD).exp().expand_as(mean)
