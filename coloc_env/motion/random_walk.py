"""Things that drift at random: targets to be tracked."""

from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.draws import fold_each, points, uav_keys
from coloc_env.motion.fit import inside, positive
from coloc_env.motion.frames import unit, yaw_attitude
from coloc_env.motion.obstacles import stopped


@dataclass(frozen=True)
class RandomWalk(Motion):
    """Over each step a position changes by N(0, ``std``² dt I) m², ``std`` in m/√s; the arena's
    edges and ``walls``, solid boxes (m), stop it.

    It starts uniform in ``box`` (m; None: the arena). The velocity is the last step's mean.
    """

    std: float = 1.0
    box: Box | None = None
    walls: tuple[Box, ...] = ()

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "std")
        low, high = self.box or (arena.low, arena.high)
        inside(self, "box", ((low, high),), arena)
        own = uav_keys(keys, arena.n_uavs)
        return {"keys": own, "position": points(own, "motion.walk.start", low, high)}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        keys = fold_each(carry["keys"], steps.unsqueeze(-1))
        leaps = noise.normal(keys, "motion.walk", arena.dim).double() * (self.std * arena.dt**0.5)
        leaps = torch.where((steps > 0)[..., None, None], leaps, 0.0)
        position = carry["position"]
        low, high = (position.new_tensor(x) for x in (arena.low, arena.high))
        path = []
        for leap in leaps.unbind(1):
            before = position
            position = torch.minimum(torch.maximum(before + leap, low), high)
            position = stopped(before, position, self.walls)
            path.append((position, (position - before) / arena.dt))
        places, velocity = (torch.stack(each, 1) for each in zip(*path, strict=True))
        attitude = yaw_attitude(*unit(velocity[..., 0], velocity[..., 1]), arena.dim)
        return Kinematics(places, velocity, attitude), {"keys": carry["keys"], "position": position}
