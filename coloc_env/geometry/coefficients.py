"""The scalar functions of an angle that exp, log and their Jacobians on SO(3), SE(2), SE(3) share.

All are smooth in the *squared* angle s = θ². Below ``_SMALL`` they are their Taylor series, above
it their closed form; each side is evaluated where it is harmless (``clamp``), so that neither the
value nor the gradient ever divides by zero.
"""

from collections.abc import Sequence
from math import factorial

import torch
from jaxtyping import Float
from torch import Tensor

_SMALL = 0.25  # rad²; seven terms of either series are then exact to float64
_TERMS = 7
# |B_2n| / (2n)!, n = 1 … 7, with the Bernoulli numbers B_2n
_BERNOULLI = (
    *(1 / 12, 1 / 720, 1 / 30240, 1 / 1209600),
    *(1 / 47900160, 691 / 1307674368000, 1 / 74724249600),
)


def stumpff(squared: Float[Tensor, "*s"], orders: Sequence[int]) -> list[Float[Tensor, "*s"]]:
    """Stumpff functions ``c_k(s) = Σ (−s)ⁿ / (2n + k)!`` of a squared angle, for each order k.

    c₀ = cos θ, c₁ = sin θ / θ, c₂ = (1 − cos θ)/θ², c₃ = (θ − sin θ)/θ³, and on by the recurrence
    ``c_{k+2} = (1/k! − c_k) / s``.
    """
    small, large = squared.clamp(max=_SMALL), squared.clamp(min=_SMALL)
    angle = large.sqrt()
    closed = [angle.cos(), angle.sin() / angle]
    for order in range(2, max(orders) + 1):
        closed.append((1 / factorial(order - 2) - closed[order - 2]) / large)
    series = [[(-1) ** n / factorial(2 * n + k) for n in range(_TERMS)] for k in orders]
    is_small = squared < _SMALL
    return [
        torch.where(is_small, _horner(small, terms), closed[k])
        for k, terms in zip(orders, series, strict=True)
    ]


def inverse_coefficient(squared: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """``(1 − ½θ cot ½θ) / θ²``, the last coefficient of the inverse Jacobians; for θ < 2π."""
    small, large = squared.clamp(max=_SMALL), squared.clamp(min=_SMALL)
    half = 0.5 * large.sqrt()
    closed = (1 - half / half.tan()) / large
    return torch.where(squared < _SMALL, _horner(small, _BERNOULLI), closed)


def _horner(x: Float[Tensor, "*s"], terms: Sequence[float]) -> Float[Tensor, "*s"]:
    value = x * terms[-1]
    for term in terms[-2:0:-1]:
        value = (value + term) * x
    return value + terms[0]
