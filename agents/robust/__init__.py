"""Which measurements to trust: screens that every filter's update works through."""

from agents.robust.capped import Capped
from agents.robust.combined import METHODS, RobustScreen
from agents.robust.screen import Fixed, Prediction, Screen, Trust
from agents.robust.soft import SoftName, soft_trust, widened

__all__ = [
    "METHODS",
    "Capped",
    "Fixed",
    "Prediction",
    "RobustScreen",
    "Screen",
    "SoftName",
    "Trust",
    "soft_trust",
    "widened",
]
