"""Dead reckoning: the motion model and its sensors alone."""

from agents.kalman.filter import GaussianFilter
from coloc_env.sensors import Sensor


class DeadReckoning(GaussianFilter):
    """Motion model and its sensors alone: the floor that any measurement should lift."""

    name = "dead_reckoning"
    serves = (Sensor,)  # it ignores what is measured on purpose
