"""Where a UAV's ranging tags are, by its state."""

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.process import Process
from coloc_env.geometry import cross_matrix
from coloc_env.sensors.ranging import Tags


class OwnTags:
    """The tags of each UAV at their lever arms (m, body frame); one at its position where there are
    no ``arms``."""

    def __init__(self, arms: Tags) -> None:
        self.arms = arms

    def __bool__(self) -> bool:
        return bool(self.arms)

    def at(
        self, process: Process, x: Float[Tensor, "B N S"]
    ) -> tuple[Float[Tensor, "B N T d"], Float[Tensor, "B N T d t"] | None, float]:
        """Tag positions t = p + R l, their derivative by the attitude error (None: no attitude is a
        state), and the variance (m²) that unknown lever arms leave in each coordinate."""
        d = process.dim
        position = x[..., None, :d]
        if not self.arms:
            return position, None, 0.0
        arms = x.new_tensor(self.arms)
        arms = arms.unsqueeze(1) if x.dim() == 4 else arms  # particles have a dimension more
        rotation = process.rotation(x)
        if rotation is None:
            spread = float((arms**2).sum(-1).mean()) / d
            return position.expand(*x.shape[:-1], arms.shape[-2], d), None, spread
        turned = (rotation.unsqueeze(-3) @ arms.unsqueeze(-1))[..., 0]
        if d == 3:
            derivative = -rotation.unsqueeze(-3) @ cross_matrix(arms)  # −R [l]×
        else:
            derivative = torch.stack((-turned[..., 1:], turned[..., :1]), -2)
        return position + turned, derivative, 0.0
