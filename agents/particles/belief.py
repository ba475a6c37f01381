"""A particle filter's belief, and the random numbers that are its UAV's own."""

import torch
from jaxtyping import Float, Float32, Int64
from tensordict import TensorClass
from torch import Tensor

from coloc_env import noise
from coloc_env.observation import Observation


class ParticleBelief(TensorClass):
    """Particles (float32) with normalized log-weights (−∞ for slots beyond ``count``), the UAV's
    own random key, steps taken, the last effective sample size as a share of its count, position
    and velocity of the last estimate (of the prior before), and what the screen remembers; batch
    (B, N)."""

    particles: Float32[Tensor, "B N M S"]
    log_weights: Float32[Tensor, "B N M"]
    count: Int64[Tensor, "B N"]
    key: Int64[Tensor, "B N"]
    step: Int64[Tensor, "B N"]
    ess_share: Float32[Tensor, "B N"]
    last: Float32[Tensor, "B N 2*d"]
    memory: Float[Tensor, "B N K"]


def own_keys(observation: Observation, seed: int) -> Int64[Tensor, "B N"]:
    """One random key per UAV, from what its prior says and the localizer's seed: the same UAV in
    the same world draws the same numbers in any batch, team subset or face."""
    bits = observation["prior"].contiguous().view(torch.int32).to(torch.int64)
    index = torch.arange(bits.shape[-1], device=bits.device)
    return noise.fold(noise.fold(bits, index).sum(-1), seed)


def normal(
    key: Int64[Tensor, "B N"], stream: str, components: int, slots: int
) -> Float32[Tensor, "B N M E"]:
    """Standard normal numbers for each slot, whatever the number of slots beside it; in the memory
    order of ``geometry.join``."""
    which = torch.arange(components, device=key.device).view(-1, 1, 1)
    return noise.normal(noise.fold(key, which), stream, slots).movedim(0, -1)
