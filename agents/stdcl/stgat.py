"""``stgat``: plain graph attention without an optimizer, the learned baseline of ST-DCL."""

from jaxtyping import Float64
from torch import Tensor

from agents.stdcl.loop import MAX_OFFSET, NetworkLoop
from agents.stdcl.network import StGnn
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.filter import SwarmFilter
from agents.weights import learned
from coloc_env.scenario import Believed


class _DeadReckoning(SwarmFilter):
    """Dead reckoning alone, with all links alike."""

    name = "stgat"

    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        return Solution(inputs.prior, inputs.variance)


class StGat(NetworkLoop):
    """A purely learned baseline: plain graph attention and the same convolutions correct dead
    reckoning in every step; no optimizer. ``weights``: a checkpoint's name or path, or ``none``."""

    name = "stgat"

    def __init__(self, believed: Believed, *, weights: str = "stgat") -> None:
        network = learned(StGnn, weights, kinematic=False)
        super().__init__(_DeadReckoning(believed, "none"), network, "positions")

    def _max_offset(self, inputs: StepInput, solution: Solution) -> Float64[Tensor, "B N"]:
        """Three standard deviations of dead reckoning (m)."""
        return MAX_OFFSET * inputs.variance.sqrt()
