"""How well each measurement is predicted by all others and the past: a loss without truth.

The update that left measurement i out follows in closed form from the one that used all: with
G = H P⁺ Hᵀ and W = w R⁻¹ of i, its position and covariance predict i with

A = H P₋ᵢ Hᵀ = (I − G W)⁻¹ G and r₋ᵢ = r + A W r,

as the downdate of an information filter has them (P₋ᵢ⁻¹ = P⁺⁻¹ − Hᵀ W H).
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models.measurements import Block
from agents.robust import Prediction, Screen, Trust
from coloc_env.observation import Observation

DEGREES = 4.0  # of Student's t, as a bank scores its branches


class Watched(Screen):
    """Another screen; ``trusts`` are those of the last update's outcome, and ``blocks`` what was
    measured, linearized there."""

    def __init__(self, screen: Screen) -> None:
        super().__init__(screen.process, screen.models)
        self.screen = screen
        self.exchanges, self.extra = screen.exchanges, screen.extra
        self.trusts: list[Trust] = []
        self.blocks: Sequence[Block] = ()

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        return self.screen.memory(observation)

    def judge(self, blocks: Sequence[Block], prediction: Prediction) -> Any:
        return self.screen.judge(blocks, prediction)

    def weigh(self, blocks: Sequence[Block], evidence: Any, last: bool) -> list[Trust]:
        self.trusts = self.screen.weigh(blocks, evidence, last)
        return self.trusts

    def remember(
        self, prediction: Prediction, evidence: Any, after: Callable[[], Sequence[Block]]
    ) -> Float[Tensor, "B N K"]:
        self.blocks = after()
        return self.screen.remember(prediction, evidence, lambda: self.blocks)

    def surprise(
        self, covariance: Float[Tensor, "B N E E"]
    ) -> tuple[Float[Tensor, "B N"], Float[Tensor, "B N"]]:
        """Negative log-likelihood of all that was measured in the last update, each left out of it,
        whose outcome has this covariance; and how many count. A number that two UAVs hold counts
        half for each; a belief that enters like a measurement does not."""
        total = count = covariance.new_zeros(covariance.shape[:-2])
        for model, block, trust in zip(self.models, self.blocks, self.trusts, strict=True):
            if model.testable:
                each = left_out(block, trust, covariance)
                share = (0.5 if block.mutual else 1.0) * block.mask
                total, count = total + (share * each).sum(-1), count + share.sum(-1)
        return total, count


def left_out(
    block: Block, trust: Trust, covariance: Float[Tensor, "B N E E"]
) -> Float[Tensor, "B N m"]:
    """½ log|S| + ½ (ν + k) log(1 + d²/ν) of each measurement, from an estimate without it; 0 where
    nothing was measured. ``block`` is linearized at the estimate with it, whose covariance P⁺ is
    given."""
    h, there = block.jacobian, block.mask.unsqueeze(-1)
    g = h @ covariance.unsqueeze(-3) @ h.mT
    w = trust.information(block).unsqueeze(-2)  # W of columns
    eye = torch.eye(h.shape[-2], dtype=h.dtype, device=h.device)
    a = torch.linalg.solve(eye - g * w, g)  # A = (I − G W)⁻¹ G
    used = trust.residual(block).masked_fill(~there, 0.0)
    r = block.residual.masked_fill(~there, 0.0) + ((a * w) @ used.unsqueeze(-1))[..., 0]
    s = a + torch.diag_embed(block.total_variance)  # S = H P₋ᵢ Hᵀ + R
    s = torch.where(there.unsqueeze(-1), 0.5 * (s + s.mT), eye)
    root = torch.linalg.cholesky(s)
    scaled = torch.linalg.solve_triangular(root, r.unsqueeze(-1), upper=False)[..., 0]
    squared = scaled.square().sum(-1)
    logarithm = 2 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    degrees = DEGREES + h.shape[-2]
    each = 0.5 * (logarithm + degrees * (squared / DEGREES).log1p())
    return torch.where(block.mask, each, 0.0)
