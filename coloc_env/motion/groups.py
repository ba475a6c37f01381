"""A team whose UAVs move in different ways."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Int64
from torch import Tensor

from coloc_env import noise
from coloc_env.motion.base import Arena, Carry, Kinematics, Motion


@dataclass(frozen=True)
class Groups(Motion):
    """The first so many UAVs move by one motion, the next by another: ``((motion, count), …)``.

    Commands go to the groups that are steered; the rest of them are ignored.
    """

    groups: tuple[tuple[Motion, int], ...]

    @property
    def steered(self) -> bool:  # type: ignore[override]
        return any(motion.steered for motion, _ in self.groups)

    @property
    def largest(self) -> float:
        return max(motion.largest for motion, _ in self.groups)

    def start(self, keys: Int64[Tensor, "R"], arena: Arena) -> Carry:
        counts = [count for _, count in self.groups]
        if sum(counts) != arena.n_uavs:
            raise ValueError(f"Groups: {counts} UAVs are not the team's {arena.n_uavs}")
        carry: Carry = {}
        for i, (motion, count) in enumerate(self.groups):
            own = motion.start(noise.fold(keys, i), replace(arena, n_uavs=count))
            carry |= {f"{i}.{name}": value for name, value in own.items()}
        if self.steered:
            shape = (len(keys), arena.n_uavs, arena.dim)
            carry["command"] = torch.zeros(shape, dtype=torch.float64, device=keys.device)
        return carry

    def advance(
        self, carry: Carry, steps: Int64[Tensor, "R K"], arena: Arena
    ) -> tuple[Kinematics, Carry]:
        parts, after, first = [], dict(carry), 0
        for i, (motion, count) in enumerate(self.groups):
            prefix = f"{i}."
            own = {k.removeprefix(prefix): v for k, v in carry.items() if k.startswith(prefix)}
            if motion.steered:
                own["command"] = carry["command"][:, first : first + count]
            part, own = motion.advance(own, steps, replace(arena, n_uavs=count))
            parts.append(part)
            after |= {prefix + name: value for name, value in own.items()}
            first += count
        names = ("position", "velocity", "attitude")
        return Kinematics(*(torch.cat([getattr(p, n) for p in parts], 2) for n in names)), after
