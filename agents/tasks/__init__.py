"""Named tasks in which decisions matter: who goes where, and who exchanges with whom.

``make_task("survey-v0")`` is an action mode that any environment takes, with a scenario of its own:
``coloc_env.parallel_env(task.scenario, action=task)``. ``TASKS`` lists them, those of installed
packages included (entry points ``coloc.tasks``).
"""

from agents.tasks.registry import TASKS, make_task

__all__ = ["TASKS", "make_task"]
