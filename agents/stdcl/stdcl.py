"""ST-DCL: the DW-MDS optimizer and the ST-GNN in a closed loop (paper, sections 4 and 4.2.3)."""

from dataclasses import dataclass
from typing import Any, Literal

from agents.bank import BankOptions
from agents.bank.team import TeamBank
from agents.localizer import Localizer
from agents.stdcl.feedback import KAPPA, FeedbackKind
from agents.stdcl.loop import NetworkLoop
from agents.stdcl.network import StGnn
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.dwmds_st import DynamicMds
from agents.swarm.map import RecursiveMap
from agents.weights import learned
from coloc_env.options import Count, Ratio
from coloc_env.scenario import Believed

Variant = Literal["calibrated", "paper"]


@dataclass(frozen=True)
class _Defaults:
    weights: str
    feedback: FeedbackKind
    confidence: ConfidenceKind


_DEFAULTS: dict[Variant, _Defaults] = {
    "calibrated": _Defaults("stdcl", "learned", "em"),
    "paper": _Defaults("stdcl_paper", "paper", "paper"),
}


class StDcl(NetworkLoop):
    """ST-DCL whole: ``dwmds_st``, the ST-GNN, and the loop between them.

    ``variant``: ``calibrated``, weights of links by the errors that links between anchors show and
    a feedback that is learned; or the ``paper``'s: Huber's loss times equation 17, and the feedback
    of equation 36. It decides what is not given of ``feedback`` (``learned``, ``paper``, ``none``,
    ``links``, ``positions``), ``confidence`` (the optimizer's) and ``weights`` (a checkpoint's name
    or path, or ``none``): each of the shipped ones was trained with one feedback and confidence.
    ``kappa``: κ of equation 36. ``window`` and ``adaptive``: the optimizer's, which ``dwmds_st``
    explains. ``bank=true`` falls back to ``map`` for UAVs whose ranges that predicts better.
    """

    name = "stdcl"

    def __init__(
        self,
        believed: Believed,
        *,
        variant: Variant = "calibrated",
        weights: str | None = None,
        feedback: FeedbackKind | None = None,
        confidence: ConfidenceKind | None = None,
        kappa: Ratio = KAPPA,
        window: Count = 0,
        adaptive: bool = False,
        bank: BankOptions = BankOptions(bank=False),  # noqa: B008
    ) -> None:
        usual = _DEFAULTS[variant]
        base = DynamicMds(
            believed,
            confidence=confidence or usual.confidence,
            window=window,
            adaptive=adaptive,
        )
        network = learned(StGnn, weights or usual.weights)
        super().__init__(base, network, feedback or usual.feedback, kappa)

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
