"""The adaptive particle filter with learned trust in each measurement."""

from typing import Any

from agents.association import AssociationName
from agents.bank import BankOptions
from agents.bank.kalman_fallback import KalmanFallback
from agents.localizer import Localizer
from agents.particle.apf import AdaptiveParticleFilter
from agents.robust import Capped
from agents.trust.screen import learned_screen
from coloc_env.scenario import Believed


class TrustingParticleFilter(AdaptiveParticleFilter):
    """Adaptive particle filter with learned trust in every landmark, bearing and range.

    The networks of ``ekf_trust`` judge by a Gaussian update at the cloud's moments; their weights
    and biases enter every particle's likelihood. ``bank``, ``weights``: as ``ekf_trust`` has them,
    but that the branch beside the particles is ``ekf:robust=huber``. ``association``: as ``ekf``
    has it, at the cloud's moments; other options as ``apf``.
    """

    name = "pf_trust"

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "auto",
        bank: BankOptions = BankOptions(),  # noqa: B008
        association: AssociationName = "joint",
        **options: Any,
    ) -> None:
        super().__init__(believed, association=association, **options)
        if self.printed:
            raise ValueError("variant=paper trusts all measurements alike: apf and pfnn have it")
        self.screen = learned_screen(self.process, self.models, weights, bank.bank, options)

    @classmethod
    def for_team(
        cls,
        believed: Believed,
        *,
        bank: BankOptions = BankOptions(),  # noqa: B008
        **options: Any,
    ) -> Localizer[Any]:
        """The filter, or a bank of it, its weights capped by Huber's, and a Kalman filter."""
        one = cls(believed, bank=bank, **options)
        if not bank.bank:
            return one
        one.screen = Capped(one.screen)
        return KalmanFallback(one, bank, "trust_share")
