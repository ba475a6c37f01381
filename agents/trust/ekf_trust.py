"""The cooperative EKF with learned trust in each measurement."""

from typing import Any

from agents.kalman.ekf import CooperativeEkf
from agents.trust.network import TrustNetwork
from agents.trust.screen import TrustScreen, learned_screen
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed


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
        iterations: PositiveCount = 3,
        **options: Any,
    ) -> None:
        super().__init__(believed, iterations=iterations, **options)
        self.screen = learned_screen(self.process, self.models, weights, options)

    def learn(self, network: TrustNetwork) -> None:
        """Judge by these networks from now on."""
        self.screen = TrustScreen(self.process, self.models, network)
