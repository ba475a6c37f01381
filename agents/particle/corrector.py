"""The PF-NN paper's weight corrector: a small network on a particle's motion."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.layers import Linear
from agents.weights import Learned

HIDDEN = 12


class WeightCorrector(Learned):
    """6–12–1 network of equations 12–13: y = σ(W₂ tanh(W₁ f + b₁) + b₂) ∈ (0, 1).

    ``f`` = [p − p̂₋, v − v̂₋] (equation 11): how far a particle is from the last estimate, m and
    m/s, world frame; in the plane the vertical components are 0.
    """

    kind = "pfnn"
    features = ("dx", "dy", "dz", "dvx", "dvy", "dvz")

    def __init__(self) -> None:
        super().__init__()
        self.hidden = Linear(6, HIDDEN)
        self.out = Linear(HIDDEN, 1)

    def forward(self, features: Float[Tensor, "*s m 6"]) -> Float[Tensor, "*s m"]:
        """By tanh x = 1 − 2 / (1 + e²ˣ), which costs half as much as torch's tanh. The output is
        computed four times: products with fewer rows round by how many columns (particles) there
        are."""
        first, second = self.hidden, self.out
        s = _falling(_affine(2 * first.weight, 2 * first.bias, features.mT))
        weight, bias = (2 * second.weight).expand(4, -1), second.bias + second.weight.sum(-1)
        return _falling(_affine(weight, -bias, s)[..., 0, :])


def _affine(
    weight: Float[Tensor, "o i"], bias: Float[Tensor, "#o"], x: Float[Tensor, "*s i m"]
) -> Float[Tensor, "*s o m"]:
    """W x + b of every column, those of each UAV in a product of their own."""
    return (weight.expand(*x.shape[:-2], *weight.shape) @ x).add_(bias.unsqueeze(-1))


def _falling(x: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """1 / (1 + eˣ), constant where eˣ would overflow."""
    return (1 + x.clamp_max(80.0).exp()).reciprocal_()


def motion_features(
    particles: Float[Tensor, "B N M S"], last: Float[Tensor, "B N 2*d"], dim: int
) -> Float[Tensor, "B N M 6"]:
    """Equation 11: position and velocity of particles minus those of the last estimate, padded with
    zeros from the plane to space."""
    apart = particles[..., : 2 * dim] - last.unsqueeze(-2)
    if dim == 3:
        return apart
    pad = torch.zeros_like(apart[..., :1])
    return torch.cat((apart[..., :2], pad, apart[..., 2:], pad), -1)
