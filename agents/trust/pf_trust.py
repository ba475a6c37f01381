"""The adaptive particle filter with learned trust in each measurement."""

from typing import Any

from agents.particle.apf import AdaptiveParticleFilter
from agents.trust.screen import learned_screen
from coloc_env.scenario import Believed


class TrustingParticleFilter(AdaptiveParticleFilter):
    """Adaptive particle filter with learned trust in every landmark, bearing and range.

    The networks of ``ekf_trust`` judge by a Gaussian update at the cloud's moments; their weights
    and biases enter every particle's likelihood. Other options as ``apf`` has them.
    """

    name = "pf_trust"

    def __init__(self, believed: Believed, *, weights: str = "trust", **options: Any) -> None:
        super().__init__(believed, **options)
        if self.printed:
            raise ValueError("variant=paper trusts all measurements alike: apf and pfnn have it")
        self.screen = learned_screen(self.process, self.models, weights, options)
