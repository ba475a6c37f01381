"""Localizers and policies: what estimates and decides, by name.

``agents.make("ekf:robust=huber", scenario)`` builds one; ``agents.LOCALIZERS`` lists them, those of
installed packages included (entry points ``coloc.localizers``).
"""

import importlib
from typing import TYPE_CHECKING, Any

from agents.registry import LOCALIZERS, make

if TYPE_CHECKING:
    from agents.localizer import Estimate, Localizer

__all__ = ["LOCALIZERS", "Estimate", "Localizer", "make"]

_HOMES = {"Estimate": "agents.localizer", "Localizer": "agents.localizer"}  # they need torch


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
