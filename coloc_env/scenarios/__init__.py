"""Scenario families, one short file each; importing this package registers them all."""

from coloc_env.scenarios import campus as _campus  # noqa: F401
from coloc_env.scenarios import indoor as _indoor  # noqa: F401
from coloc_env.scenarios import replay as _replay  # noqa: F401
from coloc_env.scenarios import replay_anchors as _replay_anchors  # noqa: F401
from coloc_env.scenarios import replay_murp as _replay_murp  # noqa: F401
from coloc_env.scenarios import replay_stein as _replay_stein  # noqa: F401
from coloc_env.scenarios import replay_team as _replay_team  # noqa: F401
from coloc_env.scenarios import stein as _stein  # noqa: F401
from coloc_env.scenarios import swarm as _swarm  # noqa: F401
from coloc_env.scenarios import wsn as _wsn  # noqa: F401
from coloc_env.scenarios.registry import (
    FAMILIES,
    make_scenario,
    overrides_of,
    parse_override,
    register,
    scenario_from,
)

__all__ = [
    "FAMILIES",
    "make_scenario",
    "overrides_of",
    "parse_override",
    "register",
    "scenario_from",
]
