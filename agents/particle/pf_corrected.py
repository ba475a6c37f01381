"""An adaptive particle filter whose likelihood a network corrects by what each particle leaves of
the measurements, trained end to end."""

from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.localizer import Estimate
from agents.particle.apf import AdaptiveParticleFilter
from agents.particle.belief import ParticleBelief, Step
from agents.particle.evidence_corrector import EvidenceCorrector, evidence_features
from agents.particle.soft_resampling import SoftResampling
from agents.weights import learned
from coloc_env.observation import Observation
from coloc_env.options import Share
from coloc_env.scenario import Believed


class CorrectedParticleFilter(AdaptiveParticleFilter):
    """Adaptive particle filter with a learned correction of its likelihood.

    log w ← log w + s · log p(z | x) + c(x): a network gives each particle a correction c within
    ± 3 and each UAV a scale s from 1/4 to 4. It sees the motion that ``pfnn``'s corrector sees, the
    normalized residuals of ranges and of other measurements, the effective sample size, the cloud's
    width and the time. ``weights``: a checkpoint's name or path, or ``none`` for the network
    before training, which corrects nothing. ``soft``: ancestors are drawn from
    soft · w + (1 − soft) / M, and keep w over that as their weight (1: plain resampling). Other
    options as ``apf`` has them, but ``variant``.

    Gradients reach the network through weights alone, from step to step where ``soft`` is
    below 1; particles count as given.
    """

    name = "pf_corrected"
    associates = False

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "pf_corrected",
        soft: Share = 1.0,
        **options: Any,
    ) -> None:
        super().__init__(believed, **options)
        if self.printed:
            raise ValueError("variant=paper has the paper's own corrector: pfnn")
        if soft < 1.0:
            self.resampling = SoftResampling(self.resampling, soft)
        self.corrector = learned(EvidenceCorrector, weights, self.seed).requires_grad_(False)

    def learn(self, network: EvidenceCorrector) -> None:
        """Correct by this network from now on, with gradients."""
        self.corrector = network

    def step(
        self, belief: ParticleBelief, observation: Observation
    ) -> tuple[ParticleBelief, Estimate]:
        after, estimate = super().step(belief, observation)
        return after.replace(particles=after.particles.detach(), last=after.last.detach()), estimate

    def _evidence(
        self,
        particles: Float32[Tensor, "B N M S"],
        log_weights: Float32[Tensor, "B N M"],
        now: Step,
    ) -> Float32[Tensor, "B N M"]:
        gain = super()._evidence(particles.detach(), log_weights, now)
        with torch.no_grad():
            seen = evidence_features(self.models, self.process, particles, log_weights, gain, now)
        correction, scale = self.corrector(seen.features, seen.mean)
        return scale.unsqueeze(-1) * gain + correction
