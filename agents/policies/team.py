"""Teams in which UAVs localize by different methods."""

from collections.abc import Mapping

import numpy as np

from agents.policies.adapters import ParallelPolicy, check_part
from agents.registry import make
from coloc_env.scenario import Scenario


class Team:
    """A policy for the PettingZoo face in which each UAV has a localizer of its own:
    ``Team(env.scenario, {"uav_0": "mappo", "uav_1": "ekf", "uav_2": "pfnn"})``.

    Values are agents with their options, as on the command line. UAVs of one method share a
    localizer; each further one costs a step of its own. Call ``reset()`` before every episode, then
    ``actions = team(observations)``. Raises ValueError for an unknown UAV, and for a method that
    has to act for the whole team.
    """

    def __init__(self, scenario: Scenario, methods: Mapping[str, str]) -> None:
        known = scenario.agents
        for uav in methods:
            if uav not in known:
                raise ValueError(f"there is no {uav!r} in the team: {', '.join(known)}")
        self.policies = [
            ParallelPolicy(make(method, scenario), [u for u in methods if methods[u] == method])
            for method in dict.fromkeys(methods.values())
        ]
        for policy in self.policies:
            check_part(policy.localizer, len(policy.agents or known))

    def reset(self) -> None:
        """Forget the episode."""
        for policy in self.policies:
            policy.reset()

    def __call__(
        self, observations: Mapping[str, Mapping[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Actions of the observed UAVs that belong to the team."""
        return {
            agent: action
            for policy in self.policies
            for agent, action in policy(observations).items()
        }
