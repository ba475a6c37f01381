"""What a team knows of its motion, used like a sensor: nobody flies fast for long."""

from dataclasses import dataclass

from torch import Tensor

from coloc_env.sensors.base import Layout, Leaf, Sensor, Window, require


@dataclass(frozen=True)
class SlowFlight(Sensor):
    """No leaf: a belief that every UAV's velocity is about zero, worth one measurement with
    standard deviation ``std`` (m/s) per axis and step.

    Velocities are correlated over a time τ, so a typical speed s is worth std = s √(2τ / dt).
    """

    std: float

    def __post_init__(self) -> None:
        require(self.std > 0, self, "std", "a standard deviation in m/s > 0")

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {}
