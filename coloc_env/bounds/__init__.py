"""How well a scenario's UAVs can be localized at all: the posterior Cramér–Rao bound."""

from coloc_env.bounds.mixture import range_information
from coloc_env.bounds.posterior import Bound, posterior_bound

__all__ = ["Bound", "posterior_bound", "range_information"]
