"""A policy that corrects a base localizer, trained by MAPPO."""

from agents.policies.learned import PolicyAgent
from coloc_env.scenario import Believed


class Mappo(PolicyAgent):
    """A policy trained by ``coloc train mappo``. ``weights``: a checkpoint's name or path."""

    name = "mappo"

    def __init__(self, believed: Believed, *, weights: str = "mappo") -> None:
        super().__init__(believed, weights=weights)
