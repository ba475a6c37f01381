"""The PF-NN paper's particle filter as printed: uniform start, and resampling by Algorithm 2."""

from dataclasses import replace

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from agents.models.process import Process
from agents.particle import particle_count
from agents.particle.belief import normal
from agents.particle.cloud import Moments, moments, select, systematic
from agents.particle.resampling import Resampling, Weighed, per_error
from coloc_env import noise
from coloc_env.scenario import Believed

PERTURB_STD = 0.1  # m; the paper gives none
_SHARE = 0.1  # of it on velocities (m/s) and attitudes (rad)


class PrintedResampling(Resampling):
    """Algorithm 2 as printed, called as Algorithm 1 does: where the effective sample size is below
    half of the count, and only there does the count change. ``perturb_std`` (m) is the position's
    part of Σ_perturb. (Where attitudes are not perturbed, those of a cloud that was resampled to
    few particles stay wrong, gravity leaks into its velocity, and every UAV is lost.)"""

    def __init__(
        self, process: Process, perturb_std: float, bounds: tuple[int, int] | None
    ) -> None:
        std = dict.fromkeys(("velocity", "attitude"), _SHARE * perturb_std)
        std |= {"position": perturb_std, "accel": 0.0, "gyro": 0.0}
        super().__init__(process, per_error(process, std), bounds, 0.0)

    def weigh(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        count: Int64[Tensor, "B N"],
    ) -> Weighed:
        weighed = super().weigh(particles, log_weights, count)
        target = torch.where(self.few(weighed, count), weighed.target, count)  # Algorithm 1
        return replace(weighed, target=target)

    def resample_few(
        self,
        particles: Float32[Tensor, "B N M S"],
        weighed: Weighed,
        count: Int64[Tensor, "B N"],
        draws: Float32[Tensor, "B N M E"],
        key: Int64[Tensor, "B N"],
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        few, target = self.few(weighed, count), weighed.target
        std, m = self.floor.to(draws), particles.shape[-2]
        ancestors = systematic(weighed.weights, noise.unit(key), count)  # lines 1 to 7
        moved = self.space.boxplus(select(particles, ancestors), std * draws)  # 9 to 12
        if bool((target > count).any()):  # 20: new ones perturb existing ones, evenly spaced
            slot = torch.arange(m, device=draws.device)
            fresh = slot - count.unsqueeze(-1)
            step = count.unsqueeze(-1) // (target - count).clamp_min(1).unsqueeze(-1)
            parent = torch.where(fresh < 0, slot, fresh * step).clamp_max(m - 1)
            more = normal(key, "pf.add", self.space.error_size, m)
            more = more.masked_fill((fresh < 0).unsqueeze(-1), 0.0)
            moved = self.space.boxplus(select(moved, parent), std * more)
        equal = particle_count.equal_log_weights(particle_count.alive(target, m))  # 14 and 15
        particles = torch.where(few[..., None, None], moved, particles)
        return particles, torch.where(few.unsqueeze(-1), equal, weighed.log_weights)

    def estimated(
        self,
        weighed: Weighed,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
    ) -> Moments:
        """The resampled cloud (Algorithm 1, lines 26 and 27)."""
        return moments(self.space, particles, log_weights.exp())


def anywhere(believed: Believed) -> Believed:
    """With a uniform prior of the position."""
    return replace(believed, prior=replace(believed.prior, kind="uniform"))
