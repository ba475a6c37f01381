"""A planner: the cross-entropy method over what the team will know, as a reference policy."""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from agents.tasks.prediction import Outlook, Predictor
from agents.tasks.rules import Seen, steer


class Cem(ABC):
    """Velocities of the whole team for the next ``steps`` s, each held for ``hold`` s, from the
    estimates of all: ``samples`` plans are drawn from a Gaussian, which is fitted to the ``elites``
    best of them, ``iterations`` times (Rubinstein and Kroese 2004). The first step of the mean plan
    is taken; the rest of it is where the next step's search starts.

    Plans are judged by what ``gain`` adds up over the steps. One object is good for one set of
    worlds at a time; it sees all that the estimator says, so it is no policy for one UAV.
    """

    steps, hold, samples, elites, iterations = 10, 2, 32, 6, 3
    spread = 0.6  # of plans at first, in units of the top speed

    def __init__(self) -> None:
        self._plan: Tensor | None = None
        self._predictor: Predictor | None = None

    def __call__(self, seen: Seen) -> Float[Tensor, "B n d"]:
        task, memory = seen.task, seen.memory
        step = int(memory.step[0, 0])
        if step == 0 or self._predictor is None or self._predictor.task is not task:
            self._plan, self._predictor = None, Predictor(task)
        b, n, d = len(seen.position), task.n_agents, task.dim
        knots = self.steps // self.hold
        rule = task.policies[task.best](seen).view(b, 1, 1, n, d).expand(-1, 1, knots, -1, -1)
        mean = rule[:, 0] if self._plan is None else self._plan
        std = torch.full_like(mean, self.spread)
        for iteration in range(self.iterations):
            noise = torch.randn(b, self.samples, knots, n, d, generator=seen.random)
            plans = (mean.unsqueeze(1) + std.unsqueeze(1) * noise).clamp(-1.0, 1.0)
            plans[:, 0] = mean
            if iteration == 0:
                plans[:, 1:2] = rule
            worth = self._worth(seen, plans)
            best = worth.topk(self.elites, -1).indices[..., None, None, None]
            elites = plans.gather(1, best.expand(-1, -1, knots, n, d))
            mean, std = elites.mean(1), elites.std(1) + 0.02
        if (step + 1) % self.hold == 0:
            self._plan = torch.cat((mean[:, 1:], mean[:, -1:]), 1)
        else:
            self._plan = mean
        return steer(seen, mean[:, 0])

    def _worth(self, seen: Seen, plans: Float[Tensor, "B S k n d"]) -> Float[Tensor, "B S"]:
        assert self._predictor is not None
        b, s = plans.shape[:2]

        def each(x: Tensor) -> Tensor:
            return x.repeat_interleave(s, 0)

        memory, speed = seen.memory, seen.task.v_max
        now = self._predictor.start(
            each(memory.position), each(memory.velocity), each(memory.joint)
        )
        kept, total = self.begin(seen, s), plans.new_zeros(b * s)
        offset = int(memory.step[0, 0]) % self.hold
        left = seen.task.scenario.horizon - int(memory.step[0, 0])
        for k in range(min(self.steps, left)):
            knot = min((k + offset) // self.hold, plans.shape[2] - 1)
            now = self._predictor.step(now, speed * plans[:, :, knot].flatten(0, 1))
            gain, kept = self.gain(seen, now, kept)
            total = total + gain
        return total.view(b, s)

    def begin(self, seen: Seen, samples: int) -> Tensor | None:
        """What ``gain`` keeps from step to step, at first."""
        return None

    @abstractmethod
    def gain(
        self, seen: Seen, now: Outlook, kept: Tensor | None
    ) -> tuple[Float[Tensor, "M"], Tensor | None]:
        """What a step is worth, and what is kept."""


class OthersKnown(Cem):
    """For tasks whose reward is how well the UAVs that do not act are known."""

    def gain(
        self, seen: Seen, now: Outlook, kept: Tensor | None
    ) -> tuple[Float[Tensor, "M"], Tensor | None]:
        return -now.sigma[:, seen.task.n_agents :].clamp(max=10.0).sum(-1), kept
