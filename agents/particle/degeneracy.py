"""Weight degeneracy: evidence that leaves too few effective particles, and its remedies."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from agents.particle import particle_count
from agents.particle.belief import ParticleBelief, Step
from agents.particle.cloud import effective_sample_size
from agents.particle.proposal import Guide, guided, proposed
from agents.particle.resampling import RESAMPLE, Renewal
from agents.particle.tempering import Evidence, tempered
from agents.robust import Screen

_START = 3  # steps in which a likelihood is tempered down to ``RESAMPLE`` of the count
_FEW = 0.1  # the share below which particles are drawn anew later


def degenerate(
    log_weights: Float32[Tensor, "B N M"], belief: ParticleBelief
) -> Bool[Tensor, "B N"]:
    """Whether weights are those of too few particles: an effective sample size below half of the
    count in the first steps, below a tenth later."""
    share = torch.full_like(belief.step, _FEW, dtype=torch.float32)
    share = share.masked_fill(belief.step < _START, RESAMPLE)
    return effective_sample_size(log_weights) < share * belief.count


@dataclass(frozen=True)
class Remedy:
    """What a step does for UAVs that its evidence leaves too few particles."""

    evidence: Evidence
    screen: Screen
    renewal: Renewal
    now: Step

    def mended(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        gain: Float32[Tensor, "B N M"],
        few: Bool[Tensor, "B N"],
        guide: Guide | None,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"]]:
        """Particles and unnormalized log-weights where evidence (``gain``) would leave ``few``: in
        the first steps used in stages with a resampling move after each; later, or where a screen
        has a guide at hand, on particles drawn anew. A UAV that needs neither is not touched."""
        late = few if self.screen.judges else few & (self.now.belief.step >= _START)
        early = few & ~late
        if bool(late.any()):
            floor = self.renewal.floor
            guide = guide or guided(self.screen, floor, particles, log_weights, self.now)
            particles, log_weights, gain = self.redrawn(particles, log_weights, gain, late, guide)
        if bool(early.any()):
            evidence, renewal, now = self.evidence, self.renewal, self.now
            return tempered(particles, log_weights, gain, early, evidence, renewal, now)
        return particles, log_weights + gain

    def redrawn(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        gain: Float32[Tensor, "B N M"],
        rows: Bool[Tensor, "B N"],
        guide: Guide,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"], Float32[Tensor, "B N M"]]:
        """For the UAVs marked in ``rows``: particles proposed by the guide, their log-weights, and
        what the evidence says of them. Evidence that even they cannot follow is left to the guide:
        its posterior, as drawn."""
        drawn, ratio = proposed(self.renewal.process, guide, self.now, particles.shape[-2])
        particles = torch.where(rows[..., None, None], drawn, particles)
        log_weights = torch.where(rows.unsqueeze(-1), ratio, log_weights)
        gain = torch.where(rows.unsqueeze(-1), self.evidence(particles, log_weights), gain)
        lost = (rows & degenerate(log_weights + gain, self.now.belief)).unsqueeze(-1)
        equal = particle_count.equal_log_weights(log_weights > -torch.inf)
        return particles, torch.where(lost, equal, log_weights), gain.masked_fill(lost, 0.0)
