"""``survey-v0``: cover an area whose only anchors are in one corner, knowing where one is."""

from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from agents.tasks.cem import Cem
from agents.tasks.memory import TaskMemory, total_sigma
from agents.tasks.options import Drift, SteeredTaskOptions
from agents.tasks.prediction import Outlook
from agents.tasks.rules import Seen, idle, random_policy, towards
from agents.tasks.space import Space
from agents.tasks.task import Task, sensors, task_scenario
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.options import PositiveCount, Uavs
from coloc_env.scenario import Prior
from coloc_env.world import World

_SIDE, _CELL, _RADIUS, _V_MAX, _A_MAX = 100.0, 10.0, 35.0, 4.0, 2.0
_CELLS = int(_SIDE / _CELL)
_ANCHORS = ((5.0, 5.0), (30.0, 5.0), (5.0, 30.0))
_HOME = (12.0, 12.0)
_WALLS = (((40.0, 10.0), (43.0, 60.0)), ((60.0, 40.0), (63.0, 90.0)))
_KNOWN = 1.0  # m: a cell counts as covered if the error is below
_PLACES = torch.stack(
    torch.meshgrid(*2 * [_CELL * (torch.arange(_CELLS) + 0.5)], indexing="ij"), -1
).flatten(0, 1)  # [cells, 2] centres (m)


def cell_of(position: Float[Tensor, "*s d"]) -> Tensor:
    """Index of the cell that a place (m) is in, or above."""
    row, column = (position[..., :2] / _CELL).floor().long().clamp(0, _CELLS - 1).unbind(-1)
    return row * _CELLS + column


def nearest(
    seen: Seen, barred: Bool[Tensor, "B n C"] | None = None, home_at: float = torch.inf
) -> Tensor:
    """Each goes to the nearest open cell that nobody before it has chosen; home if σ, all axes
    together, is above ``home_at`` m."""
    n = seen.task.n_agents
    own, covered = seen.plane[:, :n], seen.memory.more["covered"][:, 0] > 0
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
    lost = (total_sigma(seen.memory.joint)[:, :n] > home_at).unsqueeze(-1)
    return towards(seen, torch.where(lost, torch.tensor(_HOME), goal))


def home_when_lost(seen: Seen) -> Tensor:
    """The nearest open cell; home at σ > 1 m, where cells are about to count no more."""
    return nearest(seen, home_at=_KNOWN)


def frontier(seen: Seen) -> Tensor:
    """The nearest open cell that at least two anchors or other UAVs are near; home at σ > 1 m."""
    n, task = seen.task.n_agents, seen.task
    apart = (seen.plane[:, :n].unsqueeze(2) - _PLACES).norm(dim=-1) < task.radius
    near = apart.sum(1, keepdim=True) - apart.long()
    near = near + ((task.anchors[:, None, :2] - _PLACES).norm(dim=-1) < task.radius).sum(0)
    return nearest(seen, near < 2, _KNOWN)


class Planner(Cem):
    """Cross-entropy planning of the next 10 s, for what will be covered."""

    def begin(self, seen: Seen, samples: int) -> Tensor:
        return seen.memory.more["covered"][:, 0].repeat_interleave(samples, 0)

    def gain(
        self, seen: Seen, now: Outlook, kept: Tensor | None
    ) -> tuple[Float[Tensor, "M"], Tensor | None]:
        assert kept is not None
        known = 1 - (-(_KNOWN**2) / now.sigma.clamp_min(1e-3) ** 2).exp()
        after = kept.scatter_reduce(1, cell_of(now.position), known, "amax")
        return (after - kept).sum(-1), after


