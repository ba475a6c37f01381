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

_SMALL = 1.0  # rad²; up to here the terms below are all that float64 resolves
_TERMS = 9
# |B_2|, |B_4|, …, |B_20|, the Bernoulli numbers
_BERNOULLI = (
    *(1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66),
    *(691 / 2730, 7 / 6, 3617 / 510, 43867 / 798, 174611 / 330),
)
_INVERSE_SERIES = [b / factorial(2 * n) for n, b in enumerate(_BERNOULLI, start=1)]


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
    return torch.where(squared < _SMALL, _horner(small, _INVERSE_SERIES), closed)


def _horner(x: Float[Tensor, "*s"], terms: Sequence[float]) -> Float[Tensor, "*s"]:
    value = x * terms[-1]
    for term in terms[-2:0:-1]:
        value = (value + term) * x
    return value + terms[0]
