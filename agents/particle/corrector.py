"""The PF-NN paper's weight corrector: a small network on a particle's motion."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.layers import Linear, sigmoid
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

    def forward(self, features: Float[Tensor, "*s 6"]) -> Float[Tensor, "*s"]:
        return sigmoid(self.out(torch.tanh(self.hidden(features))))[..., 0]


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
