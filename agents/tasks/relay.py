"""``relay-v0``: carry positions from anchors at one edge to scouts far out."""

from typing import ClassVar

import torch
from jaxtyping import Float32
from torch import Tensor

from agents.tasks.cem import OthersKnown
from agents.tasks.gains import directions
from agents.tasks.memory import TaskMemory
from agents.tasks.options import Drift, SteeredTaskOptions
from agents.tasks.rules import Seen, idle, random_policy, steer, towards
from agents.tasks.space import CRUISE, Space
from agents.tasks.task import MOST_ERROR, Task, sensors, task_scenario
from coloc_env.motion import Groups, Roam
from coloc_env.network import Network
from coloc_env.options import PositiveCount, Uavs
from coloc_env.scenario import Prior
from coloc_env.world import World

_SIZE, _RADIUS, _V_MAX, _A_MAX = (160.0, 100.0), 40.0, 3.0, 1.5
_WALLS = (((45.0, 20.0), (48.0, 80.0)), ((100.0, 0.0), (103.0, 40.0)))
_ANCHORS = ((0.0, 20.0), (0.0, 50.0), (0.0, 80.0))
_SCOUTS = ((80.0, 25.0), (130.0, 75.0))  # m: where they roam
_OWN = 0.02  # weight of the relays' own variance, beside the scouts'
_AHEAD = 2.0  # s that the greedy policy looks ahead
_TAIL, _FADES = 0.02, 10.0  # what a range out of reach is worth, that there is a way back, and m
_HEADINGS = torch.cat(
    (
        torch.zeros(1, 2),
        torch.stack(
            [(0.25 * torch.pi * torch.arange(8)).cos(), (0.25 * torch.pi * torch.arange(8)).sin()],
            -1,
        ),
    )
)


def follow(seen: Seen) -> Tensor:
    """Each goes to the nearest scout."""
    n = seen.task.n_agents
    scouts = seen.position[:, n:]
    apart = (seen.position[:, :n].unsqueeze(2) - scouts.unsqueeze(1)).norm(dim=-1)
    choice = apart.argmin(-1).unsqueeze(-1).expand(-1, -1, scouts.shape[-1])
    goal = scouts.gather(1, choice)
    return towards(seen, goal)


def lattice(seen: Seen) -> Tensor:
    """Fixed places between the anchors and where scouts may be, no two neighbours out of reach."""
    places = torch.tensor([[32.0, 35.0], [32.0, 65.0], [64.0, 50.0], [95.0, 35.0], [95.0, 65.0]])
    n = seen.task.n_agents
    return towards(seen, places[torch.arange(n) % 5].expand(len(seen.position), -1, -1))


def greedy(seen: Seen) -> Tensor:
    """Each takes the heading that will take most off the scouts' predicted variance in 2 s,
    those before it having moved already."""
    task, n = seen.task, seen.task.n_agents
    b, total, d = seen.position.shape
    joint = seen.memory.joint.double()
    p = joint.transpose(2, 3).reshape(b, d * total, d * total)
    added = torch.full((total,), 0.3**2 + 0.1**2 * 1.5, dtype=p.dtype).repeat_interleave(d)
    headings = torch.nn.functional.pad(_HEADINGS, (0, d - 2))
    prior = torch.linalg.inv(p + torch.diag(_AHEAD * added))
    ahead = seen.position.clone()
    ahead[:, n:] += _AHEAD * seen.memory.velocity[:, n:]
    ahead = torch.minimum(ahead.clamp_min(0.0), task.high)
    best = torch.zeros(b, n, d)
    for i in range(n):
        moved = seen.position[:, i].unsqueeze(1) + _AHEAD * task.v_max * headings
        moved = torch.minimum(moved.clamp_min(0.0), task.high)  # [B, 9, d]
        place = ahead.unsqueeze(1).repeat(1, len(_HEADINGS), 1, 1)
        place[:, :, i] = moved
        information = prior.unsqueeze(1) + _information(place.flatten(0, 1), task).view(
            b, len(_HEADINGS), *prior.shape[1:]
        )
        after = torch.linalg.inv(information).diagonal(dim1=-2, dim2=-1)
        cost = after[..., d * n :].sum(-1) + _OWN * after[..., : d * n].sum(-1)
        choice = cost.argmin(-1)
        best[:, i] = headings[choice]
        ahead[:, i] = moved[torch.arange(b), choice]
    if d == 3:
        best[..., 2] = ((CRUISE - seen.position[:, :n, 2]) / task.v_max).clamp(-1.0, 1.0)
    return steer(seen, best)


