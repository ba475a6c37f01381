"""``survey-v0``: cover an area whose only anchors are in one corner, knowing where one is."""

from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from agents.tasks.task import (
    ESTIMATOR,
    Seen,
    Task,
    TaskMemory,
    idle,
    own_sigma,
    random_policy,
    sensors,
    task_scenario,
    towards,
)
from coloc_env.motion import Arena, Steered
from coloc_env.network import Network
from coloc_env.options import PositiveCount
from coloc_env.scenario import Prior
from coloc_env.world import World

_SIDE, _CELL, _RADIUS, _V_MAX = 100.0, 10.0, 35.0, 4.0
_CELLS = int(_SIDE / _CELL)
_ANCHORS = ((5.0, 5.0), (30.0, 5.0), (5.0, 30.0))
_HOME = (12.0, 12.0)
_KNOWN = 1.0  # m: a cell counts as covered if the error is below
_PLACES = torch.stack(
    torch.meshgrid(*2 * [_CELL * (torch.arange(_CELLS) + 0.5)], indexing="ij"), -1
).flatten(0, 1)  # [cells, 2] centres (m)


def cell_of(position: Float[Tensor, "*s 2"]) -> Tensor:
    """Index of the cell that a place (m) is in."""
    row, column = (position / _CELL).floor().long().clamp(0, _CELLS - 1).unbind(-1)
    return row * _CELLS + column


def nearest(
    seen: Seen, barred: Bool[Tensor, "B n C"] | None = None, home_at: float = torch.inf
) -> Tensor:
    """Each goes to the nearest open cell that nobody before it has chosen; home if it is less sure
    of its position than ``home_at`` m."""
    n = seen.task.n_agents
    own, covered = seen.position[:, :n], seen.memory.more["covered"][:, 0] > 0
    cost = (own.unsqueeze(2) - _PLACES).norm(dim=-1) + 1e3 * covered.unsqueeze(1)
    if barred is not None:
        cost = cost + 500.0 * barred
    goals = []
    for i in range(n):
        choice = cost[:, i].argmin(-1)
        goals.append(_PLACES[choice])
        cost = cost.scatter_add(
            2,
            choice[:, None, None].expand(-1, n, 1),
            torch.full((1, 1, 1), 2e3).expand(len(cost), n, 1),
        )
    goal = torch.stack(goals, 1)
    lost = (seen.sigma[:, :n] > home_at).unsqueeze(-1)
    return towards(seen, torch.where(lost, torch.tensor(_HOME), goal))


def home_when_lost(seen: Seen) -> Tensor:
    """The nearest open cell; home at σ > 1 m."""
    return nearest(seen, home_at=1.0)


def frontier(seen: Seen) -> Tensor:
    """The nearest open cell that at least two anchors or other UAVs are near; home at σ > 1.5 m."""
    n, task = seen.task.n_agents, seen.task
    apart = (seen.position[:, :n].unsqueeze(2) - _PLACES).norm(dim=-1) < task.radius
    near = apart.sum(1, keepdim=True) - apart.long()
    near = near + ((task.anchors.unsqueeze(1) - _PLACES).norm(dim=-1) < task.radius).sum(0)
    return nearest(seen, near < 2, 1.5)


class Survey(Task):
    """Four UAVs cover an area of 100 × 100 m, with three anchors in one corner.

    Reward, the same for all: the percentage of 10 m cells in which a UAV was for the first time
    with a true error below 1 m. ``drift``: odometry's noise, m/√m.
    """

    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "nearest": nearest,
        "home": home_when_lost,
        "frontier": frontier,
    }
    best = "frontier"

    def __init__(
        self,
        *,
        n_uavs: PositiveCount = 4,
        horizon: PositiveCount = 80,
        drift: float = 0.15,
        estimator: str = ESTIMATOR,
    ) -> None:
        scenario = task_scenario(
            "survey-v0",
            sensors(_ANCHORS, 0.05, drift, _RADIUS),
            arena=Arena(2, n_uavs, 1.0, (0.0, 0.0), (_SIDE, _SIDE)),
            horizon=horizon,
            motion=Steered("velocity", _V_MAX, 2.0, ((5.0, 5.0), (30.0, 30.0))),
            network=Network(radius=_RADIUS, max_neighbours=max(16, n_uavs)),
            prior=Prior(0.5),
        )
        super().__init__(scenario, n_uavs, estimator, _RADIUS, _V_MAX)

    def start(self, blank: Float32[Tensor, "B N"]) -> dict[str, Tensor]:
        cells = blank.unsqueeze(-1).expand(*blank.shape, _CELLS**2)
        return {"covered": cells.clone(), "counted": cells.clone()}

    def keep(self, memory: TaskMemory) -> TaskMemory:
        """Mark as covered what a UAV that is sure enough believes to be in."""
        sure = 2**0.5 * own_sigma(memory.joint) < _KNOWN
        memory.more["covered"] = _marked(memory.more["covered"], memory.position, sure)
        return memory

    def extras(self, memory: TaskMemory) -> list[Float32[Tensor, "B n F"]]:
        """5 × 5 cells about the UAV, the way to the nearest open cell, the map in 5 × 5 parts."""
        b, n = len(memory.position), self.n_agents
        grid = memory.more["covered"][:, 0].view(b, _CELLS, _CELLS)
        own = memory.position[:, :n]
        edged = torch.nn.functional.pad(grid, (2, 2, 2, 2), value=1.0).flatten(1)
        cell = cell_of(own)
        step = torch.arange(5)
        about = (cell // _CELLS)[..., None, None] + step[:, None]
        index = about * (_CELLS + 4) + (cell % _CELLS)[..., None, None] + step
        local = edged.gather(1, index.flatten(1)).view(b, n, 25)
        apart = _PLACES - own.unsqueeze(2)
        cost = (apart * apart).sum(-1) + 1e6 * grid.flatten(1).unsqueeze(1)
        choice = cost.argmin(-1)
        way = _PLACES[choice] - own
        length = way.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        coarse = grid.unflatten(1, (5, 2)).unflatten(3, (5, 2)).mean((2, 4)).flatten(1)
        coarse = coarse.unsqueeze(1).expand(-1, n, -1)
        return [2 * local - 1, way / length, length / _SIDE, 2 * coarse - 1]

    def reward(self, memory: TaskMemory, world: World) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        before = memory.more["counted"]
        after = _marked(before, world.now.target, self.error(memory, world) < _KNOWN)
        memory.more["counted"] = after
        new = 100.0 * (after - before)[:, 0].mean(-1, keepdim=True)
        return memory, new.expand(-1, self.n_agents)


def _marked(
    cells: Float32[Tensor, "B N C"], place: Float[Tensor, "B N 2"], where: Bool[Tensor, "B N"]
) -> Float32[Tensor, "B N C"]:
    """Cells with those marked that are at some places; the same for every UAV."""
    value = where.to(cells.dtype)
    found = cells[:, 0].scatter_reduce(1, cell_of(place), value, "amax")
    return found.unsqueeze(1).expand_as(cells).clone()
