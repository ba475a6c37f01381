"""A policy that localizes alone, by displacements, trained by IPPO."""

from agents.policies.learned import PolicyAgent
from coloc_env.scenario import Believed


class Ippo(PolicyAgent):
    """A policy trained by ``coloc train ippo``. ``weights``: a checkpoint's name or path."""

    name = "ippo"

    def __init__(self, believed: Believed, *, weights: str = "ippo") -> None:
        super().__init__(believed, weights=weights)
