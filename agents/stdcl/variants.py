"""ST-DCL with corrections of positions: DW-MDS and the ST-GNN in a closed loop (paper, sections 4
and 4.2.3)."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from agents.stdcl.feedback import KAPPA, FeedbackKind
from agents.stdcl.loop import NetworkLoop
from agents.stdcl.network import StGnn
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.dwmds_st import DynamicMds
from agents.weights import learned
from coloc_env.options import Count, Group, Ratio
from coloc_env.scenario import Believed

Variant = Literal["calibrated", "paper"]


@dataclass(frozen=True)
class LoopOptions(Group):
    """``variant`` decides what is not given of ``feedback`` (``learned``, ``paper``, ``none``,
    ``links``, ``positions``), ``confidence`` (the optimizer's) and ``weights``: each of the shipped
    ones was trained with one feedback and confidence. ``kappa``: κ of equation 36. ``window`` and
    ``adaptive``: the optimizer's, which ``dwmds_st`` explains.
    """

    title: ClassVar[str] = "variant=calibrated or paper"

    feedback: FeedbackKind | None = None
    confidence: ConfidenceKind | None = None
    kappa: Ratio = KAPPA
    window: Count = 0
    adaptive: bool = False


@dataclass(frozen=True)
class _Defaults:
    weights: str
    feedback: FeedbackKind
    confidence: ConfidenceKind


_DEFAULTS: dict[Variant, _Defaults] = {
    "calibrated": _Defaults("stdcl_calibrated", "learned", "em"),
    "paper": _Defaults("stdcl_paper", "paper", "paper"),
}


class StDclLoop(NetworkLoop):
    """``dwmds_st``, the ST-GNN, and the loop between them."""

    name = "stdcl"

    def __init__(
        self, believed: Believed, variant: Variant, weights: str | None, options: LoopOptions
    ) -> None:
        usual = _DEFAULTS[variant]
        base = DynamicMds(
            believed,
            confidence=options.confidence or usual.confidence,
            window=options.window,
            adaptive=options.adaptive,
        )
        network = learned(StGnn, weights or usual.weights)
        super().__init__(base, network, options.feedback or usual.feedback, options.kappa)
