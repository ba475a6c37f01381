"""Filters that trust each measurement as far as a network says: ``ekf_trust``, ``pfnn_trust``."""

from collections.abc import Sequence
from typing import Any

from agents.kalman.ekf import CooperativeEkf
from agents.localizer import register
from agents.models.measurements import Measurement
from agents.models.process import Process
from agents.particle.pf import AdaptiveParticleFilter
from agents.trust import TrustNetwork, TrustScreen
from agents.weights import learned
from coloc_env.scenario import Believed


def _screen(
    process: Process, models: Sequence[Measurement], weights: str, options: dict[str, Any]
) -> TrustScreen:
    """The screen that judges by a checkpoint's networks, and by nothing beside them."""
    if options.get("robust", "none") != "none":
        raise ValueError("robust is not allowed beside learned trust: none")
    return TrustScreen(process, models, learned(TrustNetwork, weights).requires_grad_(False))


@register("ekf_trust")
class TrustingEkf(CooperativeEkf):
    """Cooperative EKF with learned trust in every landmark, bearing and range.

    Two Huber iterations (five where the prior is broad), then one with the weights and range biases
    that the networks give to what they see. ``weights``: a checkpoint's name or path, or ``none``.
    """

    name = "ekf_trust"

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "trust",
        iterations: int = 3,
        **options: Any,
    ) -> None:
        super().__init__(believed, iterations=iterations, **options)
        self.screen = _screen(self.process, self.models, weights, options)

    def learn(self, network: TrustNetwork) -> None:
        """Judge by these networks from now on."""
        self.screen = TrustScreen(self.process, self.models, network)


@register("pfnn_trust")
class TrustingParticleFilter(AdaptiveParticleFilter):
    """Adaptive particle filter with learned trust in every landmark, bearing and range.

    The networks of ``ekf_trust`` judge by a Gaussian update at the cloud's moments; their weights
    and biases enter every particle's likelihood. Other options as ``apf`` has them.
    """

    name = "pfnn_trust"

    def __init__(self, believed: Believed, *, weights: str = "trust", **options: Any) -> None:
        super().__init__(believed, **options)
        self.screen = _screen(self.process, self.models, weights, options)
