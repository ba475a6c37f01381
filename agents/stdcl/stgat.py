"""ST-DCL: the DW-MDS optimizer and the ST-GNN in a closed loop (paper, sections 4 and 4.2.3)."""

from jaxtyping import Float64
from torch import Tensor

from agents.stdcl.loop import REACH, NetworkLoop
from agents.stdcl.network import StGnn
from agents.swarm.belief import Found, Prepared, SwarmBelief
from agents.swarm.filter import SwarmFilter
from agents.weights import learned
from coloc_env.scenario import Believed


class _Reckoned(SwarmFilter):
    """Dead reckoning alone, with all links alike."""

    name = "stgat"

    def find(self, belief: SwarmBelief, now: Prepared) -> Found:
        return Found(now.place, now.variance)


class StGat(NetworkLoop):
    """A purely learned baseline: plain graph attention and the same convolutions correct dead
    reckoning in every step; no optimizer. ``weights``: a checkpoint's name or path, or ``none``."""

    name = "stgat"

    def __init__(self, believed: Believed, *, weights: str = "stgat") -> None:
        network = learned(StGnn, weights, kinematic=False)
        super().__init__(_Reckoned(believed, "none"), network, "positions")

    def _reach(self, now: Prepared, found: Found) -> Float64[Tensor, "B N"]:
        """Three standard deviations of dead reckoning."""
        return REACH * now.variance.sqrt()
