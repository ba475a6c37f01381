"""One UAV as a Gymnasium environment among UAVs that localizers act for, built from names."""

from collections.abc import Sequence
from typing import Any

from agents.policies.adapters import check_part
from agents.policies.team import Team
from agents.wrappers.correction import Correction, learners_mode
from coloc_env.envs.gymnasium import SingleUavEnv
from coloc_env.scenario import Scenario
from coloc_env.scenarios import scenario_from


def single_uav(
    scenario: str | Scenario = "indoor-v0",
    uav: str = "uav_0",
    others: str = "ekf",
    base: str = "ekf",
    leaves: Sequence[str] | None = None,
    render_mode: str | None = None,
    **overrides: Any,
) -> SingleUavEnv:
    """``uav`` learns; the localizer ``others`` acts for the rest of the team.

    ``base``: the UAV's actions are corrections on this localizer's estimates; ``none``:
    displacements of its own last estimate. Raises ValueError for an unknown UAV or localizer, and
    for a localizer that has to act for the whole team.
    """
    scenario = scenario_from(scenario, overrides)
    rest = {agent: others for agent in scenario.agents if agent != uav}
    team = Team(scenario, rest) if rest else None
    mode = learners_mode(scenario.believed, base)
    if isinstance(mode, Correction):
        check_part(mode.base, 1)
    return SingleUavEnv(scenario, uav, team, mode, leaves, render_mode)
