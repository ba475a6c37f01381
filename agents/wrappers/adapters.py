"""Adapters of tasks that many people use: mpe2's ``simple_spread``, VMAS's ``navigation`` and
``flocking``. One of your own is as short."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.wrappers.adapter import Adapter
from agents.wrappers.entries import Entry, Own, Rays, ToAgent, ToThing
from agents.wrappers.localization import Localization


def _mpe_positions(env: Any) -> np.ndarray:
    return np.stack([agent.state.p_pos for agent in env.unwrapped.world.agents])


def _simple_spread(env: Any, i: int) -> Sequence[Entry]:
    """[own velocity, own position, each landmark − own, each other − own, what others say]."""
    world = env.unwrapped.world
    entries: list[Entry] = [Own(slice(0, 2), "velocity"), Own(slice(2, 4))]
    start = 4
    for _ in world.landmarks:
        entries.append(ToThing(slice(start, start + 2)))
        start += 2
    for other in range(len(world.agents)):
        if other != i:
            entries.append(ToAgent(slice(start, start + 2), other))
            start += 2
    return entries


simple_spread = Adapter(_mpe_positions, _simple_spread, low=(-1.5, -1.5), high=(1.5, 1.5))
"""``mpe2.simple_spread_v3.parallel_env()`` in which everybody observes everything."""


def _vmas_positions(scenario: Any) -> Tensor:
    return torch.stack([agent.state.pos for agent in scenario.world.policy_agents], 1)


def _others(scenario: Any, team: Localization, i: int) -> tuple[Tensor, Tensor]:
    """The other agents, as heard."""
    agents = scenario.world.policy_agents
    others = [j for j in range(len(agents)) if j != i]
    radii = torch.tensor([agents[j].shape.radius for j in others])
    return team.heard[:, i, others], radii


def _obstacles(scenario: Any, team: Localization, i: int) -> tuple[Tensor, Tensor]:
    """Things that stand where everybody knows them to."""
    things = scenario.obstacles
    centres = torch.stack([thing.state.pos for thing in things], 1).cpu()
    return centres, torch.tensor([thing.shape.radius for thing in things])


def _rays(agent: Any, start: int, **settings: Any) -> Rays:
    """The agent's lidar, whose readings begin at ``start``."""
    lidar = agent.sensors[0]
    angles = lidar._angles[0].cpu()
    return Rays(slice(start, start + len(angles)), angles, lidar._max_range, **settings)


def _navigation(scenario: Any, i: int) -> Sequence[Entry]:
    """[own position, own velocity, own − goal (or − every goal), closeness of others by lidar]."""
    agents = scenario.world.policy_agents
    goals = len(agents) if scenario.observe_all_goals else 1
    entries: list[Entry] = [Own(slice(0, 2)), Own(slice(2, 4), "velocity")]
    entries += [ToThing(slice(4 + 2 * g, 6 + 2 * g), away=True) for g in range(goals)]
    if scenario.collisions:
        entries.append(_rays(agents[i], 4 + 2 * goals, things=_others, closeness=True))
    return entries


navigation = Adapter(_vmas_positions, _navigation, low=(-1.2, -1.2), high=(1.2, 1.2))
"""VMAS's ``navigation``: goals stand where agents know them to; lidars show others as heard."""


def _flocking(scenario: Any, i: int) -> Sequence[Entry]:
    """[own position, own velocity, own − target, distances to obstacles by lidar]."""
    entries: list[Entry] = [Own(slice(0, 2)), Own(slice(2, 4), "velocity")]
    entries.append(ToThing(slice(4, 6), away=True))
    if scenario.obstacles:
        entries.append(_rays(scenario.world.policy_agents[i], 6, things=_obstacles))
    return entries


flocking = Adapter(_vmas_positions, _flocking, low=(-1.5, -1.5), high=(1.5, 1.5))
"""VMAS's ``flocking``: the target and the obstacles are where agents know them to be."""
