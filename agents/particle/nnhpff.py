"""Hybrid filters: a main one, a detector of its failure, and an auxiliary one to restart it from.

NN-HPFF paper: particle filter, Mahalanobis test or neural network, and FIR filter.
"""

from agents.bank import BankOptions
from agents.particle.failure import FailureDetector, NeuralDetector
from agents.particle.hybrid import HybridFilter
from agents.weights import learned
from coloc_env.options import PositiveCount, Share
from coloc_env.scenario import Believed


class NeuralHpff(HybridFilter):
    """Hybrid particle/FIR filter: a failure is what a 5–10–5–2 network gives a probability above
    ``threshold``. ``weights``: a checkpoint's name or path, or ``none``."""

    name = "nnhpff"

    def __init__(
        self,
        believed: Believed,
        *,
        main: str = "pf",
        auxiliary: str = "emvf",
        weights: str = "nnhpff",
        threshold: Share = 0.5,
        patience: PositiveCount = 1,
        bank: BankOptions = BankOptions(),  # noqa: B008
    ) -> None:
        network = learned(FailureDetector, weights).requires_grad_(False)
        super().__init__(
            believed, NeuralDetector(network), main, auxiliary, threshold, patience, bank
        )

    def learn(self, network: FailureDetector) -> None:
        """Judge by this network from now on."""
        self.detector = NeuralDetector(network)