class Survey(Task):
    """Four UAVs cover an area of 100 × 100 m, with three anchors in one corner.

    Reward of the team: the percentage of 10 m cells in which a UAV was for the first time with a
    true error below 1 m. ``drift``: odometry's noise, m/√m.
    """

    name = "survey-v0"
    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "nearest": nearest,
        "home": home_when_lost,
        "frontier": frontier,
    }
    planners: ClassVar = {"cem": Planner}
    best = "frontier"
    about: ClassVar = {
        "map": "the 5 × 5 cells about the own one: open −1, covered or outside 1",
        "open": "unit vector to the nearest open cell",
        "distance": "distance to it / 100 m",
        "coarse": "share of covered cells in each of 5 × 5 parts of the area, as −1 … 1",
    }

    def __init__(
        self,
        *,
        n_uavs: Uavs = 4,
        horizon: PositiveCount = 80,
        drift: Drift = 0.15,
        task: SteeredTaskOptions = SteeredTaskOptions(),
    ) -> None:
        space = Space((_SIDE, _SIDE), self.hard, _WALLS)
        scenario = task_scenario(
            self.name,
            sensors(space.anchors(_ANCHORS), 0.05, drift, _RADIUS, space.walls),
            arena=space.arena(n_uavs),
            horizon=horizon,
            motion=task.steered(_V_MAX, _A_MAX, space.start((5.0, 5.0), (30.0, 30.0)), space),
            network=Network(_RADIUS, space.walls, max_neighbours=max(16, n_uavs)),
            prior=Prior(0.5),
        )
        super().__init__(scenario, n_uavs, task, _RADIUS, _V_MAX, _A_MAX)

    def start(self, blank: Float32[Tensor, "B N"]) -> dict[str, Tensor]:
        cells = blank.unsqueeze(-1).expand(*blank.shape, _CELLS**2)
        names = ("covered", "counted", *(("map",) if self.messages else ()))
        return {name: cells.clone() for name in names}

    def keep(self, memory: TaskMemory, observation: Observation) -> TaskMemory:
        """Mark as covered what a UAV that is sure enough believes to be in. Where agents know what
        they heard, each keeps a map of its own, and joins to it the maps of those it hears."""
        sure = (total_sigma(memory.joint) < _KNOWN).to(torch.float32)
        memory.more["covered"] = _marked(memory.more["covered"], memory.position, sure)
        if self.messages:
            known, came = memory.more["map"], observation["message_mask"]
            theirs = (known.unsqueeze(1) * came.unsqueeze(-1)).amax(2)
            own = torch.nn.functional.one_hot(cell_of(memory.position), _CELLS**2)
            memory.more["map"] = torch.maximum(
                torch.maximum(known, theirs), own * sure.unsqueeze(-1)
            )
        return memory

    def extras(self, memory: TaskMemory) -> dict[str, Float32[Tensor, "B n F"]]:
        b, n = len(memory.position), self.n_agents
        known = memory.more["map" if self.messages else "covered"].view(b, n, _CELLS, _CELLS)
        own = memory.position[:, :n, :2]
        edged = torch.nn.functional.pad(known, (2, 2, 2, 2), value=1.0).flatten(2)
        cell = cell_of(own)
        step = torch.arange(5, device=own.device)
        about = (cell // _CELLS)[..., None, None] + step[:, None]
        index = about * (_CELLS + 4) + (cell % _CELLS)[..., None, None] + step
        local = edged.gather(2, index.flatten(2))
        places = _PLACES.to(own.device)
        apart = places - own.unsqueeze(2)
        cost = (apart * apart).sum(-1) + 1e6 * known.flatten(2)
        choice = cost.argmin(-1)
        way = places[choice] - own
        length = way.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        coarse = known.unflatten(2, (5, 2)).unflatten(4, (5, 2)).mean((3, 5)).flatten(2)
        return {
            "map": 2 * local - 1,
            "open": way / length,
            "distance": length / _SIDE,
            "coarse": 2 * coarse - 1,
        }

    def secrets(self, memory: TaskMemory) -> list[Float32[Tensor, "B F"]]:
        return [2 * memory.more["counted"][:, 0] - 1]

    def own_reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        """What each adds to the team's cells, in order, times how many UAVs there are."""
        before, place = memory.more["counted"], world.now.target
        known = self.known(memory, world, _KNOWN)
        if self.chosen.credit == "team":
            after = _marked(before, place, known)
            memory.more["counted"] = after
            new = 100.0 * (after - before)[:, 0].mean(-1, keepdim=True)
            return memory, new.expand(-1, self.n_agents)
        cells, cell, own = before[:, 0].clone(), cell_of(place), []
        for i in range(self.n_agents):
            there = cell[:, i : i + 1]
            found = cells.gather(1, there)
            most = torch.maximum(found, known[:, i : i + 1])
            own.append(most - found)
            cells.scatter_(1, there, most)
        memory.more["counted"] = cells.unsqueeze(1).expand_as(before).clone()
        return memory, 100.0 * self.n_agents / _CELLS**2 * torch.cat(own, -1)


def _marked(
    cells: Float32[Tensor, "B N C"], place: Float[Tensor, "B N d"], value: Float[Tensor, "B N"]
) -> Float32[Tensor, "B N C"]:
    """Cells with those at some places marked by values of 0 … 1; the same for every UAV."""
    found = cells[:, 0].scatter_reduce(1, cell_of(place), value, "amax")
    return found.unsqueeze(1).expand_as(cells).clone()


class SurveyHard(Survey):
    """``survey-v0`` in three dimensions, 20 m high, with two walls of 12 m; anchors are on masts.

    Cells are of the ground: whoever is above one covers it.
    """

    name = "survey-hard-v0"
    hard = True
