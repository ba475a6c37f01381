"""ST-DCL: the DW-MDS optimizer and the ST-GNN in a closed loop (paper, sections 4 and 4.2.3)."""

from agents.stdcl.feedback import FeedbackKind
from agents.stdcl.loop import NetworkLoop
from agents.stdcl.network import StGnn
from agents.swarm.confidence import ConfidenceKind
from agents.swarm.dwmds_st import DynamicMds
from agents.weights import learned
from coloc_env.scenario import Believed


class StDcl(NetworkLoop):
    """ST-DCL whole: ``dwmds_st``, the ST-GNN, and the loop between them.

    ``feedback``: ``learned`` (what the shipped weights were trained with), ``paper`` (equation 36),
    ``none``, ``links``, ``positions``. ``confidence``: the optimizer's. ``weights``: a
    checkpoint's name or path, or ``none``.
    """

    name = "stdcl"

    def __init__(
        self,
        believed: Believed,
        *,
        weights: str = "stdcl",
        feedback: FeedbackKind = "learned",
        confidence: ConfidenceKind = "em",
    ) -> None:
        base = DynamicMds(believed, confidence=confidence)
        super().__init__(base, learned(StGnn, weights), feedback)
