"""A learned policy of a task, as heuristics are: from what is seen to actions."""

import torch
from torch import Tensor

from agents.policies.decisions import relations
from agents.policies.moves import table
from agents.policies.task_actor import TaskActor
from agents.tasks.registry import make_task
from agents.tasks.rules import Seen
from agents.tasks.task import Task
from agents.weights import learned


class TaskPolicy:
    """An actor in a task: decisions held as it was trained to, its memory going from step to step.

    It draws actions where it was trained to (the likeliest of equals would collide for ever on a
    channel); else it takes the likeliest, or the mean. An episode's first step is noticed; one
    object is good for one set of worlds at a time.
    """

    def __init__(self, task: Task, actor: TaskActor) -> None:
        self.task, self.actor = task, actor
        settings = actor.architecture
        self.hold: int = settings["hold"]
        moves = settings["moves"]
        self.menu = None if moves == "none" else table(moves, task.dim)
        self._memory: Tensor | None = None
        self._action: Tensor | None = None

    @torch.no_grad()
    def __call__(self, seen: Seen) -> Tensor:
        """Actions [B, n] or [B, n, d]."""
        step = int(seen.memory.step[0, 0])
        if step == 0:
            self._memory = self._action = None
        if self._action is None or step % self.hold == 0:
            self._action = self._decide(seen)
        return self._action

    def _decide(self, seen: Seen) -> Tensor:
        training, actor = self.actor.training, self.actor.eval()
        more = relations(seen.task, seen.memory, actor.network)
        out, self._memory = actor(seen.observation, seen.mask, more, self._memory)
        actor.train(training)
        drawn = actor.architecture["sampled"]
        if not actor.discrete:
            if drawn:
                noise = torch.randn(out.shape, generator=seen.random)
                out = out + actor.scale(out) * noise
            return actor.squash(out)
        if not drawn:
            choice = out.argmax(-1)
        else:
            flat = out.softmax(-1).flatten(0, 1)
            choice = torch.multinomial(flat, 1, generator=seen.random).view(out.shape[:2])
        return choice if self.menu is None else self.menu[choice]


def load_policy(task: Task, weights: str) -> TaskPolicy:
    """A policy from a checkpoint's name or path.

    Raises ValueError for weights that are none, or of another task, and for ones that were trained
    on observations of another width, such as another team's.
    """
    actor = learned(TaskActor, weights)
    trained = make_task(actor.architecture["task"])
    if trained.name != task.name:
        raise ValueError(f"{weights} was trained on {trained.name}, not on {task.name}")
    if not task.flat:
        raise ValueError(f"{weights} reads a flat observation: obs=flat is needed")
    known, width = actor.architecture["observation"], task.leaves["observation"].width
    if known != width:
        raise ValueError(
            f"{weights} reads observations of {known} numbers: this {task.name} has {width}"
        )
    actor.requires_grad_(False)
    return TaskPolicy(task, actor)
