"""How much of a likelihood to use at once: increments that keep enough particles alive."""

import math

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.particles.cloud import effective_sample_size

_BISECTIONS = 10
_SMALLEST = math.log(1e-9)  # of what is left: no likelihood is sharper than that


def increment(
    log_weights: Float32[Tensor, "B N M"],
    log_likelihood: Float32[Tensor, "B N M"],
    left: Float32[Tensor, "B N"],
    goal: Float32[Tensor, "B N"],
) -> Float32[Tensor, "B N"]:
    """The largest share β ≤ ``left`` of the log-likelihood that keeps the effective sample size at
    ``goal`` particles, by bisection of log β (adaptive tempering, Del Moral, Doucet & Jasra 2012).
    """

    def enough(beta: Tensor) -> Tensor:
        return effective_sample_size(log_weights + beta.unsqueeze(-1) * log_likelihood) >= goal

    low, high = torch.full_like(left, _SMALLEST), torch.zeros_like(left)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        good = enough(left * middle.exp())
        low, high = torch.where(good, middle, low), torch.where(good, high, middle)
    return torch.where(enough(left), left, left * low.exp())
