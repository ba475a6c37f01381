"""How well a scenario's UAVs can be localized at all: Cramér–Rao bounds, posterior and of a
snapshot."""

from coloc_env.bounds import senses  # registers what it knows
from coloc_env.bounds.mixture import range_information
from coloc_env.bounds.posterior import Bound, posterior_bound
from coloc_env.bounds.snapshot import SnapshotBound, snapshot_bound

__all__ = [
    "Bound",
    "SnapshotBound",
    "posterior_bound",
    "range_information",
    "senses",
    "snapshot_bound",
]
