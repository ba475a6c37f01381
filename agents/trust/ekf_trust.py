"""The cooperative EKF with learned trust in each measurement."""

from typing import Any

from agents.bank import Bank, BankOptions
from agents.kalman.ekf import CooperativeEkf
from agents.localizer import Localizer
from agents.trust.network import TrustNetwork
from agents.trust.screen import TrustScreen, learned_screen
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed


class TrustingEkf(CooperativeEkf):
    """Cooperative EKF with learned trust in every landmark, bearing and range.

    Huber iterations (three more where the prior is broad), then one with the weights and range
    biases that the networks give to what they see, where those are no larger than Huber's. A UAV
    speaks with this branch while it predicts no worse than one with Huber's weights alone;
    ``bank=false`` is the networks' alone, without Huber's cap. ``weights``: a checkpoint's name or
    path, ``none``, or ``auto``: ``trust_bank``, without a bank ``trust``. ``iterations``: none: two
    in a bank, as ``ekf`` has them, three without.
    """

    name = "ekf_trust"

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "auto",
        iterations: PositiveCount | None = None,
        bank: BankOptions = BankOptions(),  # noqa: B008
        **options: Any,
    ) -> None:
        super().__init__(believed, iterations=iterations or (2 if bank.bank else 3), **options)
        self.screen = learned_screen(self.process, self.models, weights, bank.bank, options)

    @classmethod
    def for_team(
        cls,
        believed: Believed,
        *,
        bank: BankOptions = BankOptions(),  # noqa: B008
        **options: Any,
    ) -> Localizer[Any]:
        """The filter, or a bank of it and one with Huber's weights. ValueError for a fusion that it
        does not have."""
        cls.require_sense(options)
        if options.get("fusion") == "pairwise" and believed.message_delay:
            raise ValueError("fusion=pairwise is not allowed with message_delay: only for ekf")
        one = cls(believed, bank=bank, **options)
        return Bank(one, bank) if bank.bank else one

    def learn(self, network: TrustNetwork) -> None:
        """Judge by these networks from now on."""
        self.screen = TrustScreen(self.process, self.models, network)
