"""Named tasks in which decisions matter: who goes where, and who exchanges with whom.

``make_task("survey-v0")`` is an action mode that any environment takes, with a scenario of its own;
``parallel_env("survey-v0")``, ``env``, ``torchrl_env`` and ``vec_env`` put it on a library's face,
and so do ``pettingzoo.make`` and ``gymnasium.make`` with ``coloc/survey-v0``. ``TASKS`` lists them,
those of installed packages included (entry points ``coloc.tasks``).
"""

import importlib
from typing import TYPE_CHECKING, Any

from agents.tasks.registry import TASKS, make_task, register

if TYPE_CHECKING:
    from agents.tasks.faces import env, parallel_env, torchrl_env, vec_env

__all__ = ["TASKS", "env", "make_task", "parallel_env", "torchrl_env", "vec_env"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module("agents.tasks.faces"), name)


register()
