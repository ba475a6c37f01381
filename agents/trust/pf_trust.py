"""The adaptive particle filter with learned trust in each measurement."""

from typing import Any

from agents.bank import Bank, BankOptions
from agents.localizer import Localizer
from agents.particle.apf import AdaptiveParticleFilter
from agents.trust.screen import learned_screen
from coloc_env.scenario import Believed


class TrustingParticleFilter(AdaptiveParticleFilter):
    """Adaptive particle filter with learned trust in every landmark, bearing and range.

    The networks of ``ekf_trust`` judge by a Gaussian update at the cloud's moments; their weights
    and biases enter every particle's likelihood. ``bank``, ``weights``: as ``ekf_trust`` has them;
    other options as ``apf``.
    """

    name = "pf_trust"

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "auto",
        bank: BankOptions = BankOptions(),  # noqa: B008
        **options: Any,
    ) -> None:
        super().__init__(believed, **options)
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
        """The filter, or a bank of it and one with Huber's weights."""
        one = cls(believed, bank=bank, **options)
        return Bank(one, bank) if bank.bank else one
