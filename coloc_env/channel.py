"""One radio channel that the team shares: exchanges that UAVs choose, and how they collide."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from coloc_env.sensors.base import squared_norm


@dataclass(frozen=True)
class Channel:
    """The ``calls`` of a step (see ``Commands``) among UAVs at ``position`` (m).

    ``interference``: how far away (m) another initiator spoils an exchange at its target.
    """

    calls: Int64[Tensor, "R N"]
    position: Float64[Tensor, "R N d"]
    interference: float

    def chosen(self) -> Bool[Tensor, "R N N"]:
        """Between which UAVs an exchange succeeds, both ways, if they reach each other."""
        n = self.calls.shape[1]
        target = torch.arange(n, device=self.calls.device)
        initiates = self.calls >= 0
        called = self._succeeds(target, self.position) & ~initiates.unsqueeze(1)  # [R, i, t]
        return called | called.transpose(1, 2)

    def to_anchors(self, anchors: Float64[Tensor, "R A d"]) -> Bool[Tensor, "R N A"]:
        """Which UAVs' exchanges with anchors succeed, if they reach them."""
        n = self.calls.shape[1]
        target = torch.arange(n, n + anchors.shape[1], device=self.calls.device)
        return self._succeeds(target, anchors)

    def _succeeds(
        self, target: Int64[Tensor, "T"], place: Float64[Tensor, "R T d"]
    ) -> Bool[Tensor, "R N T"]:
        """Exchanges i → t that are the only call of t, no other initiator being near t."""
        calls = self.calls.unsqueeze(-1) == target
        near = squared_norm(self.position.unsqueeze(2) - place.unsqueeze(1))
        near = (near <= self.interference**2) & (self.calls >= 0).unsqueeze(-1)
        others = (near | calls).sum(1, keepdim=True) - (near | calls).to(torch.int64)
        return calls & (others == 0)

    def broadcast(self, reach: Bool[Tensor, "R N N"]) -> Bool[Tensor, "R N N"]:
        """Whom a UAV hears: it listens, and exactly one UAV in its reach speaks."""
        speaks = self.calls >= 0
        heard = reach & speaks.unsqueeze(1)
        return heard & (heard.sum(-1, keepdim=True) == 1) & ~speaks.unsqueeze(2)
