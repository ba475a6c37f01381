"""The particle filter that adapts its number of particles (PF-NN paper, equation 17, Algorithm
2)."""

from typing import Any

from agents.particle.filter import ParticleFilter, Particles
from coloc_env.scenario import Believed


class AdaptiveParticleFilter(ParticleFilter):
    """SIR particle filter that adapts its number of particles (PF-NN paper, without network).

    It starts with ``particles`` and stays within ``bounds``: 100 more where the effective sample
    size falls below 0.3 of the count, 50 fewer where it exceeds 0.8. It tempers
    the likelihood in the first steps, and later, where few particles are effective, redraws them
    from an EKF's posterior, with importance weights.
    """

    name = "apf"
    associates = True

    def __init__(
        self,
        believed: Believed,
        *,
        particles: Particles = 300,
        bounds: tuple[Particles, Particles] | None = (100, 800),
        **options: Any,
    ) -> None:
        super().__init__(believed, particles=particles, bounds=bounds, **options)
