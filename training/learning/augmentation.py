"""What is done to a swarm's observations in training (ST-DCL paper, section 4.2.5)."""

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

EDGE_DROPOUT = 0.15
POSITION_STD, VELOCITY_STD = 0.1, 0.2  # m, m/s
_IMPULSES = 0.02  # share of ranges
_LARGEST = 10.0  # standard deviations of a range: an impulse
_SEEN = ("uav", "observation")


class SwarmAugmentation(Transform):
    """Links dropped at random, noise on fixes and velocities, mixed noise on ranges.

    Each link is dropped with probability 0.15 in each step, from both ends. Ranges of ``std`` m get
    Gaussian, uniform and impulse noise besides, or some of them, as drawn for each world of each
    step; both ends of a link get the same. All is drawn from ``seed``.
    """

    def __init__(self, std: float, seed: int, device: str = "cpu") -> None:
        super().__init__(in_keys=[_SEEN], out_keys=[_SEEN])
        self.std, self.where = std, device
        self.generator = torch.Generator().manual_seed(seed)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        seen = next_tensordict.get(_SEEN)
        ranges, mask = seen["ranges"], seen["range_mask"]
        n = ranges.shape[-2]
        kept = self._of_pairs(self._uniform(*ranges.shape[:-2], n, n) >= EDGE_DROPOUT, seen)
        mask = mask * kept
        noise = self._of_pairs(self._noise(*ranges.shape[:-2], n), seen)
        seen = seen.clone(recurse=False)
        seen["range_mask"], seen["ranges"] = mask, (ranges + noise).clamp_min(0.0) * mask
        for name, std in (("position_fix", POSITION_STD), ("ins", VELOCITY_STD)):
            if name in seen:
                there = seen["position_fix_mask"] if name == "position_fix" else 1.0
                seen[name] = seen[name] + std * self._normal(*seen[name].shape) * there
        return next_tensordict.set(_SEEN, seen)

    def _noise(self, *shape: int) -> Tensor:
        """Noise of all pairs (m), [*, N, N]."""
        *worlds, n = shape
        mixed = (3, *worlds, 1, 1)
        chosen = self._uniform(*mixed) < 0.5
        gaussian, uniform, impulse = 0.5 * self.std * self._uniform(*mixed) * chosen
        pairs = (*worlds, n, n)
        hit = (self._uniform(*pairs) < _IMPULSES) * (2 * self._uniform(*pairs) - 1)
        return (
            gaussian * self._normal(*pairs)
            + 2 * uniform * (2 * self._uniform(*pairs) - 1)
            + 2 * _LARGEST * impulse * hit
        )

    def _of_pairs(self, drawn: Tensor, seen: TensorDictBase) -> Tensor:
        """What was drawn for pairs, alike at both ends, by the slots of an observation."""
        upper = torch.triu(drawn, 1)
        pairs = upper | upper.mT if drawn.dtype == torch.bool else upper + upper.mT
        if "neighbours" in seen.keys():  # noqa: SIM118
            return pairs.gather(-1, seen["neighbours"].to(torch.int64))
        return pairs

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator).to(self.where)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator).to(self.where)
