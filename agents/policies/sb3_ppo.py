"""A policy that corrects a base localizer, trained by stable-baselines3's PPO."""

from agents.policies.learned import PolicyAgent
from coloc_env.scenario import Believed


class Sb3Ppo(PolicyAgent):
    """A policy trained by ``coloc train sb3-ppo``. ``weights``: a checkpoint's name or path."""

    name = "sb3-ppo"

    def __init__(self, believed: Believed, *, weights: str = "sb3-ppo") -> None:
        super().__init__(believed, weights=weights)
