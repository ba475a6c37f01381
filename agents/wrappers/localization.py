"""A team's localization beside another environment: what its agents know of where they are."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64
from torch import Tensor

from agents.localizer import Localizer
from agents.registry import make
from coloc_env import options
from coloc_env.commands import Commands
from coloc_env.motion import Arena
from coloc_env.observation import Observation
from coloc_env.scenarios.followed import followed
from coloc_env.world import World


class Localization:
    """B teams whose true positions come from outside: senses them, runs a localizer, and keeps what
    each agent knows of itself and, as heard, of the others.

    Places and velocities go in and out in the other environment's own units: ``metres`` is what one
    of them measures, ``dt`` how many seconds a step of it takes, ``low`` and ``high`` the corners
    of the box that its agents move in (they may leave it). ``overrides``: those of the scenario
    ``followed``: sensors, their noise, anchors, network, prior.

    After ``restart`` and ``move``: ``position``, ``velocity`` and ``std`` [B, N, d] of each agent's
    own estimate; ``heard`` and ``heard_velocity`` [B, N, N, d], what agent i knows of agent j: j's
    estimate where the link carries it in this step, what was heard last, moved on at the velocity
    heard with it, where not, and the middle of the box as long as nothing was heard; ``error``
    [B, N] in m. Raises ValueError for unknown overrides and localizers, and those that do not fit.
    """

    position: Float64[Tensor, "B N d"]
    velocity: Float64[Tensor, "B N d"]
    std: Float64[Tensor, "B N d"]
    heard: Float64[Tensor, "B N N d"]
    heard_velocity: Float64[Tensor, "B N N d"]
    error: Float32[Tensor, "B N"]

    def __init__(
        self,
        localizer: str,
        n_agents: int,
        low: Sequence[float],
        high: Sequence[float],
        metres: float,
        dt: float,
        batch_size: int = 1,
        **overrides: Any,
    ) -> None:
        for name, value in (("metres", metres), ("dt", dt)):
            if not 0 < value < float("inf"):
                raise ValueError(f"Localized: {name}={value} is not allowed: a number > 0")
        if len(low) != len(high) or not all(a < b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"Localized: low={low}, high={high} are no corners of a box")
        if len(low) not in (2, 3):
            raise ValueError(f"Localized: a box of {len(low)} dimensions is not allowed: 2 or 3")
        self.metres, self.dt = metres, dt
        self._low = torch.tensor(low, dtype=torch.float64)
        size = tuple(metres * (b - a) for a, b in zip(low, high, strict=True))
        arena = Arena(len(low), n_agents, dt, (0.0,) * len(low), size)
        chosen = options.checked("Localized", overrides, options.of(followed))
        self.scenario = followed(arena, self._places, **options.grouped(followed, chosen))
        self.localizer: Localizer[Any] = make(localizer, self.scenario)
        self.world = World(self.scenario, batch_size)
        self._true = torch.zeros(batch_size, n_agents, len(low), dtype=torch.float64)
        middle = self._low + 0.5 * torch.tensor(size, dtype=torch.float64) / metres
        self._middle = middle.expand(batch_size, n_agents, n_agents, -1)
        self._belief: Any = None

    def _places(self) -> Float[Tensor, "R N d"]:
        return self._true[self._rows]

    def restart(
        self,
        places: Float[Tensor, "B N d"],
        seeds: Int64[Tensor, "B"] | Sequence[int] | int,
        rows: Bool[Tensor, "B"] | None = None,
    ) -> None:
        """Begin an episode in the rows marked (default: all), of agents at ``places``.

        ``seeds`` are those of the sensors' noise and of the prior, as of ``World.reset``.
        """
        if self._belief is None or rows is None or bool(rows.all()):
            rows = torch.ones(self.world.batch_size, dtype=torch.bool)
        self._take(places)
        self._rows = rows
        observation = self.world.reset(seeds, rows)
        belief, middle = self.localizer.reset(observation), self._middle
        last, speed = middle, torch.zeros_like(middle)
        if not bool(rows.all()):
            fresh = rows.unsqueeze(-1)
            belief = belief.where(fresh.expand(observation.batch_size), self._before)
            last, speed = (
                torch.where(fresh[..., None, None], new, old)
                for new, old in zip((last, speed), self._last, strict=True)
            )
        self._use(belief, observation, last, speed)

    def move(self, places: Float[Tensor, "B N d"]) -> None:
        """One step on, to agents at ``places``. ValueError before the first ``restart``."""
        self.require_start()
        self._take(places)
        self.world.advance(self._estimate.action(), Commands(motion=self._true))
        last = self.heard + self.dt * self.heard_velocity
        self._use(self._belief, self.world.observation(), last, self.heard_velocity)

    def require_start(self) -> None:
        """Raise ValueError before the first ``restart``."""
        if self._belief is None:
            raise ValueError("Localized: reset it before its first step")

    def _take(self, places: Float[Tensor, "B N d"]) -> None:
        """Places in m, in the world's frame."""
        if places.shape != self._true.shape:
            raise ValueError(
                f"Localized: positions of shape {tuple(places.shape)} do not fit: "
                f"{tuple(self._true.shape)} (environments, agents, axes) is needed"
            )
        self._true = self.metres * (places.to(torch.float64) - self._low)

    @torch.no_grad()
    def _use(
        self,
        belief: Any,
        observation: Observation,
        last: Float64[Tensor, "B N N d"],
        speed: Float64[Tensor, "B N N d"],
    ) -> None:
        """Localize at the current step. ``last`` and ``speed``: what is known of those who are not
        heard in it; all that a later reset of other rows needs to do this one again is kept."""
        self._before, self._last = belief, (last, speed)
        self._belief, self._estimate = self.localizer.step(belief, observation)
        estimate, unit = self._estimate, 1 / self.metres
        self.error = self.world.score(estimate.action())[0]
        variance = estimate.covariance.diagonal(dim1=-2, dim2=-1)
        self.position = unit * estimate.position.to(torch.float64) + self._low
        self.velocity = unit * estimate.velocity.to(torch.float64)
        self.std = unit * variance.clamp_min(0.0).sqrt().to(torch.float64)
        own = torch.eye(self.position.shape[1], dtype=torch.bool)
        now = (own | (observation["links"] > 0)).unsqueeze(-1)
        self.heard = torch.where(now, self.position.unsqueeze(1), last)
        self.heard_velocity = torch.where(now, self.velocity.unsqueeze(1), speed)
