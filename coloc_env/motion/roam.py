"""From one random waypoint to the next at constant speed."""

from dataclasses import dataclass

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.draws import fold_each, points, uav_keys
from coloc_env.motion.fit import inside, positive
from coloc_env.motion.frames import unit, yaw_attitude


@dataclass(frozen=True)
class Roam(Motion):
    """Each UAV moves straight to its goal at ``speed`` m/s; the step after it is there, another
    goal is drawn, uniform in ``box`` (m; None: the arena), where it also starts."""

    speed: float = 2.0
    box: Box | None = None

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        positive(self, "speed")
        low, high = self.box or (arena.low, arena.high)
        inside(self, "box", ((low, high),), arena)
        own = uav_keys(keys, arena.n_uavs)
        position = points(own, "motion.roam.start", low, high)
        goal = points(own, "motion.roam.first", low, high)
        return {"keys": own, "position": position, "goal": goal}

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        low, high = self.box or (arena.low, arena.high)
        drawn = points(fold_each(carry["keys"], steps.unsqueeze(-1)), "motion.roam", low, high)
        position, goal, reach = carry["position"], carry["goal"], self.speed * arena.dt
        path = []
        for k, step in enumerate(steps.unbind(1)):
            goal = torch.where((position == goal).all(-1, keepdim=True), drawn[:, k], goal)
            apart = goal - position
            squared = apart[..., 0] * apart[..., 0]
            for part in apart.unbind(-1)[1:]:
                squared = squared + part * part
            left = squared.sqrt().unsqueeze(-1)
            leap = apart * (reach / left.clamp_min(1e-300))
            there = left <= reach
            moved = torch.where(there, goal, position + leap)
            position = torch.where((step > 0)[:, None, None], moved, position)
            path.append((position, torch.where(there, apart, leap) / arena.dt))
        places, velocity = (torch.stack(each, 1) for each in zip(*path, strict=True))
        attitude = yaw_attitude(*unit(velocity[..., 0], velocity[..., 1]), arena.dim)
        after = {"keys": carry["keys"], "position": position, "goal": goal}
        return Kinematics(places, velocity, attitude), after
