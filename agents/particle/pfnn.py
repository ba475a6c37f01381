"""PF-NN: the adaptive particle filter with a neural weight corrector (Wang, Wang & Liu 2026)."""

from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.particle.apf import AdaptiveParticleFilter
from agents.particle.belief import ParticleBelief
from agents.particle.corrector import WeightCorrector, motion_features
from agents.weights import learned
from coloc_env.options import Factor
from coloc_env.scenario import Believed


class NeuralParticleFilter(AdaptiveParticleFilter):
    """Adaptive particle filter whose weights a small network corrects by each particle's motion.

    ``weights``: a checkpoint's name or path, or ``none`` for an untrained network (drawn from
    ``seed``). ``correction``: the range of the factor c = low + (high − low) y (equation 14 has
    0.7 + 0.6 (y − ½), that is 0.4 to 1). Other options as ``apf`` has them.
    """

    name = "pfnn"

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "pfnn",
        correction: tuple[Factor, Factor] = (0.4, 1.0),
        **options: Any,
    ) -> None:
        super().__init__(believed, **options)
        if correction[0] > correction[1]:
            raise ValueError(f"correction={correction} is not allowed: low,high with low ≤ high")
        self.correction = correction
        self.corrector = learned(WeightCorrector, weights, self.seed)

    @torch.no_grad()
    def log_correction(
        self, particles: Float32[Tensor, "B N M S"], belief: ParticleBelief
    ) -> Float32[Tensor, "B N M"]:
        """log c of equation 14, from the motion since the last estimate (equations 11 to 13)."""
        low, high = self.correction
        y = self.corrector(motion_features(particles, belief.last, self.process.dim))
        return (low + (high - low) * y).log()
