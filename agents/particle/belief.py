"""A particle filter's belief, a step's inputs, and the random numbers that are its UAV's own."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.association import Association
from agents.models.measurements import Neighbours
from agents.robust import Trust
from coloc_env import noise
from coloc_env.geometry import concat
from coloc_env.observation import Observation


class ParticleBelief(TensorClass):
    """Particles (float32) with normalized log-weights (−∞ for slots beyond ``count``), the UAV's
    own random key, steps taken, the last effective sample size as a share of its count, whether the
    last step redrew it from an EKF's posterior, position and velocity of the last estimate (of the
    prior before), what sensors' biases have made of the error (see ``agents.models.biases``),
    what the screen remembers, and the covariance of what particles hold only the mean of (of width
    0: nothing); batch (B, N)."""

    particles: Float32[Tensor, "B N M S"]
    log_weights: Float32[Tensor, "B N M"]
    count: Int64[Tensor, "B N"]
    key: Int64[Tensor, "B N"]
    step: Int64[Tensor, "B N"]
    ess_share: Float32[Tensor, "B N"]
    renewed: Bool[Tensor, "B N"]
    last: Float32[Tensor, "B N 2*d"]
    considered: Float[Tensor, "B N E G"]
    memory: Float[Tensor, "B N K"]
    conditional: Float64[Tensor, "B N L L"]

    def shifted(self, offset: Float[Tensor, "B N d"]) -> "ParticleBelief":
        """Its position shifted by ``offset`` (m)."""
        d, offset = offset.shape[-1], offset.to(torch.float32)
        places = self.particles[..., :d] + offset.unsqueeze(-2)
        last = torch.cat((self.last[..., :d] + offset, self.last[..., d:]), -1)
        return self.replace(particles=concat((places, self.particles[..., d:])), last=last)


@dataclass(frozen=True)
class Step:
    """A step's inputs: the belief before it, what is observed, what neighbours sent, how far each
    model's measurements are trusted, the UAVs' random keys for this step, and how landmarks without
    names get some for a Gaussian update."""

    belief: ParticleBelief
    observation: Observation
    neighbours: Neighbours
    trusts: Sequence[Trust]
    key: Int64[Tensor, "B N"]
    association: Association | None = None


def own_keys(observation: Observation, seed: int) -> Int64[Tensor, "B N"]:
    """One random key per UAV, from its prior leaf and the localizer's seed: the same UAV in
    the same world draws the same numbers in any batch, team subset or face."""
    bits = observation["prior"].contiguous().view(torch.int32).to(torch.int64)
    index = torch.arange(bits.shape[-1], device=bits.device)
    return noise.fold(noise.fold(bits, index).sum(-1), seed)


def normal(
    key: Int64[Tensor, "B N"], stream: str, components: int, slots: int, first: int = 0
) -> Float32[Tensor, "B N M E"]:
    """Standard normal numbers for each slot, whatever the number of slots beside it: the stream's
    ``components`` from the ``first`` on; in the memory order of ``geometry.join``."""
    which = torch.arange(first, first + components, device=key.device).view(-1, 1, 1)
    return noise.normal(noise.fold(key, which), stream, slots).movedim(0, -1)


def uniform(
    key: Int64[Tensor, "B N"], stream: str, components: int, slots: int
) -> Float32[Tensor, "B N M E"]:
    """Numbers in (0, 1), as ``normal`` gives normal ones."""
    return (normal(key, stream, components, slots) * 0.5**0.5).erf() * 0.5 + 0.5