def _information(place: Float32[Tensor, "B N d"], task: Task) -> Tensor:
    """Information (1/m²) of the ranges between UAVs, and to anchors, from some places [B, dN, dN];
    it fades where they are about to lose each other."""
    b, n, d = place.shape
    unit, distance, variance = directions(place, place)
    unit = unit.double()
    weight = (_reached(distance, task.radius) / variance).double()
    weight.diagonal(dim1=1, dim2=2).zero_()
    each = weight[..., None, None] * unit.unsqueeze(-1) * unit.unsqueeze(-2)
    blocks = -each
    own = each.sum(2)
    to, far, spread = directions(place, task.anchors.expand(b, -1, -1))
    to = to.double()
    heard = (_reached(far, task.radius) / spread).double()
    own = own + (heard[..., None, None] * to.unsqueeze(-1) * to.unsqueeze(-2)).sum(2)
    i = torch.arange(n, device=blocks.device)
    blocks[:, i, i] = own
    return blocks.transpose(2, 3).reshape(b, d * n, d * n)


def _reached(distance: Tensor, radius: float) -> Tensor:
    """How much of a range counts: all within the radius, little beyond, less the farther."""
    beyond = (distance - radius + 1.0).clamp_min(0.0)
    return torch.where(beyond == 0, 1.0, _TAIL * (-beyond / _FADES).exp())


class Relay(Task):
    """Five relays steer so that two scouts, far out on waypoints of their own, know where they are;
    three anchors at the left edge of 160 × 100 m.

    Reward, the same for all: minus the mean error of the scouts / 10, of errors up to 10 m.
    ``drift``: odometry's noise, m/√m.
    """

    name = "relay-v0"
    shared = True
    policies: ClassVar = {
        "random": random_policy,
        "idle": idle,
        "follow": follow,
        "lattice": lattice,
        "greedy": greedy,
    }
    planners: ClassVar = {"cem": OthersKnown}
    best = "greedy"

    def __init__(
        self,
        *,
        n_uavs: Uavs = 5,
        scouts: PositiveCount = 2,
        horizon: PositiveCount = 100,
        drift: Drift = 0.1,
        task: SteeredTaskOptions = SteeredTaskOptions(),
    ) -> None:
        total, space = n_uavs + scouts, Space(_SIZE, self.hard, _WALLS)
        end = (42.0, 80.0) if self.hard else (60.0, 80.0)  # m: not inside a wall
        steered = task.steered(_V_MAX, _A_MAX, space.start((5.0, 20.0), end), space)
        roam = Roam(1.5, space.over(*_SCOUTS))
        scenario = task_scenario(
            self.name,
            sensors(space.anchors(_ANCHORS), 0.3, drift, _RADIUS, space.walls),
            arena=space.arena(total),
            horizon=horizon,
            motion=Groups(((steered, n_uavs), (roam, scouts))),
            network=Network(_RADIUS, space.walls, max_neighbours=max(16, total)),
            prior=Prior(0.5),
        )
        super().__init__(scenario, n_uavs, task, _RADIUS, _V_MAX, _A_MAX)

    def own_reward(
        self, memory: TaskMemory, world: World
    ) -> tuple[TaskMemory, Float32[Tensor, "B n"]]:
        error = self.cost(memory, world)[:, self.n_agents :]
        team = -error.mean(-1, keepdim=True) / MOST_ERROR
        return memory, team.expand(-1, self.n_agents)


class RelayHard(Relay):
    """``relay-v0`` in three dimensions, 20 m high, with two walls of 12 m, over which scouts roam;
    anchors are on masts."""

    name = "relay-hard-v0"
    hard = True
