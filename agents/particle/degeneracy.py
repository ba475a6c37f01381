"""Weight degeneracy: evidence that leaves too few effective particles, and its remedies."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from agents.particle import particle_count
from agents.particle.belief import Step
from agents.particle.cloud import effective_sample_size
from agents.particle.proposal import ImportanceDensity, draw, importance_density
from agents.particle.resampling import RESAMPLE, Resampling
from agents.particle.tempering import Evidence, tempered
from agents.robust import Screen

_START = 3  # steps in which a likelihood is tempered down to ``RESAMPLE`` of the count
_FEW = 0.1  # the share below which particles are redrawn later


def degenerate(
    log_weights: Float32[Tensor, "B N M"], count: Int64[Tensor, "B N"], step: Int64[Tensor, "B N"]
) -> Bool[Tensor, "B N"]:
    """Whether weights are those of too few particles: an effective sample size below half of the
    count in the first steps, below a tenth later."""
    share = torch.full_like(step, _FEW, dtype=torch.float32)
    share = share.masked_fill(step < _START, RESAMPLE)
    return effective_sample_size(log_weights) < share * count


@dataclass(frozen=True)
class Rejuvenation:
    """What is done for UAVs whose weights degenerate in a step; ``renews``: whether they may be
    redrawn from an EKF's posterior, its measurements judged by ``redrawn_by``."""

    evidence: Evidence
    screen: Screen
    resampling: Resampling
    now: Step
    renews: bool
    redrawn_by: Screen

    def rejuvenate(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        gain: Float32[Tensor, "B N M"],
        few: Bool[Tensor, "B N"],
        density: ImportanceDensity | None,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"], Bool[Tensor, "B N"]]:
        """Particles and unnormalized log-weights where evidence (``gain``) would leave ``few``: in
        the first steps used in stages with a resampling move after each; later, or where a screen
        has made a density already, on redrawn particles (where that is wanted), which is marked.
        Other UAVs keep theirs."""
        late = few if self.screen.judges else few & (self.now.belief.step >= _START)
        late = late & self.renews
        early = few & ~late
        if bool(late.any()):
            floor = self.resampling.floor
            density = density or importance_density(
                self.redrawn_by, floor, particles, log_weights, self.now
            )
            particles, log_weights, gain = self.redraw(particles, log_weights, gain, late, density)
        if bool(early.any()):
            evidence, resampling, now = self.evidence, self.resampling, self.now
            count, key = now.belief.count, now.key
            used = tempered(particles, log_weights, gain, early, evidence, resampling, count, key)
            return *used, late
        return particles, log_weights + gain, late

    def redraw(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        gain: Float32[Tensor, "B N M"],
        rows: Bool[Tensor, "B N"],
        density: ImportanceDensity,
    ) -> tuple[Float32[Tensor, "B N M S"], Float32[Tensor, "B N M"], Float32[Tensor, "B N M"]]:
        """For the UAVs marked in ``rows``: particles drawn from the density, their log-weights,
        and their log-likelihoods. Where even those are degenerate, the density's posterior stands
        as drawn."""
        drawn, ratio = draw(self.screen.process, density, self.now, particles.shape[-2])
        particles = torch.where(rows[..., None, None], drawn, particles)
        log_weights = torch.where(rows.unsqueeze(-1), ratio, log_weights)
        gain = torch.where(rows.unsqueeze(-1), self.evidence(particles, log_weights), gain)
        before = self.now.belief
        few = degenerate(log_weights + gain, before.count, before.step)
        lost = (rows & few).unsqueeze(-1)
        equal = particle_count.equal_log_weights(log_weights > -torch.inf)
        return particles, torch.where(lost, equal, log_weights), gain.masked_fill(lost, 0.0)
