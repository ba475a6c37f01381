"""Tasks by name, building one with its options, and their names in other libraries."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo

from coloc_env import options
from coloc_env.registry import Registry

if TYPE_CHECKING:
    from agents.tasks.task import Task

TASKS = Registry(
    "task",
    "coloc.tasks",
    {
        "active-v0": "agents.tasks.active:Active",
        "beacon-hard-v0": "agents.tasks.beacon:BeaconHard",
        "beacon-v0": "agents.tasks.beacon:Beacon",
        "convoy-hard-v0": "agents.tasks.convoy:ConvoyHard",
        "convoy-v0": "agents.tasks.convoy:Convoy",
        "relay-hard-v0": "agents.tasks.relay:RelayHard",
        "relay-v0": "agents.tasks.relay:Relay",
        "schedule-hard-v0": "agents.tasks.schedule:ScheduleHard",
        "schedule-v0": "agents.tasks.schedule:Schedule",
        "survey-hard-v0": "agents.tasks.survey:SurveyHard",
        "survey-v0": "agents.tasks.survey:Survey",
        "track-hard-v0": "agents.tasks.track:TrackHard",
        "track-v0": "agents.tasks.track:Track",
    },
)


def make_task(name: str, **chosen: Any) -> Task:
    """Build a task; ``name`` may carry options as on the command line (``track-v0:drift=0.1``).

    Raises ValueError, in one line that names what is allowed, for an unknown task or option.
    """
    name, *texts = name.split(":")
    factory = TASKS.require(name)
    known = TASKS.options_of(name)
    chosen = options.checked(name, options.parse_all(name, texts, known, chosen), known)
    made: Task = factory(**options.grouped(factory, chosen))
    return made


def register() -> None:
    """Register all tasks with PettingZoo and Gymnasium, as ``coloc/NAME``."""
    for task in TASKS.names():
        name, chosen = f"coloc/{task}", {"task": task}
        if name not in gymnasium.registry:
            home = "agents.tasks.single:SingleAgentTask"
            gymnasium.register(name, home, kwargs=chosen)
        if hasattr(pettingzoo, "register"):  # since 1.27
            for face, maker in (("parallel", "parallel_env"), ("aec", "env")):
                pettingzoo.register(
                    face, name, entry_point=f"agents.tasks.faces:{maker}", kwargs=chosen
                )
