"""Soft resampling (Karkus, Hsu & Lee 2018), through which gradients of weights pass."""

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from agents.particle import particle_count
from agents.particle.cloud import liu_west, normalized, systematic
from agents.particle.resampling import Resampling, Weighed
from coloc_env import noise


class SoftResampling(Resampling):
    """Ancestors are drawn from q = α w + (1 − α) / M; an ancestor's particle gets the weight w / q,
    normalized: 1 / M for α = 1."""

    def __init__(self, like: Resampling, alpha: float) -> None:
        """Of the space, floor, counts and moves of another."""
        super().__init__(like.space, like.floor.tolist(), like.bounds, like.shrinkage)
        self.alpha = alpha

    def resample_few(
        self,
        particles: Float32[Tensor, "B N M S"],
        weighed: Weighed,
        count: Int64[Tensor, "B N"],
        draws: Float32[Tensor, "B N M E"],
        key: Int64[Tensor, "B N"],
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        few = self.few(weighed, count)
        slots = particles.shape[-2]
        existing = particle_count.alive(count, slots)
        flat = existing / count.unsqueeze(-1)
        proposal = self.alpha * weighed.weights + (1 - self.alpha) * flat
        ancestors = systematic(proposal.detach(), noise.unit(key), weighed.target)
        floor = self.floor.to(draws.device)
        moved = liu_west(self.space, weighed.cloud, ancestors, draws, self.shrinkage, floor)
        particles = moved.where(few[..., None, None], particles)
        ratio = weighed.log_weights - proposal.clamp_min(torch.finfo(proposal.dtype).tiny).log()
        live = particle_count.alive(weighed.target, slots)
        kept = normalized(ratio.gather(-1, ancestors).masked_fill(~live, -torch.inf))
        return particles, kept.where(few.unsqueeze(-1), weighed.log_weights)
