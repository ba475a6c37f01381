"""Hybrid filters: a main one, a detector of its failure, and an auxiliary one to restart it from.

NN-HPFF paper: particle filter, Mahalanobis test or neural network, and FIR filter.
"""

from typing import Literal

from agents.bank import BankOptions
from agents.particle.failure import ChiSquare, Detector, ResidualSum
from agents.particle.hybrid import HybridFilter
from coloc_env.options import OpenShare, PositiveCount, PositiveMetres
from coloc_env.scenario import Believed
from coloc_env.sensors import AnchorRanging

LIMIT = 0.46  # m: errs least on the worlds that the network is trained on


class Hpff(HybridFilter):
    """Hybrid particle/FIR filter: a failure is a Mahalanobis distance of the ranges beyond the
    ``quantile`` of χ² (one degree of freedom a range).

    ``detector=residuals``: a root mean square of the ranges' residuals beyond ``limit`` m instead,
    whatever is believed of their noise. The default is the one that errs least on the 27 scenarios
    that ``nnhpff`` is trained on.
    """

    name = "hpff"

    def __init__(
        self,
        believed: Believed,
        *,
        main: str = "pf",
        auxiliary: str = "emvf",
        detector: Literal["mahalanobis", "residuals"] = "mahalanobis",
        quantile: OpenShare = 0.98,
        limit: PositiveMetres = LIMIT,
        patience: PositiveCount = 1,
        bank: BankOptions = BankOptions(),  # noqa: B008
    ) -> None:
        sensor = believed.sensor(AnchorRanging)
        most = 0 if sensor is None else len(sensor.anchors) * sensor.n_tags
        test: Detector = ChiSquare(quantile, most)
        if detector == "residuals":
            test = ResidualSum(limit)
        super().__init__(believed, test, main, auxiliary, 0.5, patience, bank)
