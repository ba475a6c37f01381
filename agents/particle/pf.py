"""Particle filters with a fixed number of particles, at the sizes that the papers compare.

``pf500`` and ``pf800`` are not bootstrap filters throughout: see ``ParticleFilter``.
"""

from typing import Any

from agents.particle.filter import ParticleFilter, Particles
from coloc_env.scenario import Believed


class Pf(ParticleFilter):
    """SIR particle filter with 5000 particles per UAV and no tempering (NN-HPFF paper)."""

    name = "pf"
    associates = True

    def __init__(
        self,
        believed: Believed,
        *,
        particles: Particles = 5000,
        tempering: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(believed, particles=particles, tempering=tempering, **options)


class Pf500(ParticleFilter):
    """SIR particle filter with 500 particles per UAV: it tempers the likelihood in the first steps,
    and later, where few particles are effective, redraws them from an EKF's posterior, with
    importance weights (``tempering=false``: neither, plain SIR)."""

    name = "pf500"
    associates = True

    def __init__(self, believed: Believed, *, particles: Particles = 500, **options: Any) -> None:
        super().__init__(believed, particles=particles, **options)


class Pf800(ParticleFilter):
    """SIR particle filter with 800 particles per UAV, tempered at first and redrawn from an EKF's
    posterior as ``pf500`` is."""

    name = "pf800"
    associates = True

    def __init__(self, believed: Believed, *, particles: Particles = 800, **options: Any) -> None:
        super().__init__(believed, particles=particles, **options)
