"""Jacobians of SO(3)'s exponential (Forster et al. 2017, eqs. 7–9; Solà et al. 2018, eqs. 143–146).

``exp(φ + δ) ≈ exp(φ) exp(J_r(φ) δ)``. exp and log are ``rotations.quaternion_exp`` and
``quaternion_log``; left Jacobians are right ones of −φ. In the plane the Jacobian is 1.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from coloc_env.geometry.coefficients import inverse_coefficient, stumpff
from coloc_env.geometry.rotations import cross_matrix


def right_jacobian(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3 3"]:
    """``J_r(φ) = I − (1 − cos θ)/θ² [φ]× + (θ − sin θ)/θ³ [φ]×²``, θ = |φ|."""
    second, third = stumpff(squared_angle(v), (2, 3))
    return _polynomial(v, -second, third)


def right_jacobian_inverse(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s 3 3"]:
    """``J_r(φ)⁻¹ = I + ½ [φ]× + (1 − ½θ cot ½θ)/θ² [φ]×²``, for θ < 2π."""
    squared = squared_angle(v)
    return _polynomial(v, torch.full_like(squared, 0.5), inverse_coefficient(squared))


def squared_angle(v: Float[Tensor, "*s 3"]) -> Float[Tensor, "*s"]:
    """``|φ|²``."""
    x, y, z = v.unbind(-1)
    return x * x + y * y + z * z


def _polynomial(
    v: Float[Tensor, "*s 3"], linear: Float[Tensor, "*s"], quadratic: Float[Tensor, "*s"]
) -> Float[Tensor, "*s 3 3"]:
    """``I + linear [φ]× + quadratic [φ]×²``."""
    skew = cross_matrix(v)
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    return eye + linear[..., None, None] * skew + quadratic[..., None, None] * (skew @ skew)
