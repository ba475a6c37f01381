"""The window, its fading and the weight of motion as ST-DCL sets them (equations 15, 16 and 19).

The paper's displayed equations are lost; its text fixes what each depends on.
"""

import math

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

SAFETY = 1.2  # times the spectral radius (section 4.1.4: "greater than 1"; its value is lost)


def window_length(reach: float, a_max: float, dt: float, most: int) -> int:
    """T = min(T_max, ⌈√(2R/a_max)/Δt⌉) (equation 16): the steps in which a UAV leaves the reach R
    (m) from a standstill, with the acceleration a_max (m/s²) and steps of Δt (s)."""
    return min(most, math.ceil(math.sqrt(2 * reach / a_max) / dt))


def decay(
    noise: Float64[Tensor, "B N"], free: Bool[Tensor, "B N"], std: float, dt: Float64[Tensor, "B N"]
) -> Float64[Tensor, "B 1"]:
    """λ of w(τ) = exp(−λ (t − τ)) in 1/s (equation 15) from the rate at which errors accumulate.

    A range of noise σ (m) that dead reckoning moves on by a step of Δt has the variance σ² + 2 q²,
    q² the process ``noise`` (m², mean of the free UAVs), and so the weight σ²/(σ² + 2 q²):
    λ = ln(1 + 2 q²/σ²)/Δt. (The paper calls λ negatively correlated with that rate, and says that
    the weight of old ranges is to fall with the error's propagation: this is the latter.)
    """
    mean = (noise * free).sum(-1, keepdim=True) / free.sum(-1, keepdim=True).clamp_min(1)
    return torch.log1p(2 * mean / std**2) / dt[:, :1].clamp_min(1e-9)


def smoothing(mask: Bool[Tensor, "B N N"], std: float) -> Float64[Tensor, "B"]:
    """λ_s of equation 19 as the precision (1/m²) of the position by dead reckoning.

    λ_s Σ_i ‖(p_i(t) − p_i(t−1))/Δt − v_i‖² = λ_s/Δt² Σ_i ‖p_i(t) − m_i(t)‖². Section 4.1.4 wants
    λ_s > ρ(L), the spectral radius of the graph's Laplacian, and takes s ρ̂ by the average degree,
    which is only consistent per step: λ_s/Δt² = s ρ̂/σ², ρ̂ = 2 d̄ (ρ(L) is at most twice the
    *largest* degree), in units of a range's weight 1/σ².
    """
    degree = mask.sum(-1).double().mean(-1)
    return SAFETY * 2 * degree / std**2
