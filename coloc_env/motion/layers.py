"""Heights of a team's UAVs, one layer each."""

from jaxtyping import Float64, Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Motion
from coloc_env.motion.draws import GOLDEN, phases, uniform
from coloc_env.motion.fit import altitude
from coloc_env.motion.timing import cycles


def layers(
    motion: Motion,
    keys: Int64[Tensor, "R"],
    height: tuple[float, float],
    swing: float,
    arena: Arena,
) -> Float64[Tensor, "R N"]:
    """Heights (m) between two limits, in the order of the golden ratio's multiples from a start
    drawn per world: UAVs next to each other are never in one layer."""
    for limit in height:
        altitude(motion, arena, limit, swing)
    turns = GOLDEN * arena.n_uavs * phases(keys, arena.n_uavs, arena.n_uavs)
    share = cycles(turns + uniform(keys, "motion.layers", 1))[1]
    return height[0] + (height[1] - height[0]) * share
