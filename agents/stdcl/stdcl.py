"""ST-DCL: the DW-MDS optimizer and the ST-GNN in a closed loop (paper, sections 4 and 4.2.3)."""

from typing import Any

from agents.bank import BankOptions
from agents.bank.team import TeamBank
from agents.localizer import Localizer
from agents.stdcl.feedback import FeedbackKind
from agents.stdcl.loop import NetworkLoop
from agents.stdcl.network import StGnn
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.dwmds_st import DynamicMds
from agents.swarm.map import RecursiveMap
from agents.weights import learned
from coloc_env.scenario import Believed


class StDcl(NetworkLoop):
    """ST-DCL whole: ``dwmds_st``, the ST-GNN, and the loop between them.

    ``feedback``: ``learned`` (what the shipped weights were trained with), ``paper`` (equation 36),
    ``none``, ``links``, ``positions``. ``confidence``: the optimizer's. ``weights``: a
    checkpoint's name or path, or ``none``. ``bank=true`` falls back to ``map`` for UAVs whose
    ranges that predicts better.
    """

    name = "stdcl"

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "stdcl",
        feedback: FeedbackKind = "learned",
        confidence: ConfidenceKind = "em",
        bank: BankOptions = BankOptions(bank=False),  # noqa: B008
    ) -> None:
        base = DynamicMds(believed, confidence=confidence)
        super().__init__(base, learned(StGnn, weights), feedback)

    @classmethod
    def for_team(
        cls,
        believed: Believed,
        *,
        bank: BankOptions = BankOptions(bank=False),  # noqa: B008
        **options: Any,
    ) -> Localizer[Any]:
        """The loop, or a bank of it and ``map``."""
        one = cls(believed, bank=bank, **options)
        return TeamBank(one, RecursiveMap(believed), bank) if bank.bank else one
