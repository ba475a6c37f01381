"""coloc: cooperative localization of UAV swarms as PettingZoo and TorchRL environments.

Importing it registers every scenario with PettingZoo: ``pettingzoo.make("parallel",
"coloc/indoor-v0")``, and ``"aec"`` likewise.
"""

import importlib
from typing import TYPE_CHECKING, Any

import pettingzoo

from coloc_env.scenarios import SCENARIOS, make_scenario

if TYPE_CHECKING:
    from coloc_env.envs.gymnasium import SingleUavEnv
    from coloc_env.envs.pettingzoo import env, parallel_env
    from coloc_env.envs.sb3 import CoLocVecEnv
    from coloc_env.envs.torchrl import CoLocEnv, PerUavEnv
    from coloc_env.scenario import Scenario
    from coloc_env.world import World

__all__ = [
    "SCENARIOS",
    "CoLocEnv",
    "CoLocVecEnv",
    "PerUavEnv",
    "Scenario",
    "SingleUavEnv",
    "World",
    "env",
    "make_scenario",
    "parallel_env",
]

_HOMES = {  # loaded when asked for: TorchRL takes a second that PettingZoo's users need not wait
    "CoLocEnv": "coloc_env.envs.torchrl",
    "CoLocVecEnv": "coloc_env.envs.sb3",
    "PerUavEnv": "coloc_env.envs.torchrl",
    "Scenario": "coloc_env.scenario",
    "SingleUavEnv": "coloc_env.envs.gymnasium",
    "World": "coloc_env.world",
    "env": "coloc_env.envs.pettingzoo",
    "parallel_env": "coloc_env.envs.pettingzoo",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def _register() -> None:
    for scenario in SCENARIOS.names():  # what two packages bring is said when it is asked for
        for face, maker in (("parallel", "parallel_env"), ("aec", "env")):
            pettingzoo.register(
                face,
                f"coloc/{scenario}",
                entry_point=f"coloc_env.envs.pettingzoo:{maker}",
                kwargs={"scenario": scenario},
            )


if hasattr(pettingzoo, "register"):  # since 1.27
    _register()
