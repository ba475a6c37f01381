"""Nearest neighbour: each measurement is of the landmark that the prior finds most likely."""

import torch
from jaxtyping import Float, Int64
from torch import Tensor


def nearest(squared: Float[Tensor, "*s M L"], limit: float) -> Int64[Tensor, "*s M"]:
    """The landmark of each measurement, −1 for none: that of the smallest squared Mahalanobis
    distance, if within the gate ``limit``; of measurements that claim the same landmark the
    nearest has it. Pairings that cannot be are infinitely far apart.
    """
    least, choice = squared.min(-1)
    rivals = torch.where(
        choice.unsqueeze(-1) == torch.arange(squared.shape[-1], device=squared.device),
        least.unsqueeze(-1),
        torch.inf,
    )
    first = rivals.argmin(-2).gather(-1, choice)  # which measurement has that landmark
    own = torch.arange(squared.shape[-2], device=squared.device)
    return torch.where((least <= limit) & (first == own), choice, -1)
