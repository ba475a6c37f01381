"""Hybrid filters: a main one, a detector of its failure, and an auxiliary one to restart it from.

NN-HPFF paper: particle filter, Mahalanobis test or neural network, and FIR filter.
"""

from agents.bank import BankOptions
from agents.particle.failure import ChiSquare
from agents.particle.hybrid import HybridFilter
from coloc_env.options import OpenShare, PositiveCount
from coloc_env.scenario import Believed
from coloc_env.sensors import AnchorRanging


class Hpff(HybridFilter):
    """Hybrid particle/FIR filter: a failure is a Mahalanobis distance of the ranges beyond the
    ``quantile`` of χ² (one degree of freedom a range)."""

    name = "hpff"

    def __init__(
        self,
        believed: Believed,
        *,
        main: str = "pf",
        auxiliary: str = "emvf",
        quantile: OpenShare = 0.98,
        patience: PositiveCount = 1,
        bank: BankOptions = BankOptions(),  # noqa: B008
    ) -> None:
        sensor = believed.sensor(AnchorRanging)
        most = 0 if sensor is None else len(sensor.anchors) * sensor.n_tags
        super().__init__(believed, ChiSquare(quantile, most), main, auxiliary, 0.5, patience, bank)
