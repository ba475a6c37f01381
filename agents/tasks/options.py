"""Options that tasks have in common."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from agents.tasks.space import Space
from coloc_env.motion import Box, Steered
from coloc_env.motion.steered import Control, Jerk
from coloc_env.options import Group, Metres, Quantity

Drift = Annotated[float, Quantity("m/√m", 0.0)]
ESTIMATOR = "ekf_joint@second_order=true@iterations=1"


@dataclass(frozen=True)
class TaskOptions(Group):
    """``estimator``: in the loop, by name, its options after ``@`` (``ekf@fusion=ci``).
    ``reward``: of the ``true`` error, or of the estimator's own ``sigma``, less noisy to learn from
    (scores are of the true error either way). ``credit``: every UAV gets the ``team``'s mean
    reward, or its ``own``. ``telemetry``: agents see all others' estimates (``free``), or what they
    heard last, with its age (``messages``). ``obs``: one ``flat`` vector, or a ``dict`` of its
    parts.
    """

    title: ClassVar[str] = "task"

    estimator: str = ESTIMATOR
    reward: Literal["true", "sigma"] = "true"
    credit: Literal["team", "own"] = "team"
    telemetry: Literal["free", "messages"] = "free"
    obs: Literal["flat", "dict"] = "flat"


@dataclass(frozen=True)
class SteeredTaskOptions(TaskOptions):
    """``control``: an action is a ``velocity`` or an ``acceleration``, in units of the largest;
    ``j_max``: how fast accelerations may change (none: at once). UAVs brake so as not to come
    within ``keep_apart`` m of each other (0: they do not care)."""

    control: Control = "velocity"
    j_max: Jerk | None = None
    keep_apart: Metres = 0.0

    def steered(self, v_max: float, a_max: float, start: Box, space: Space) -> Steered:
        """The motion of those that act."""
        return Steered(self.control, v_max, a_max, start, space.walls, self.j_max, self.keep_apart)
