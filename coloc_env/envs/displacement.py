"""Actions as displacements of a UAV's last estimate: for learners that start from nothing."""

import torch
from jaxtyping import Float32, Int64
from tensordict import TensorClass
from torch import Tensor

from coloc_env.envs.action_mode import ActionMode, Leaves
from coloc_env.envs.fixes import fix_leaves, next_attitude, relative_fixes
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors.base import Leaf

STEP = 1.0  # m: how far an action of 1 moves the estimate
_LOG_STD = 0.0  # of the standard deviation of 1 m that such estimates are given


class DisplacementMemory(TensorClass):
    """The last estimate (m), the attitude by dead reckoning, the last action, and steps taken."""

    position: Float32[Tensor, "B N d"]
    attitude: Float32[Tensor, "B N a"]
    last_action: Float32[Tensor, "B N d"]
    step: Int64[Tensor, "B N"]


class Displacement(ActionMode):
    """[−1, 1]^d moves the last estimate by up to ±1 m an axis; the first starts at the prior.

    Values beyond are cut. The estimate's velocity is 0 and its standard deviation 1 m. Leaves:
    ``attitude`` (the prior's, carried on by gyroscope or odometry), ``landmark_fixes`` relative to
    the last estimate with their mask, their mean ``fix_mean`` and the share seen ``fix_share``, and
    ``last_action``.
    """

    name = "displacement"
    meaning = "displacement in m within [-1, 1]"

    def __init__(self, believed: Believed) -> None:
        super().__init__(believed)
        self._fixes = fix_leaves(self.believed)
        seen = ("fix_mean", "fix_share") if self._fixes else ()
        self.features = (*seen, "last_action")

    @property
    def leaves(self) -> dict[str, Leaf]:
        attitude = (
            Leaf(4, unit="quaternion", frame="world")
            if self.dim == 3
            else Leaf(1, unit="rad", frame="world")
        )
        return {"attitude": attitude, **self._fixes, "last_action": Leaf(self.dim, -1.0, 1.0)}

    def reset(self, observation: Observation) -> DisplacementMemory:
        prior, d = observation["prior"], self.dim
        return DisplacementMemory(
            position=prior[..., :d].clone(),
            attitude=prior[..., 2 * d : -2 - d].clone(),
            last_action=torch.zeros_like(prior[..., :d]),
            step=torch.zeros(prior.shape[:2], dtype=torch.int64, device=prior.device),
            batch_size=prior.shape[:2],
        )

    def observe(
        self, memory: DisplacementMemory, observation: Observation
    ) -> tuple[DisplacementMemory, Leaves]:
        attitude = next_attitude(self.believed, observation, memory.attitude)
        attitude = torch.where((memory.step > 0).unsqueeze(-1), attitude, memory.attitude)
        leaves: Leaves = {"attitude": attitude}
        if self._fixes:
            relative, _, _ = relative_fixes(self.believed, observation, attitude, memory.position)
            leaves |= relative
        leaves["last_action"] = memory.last_action
        return memory.replace(attitude=attitude), leaves

    def estimate(
        self, memory: DisplacementMemory, action: Float32[Tensor, "B N d"]
    ) -> tuple[DisplacementMemory, Float32[Tensor, "B N A"]]:
        action = action.clamp(-1.0, 1.0)
        position = memory.position + STEP * action
        rest = torch.zeros_like(position)
        after = memory.replace(position=position, last_action=action, step=memory.step + 1)
        return after, torch.cat((position, rest, rest + _LOG_STD), -1)

    def reference(self, memory: DisplacementMemory) -> Float32[Tensor, "B N d"]:
        return memory.position
