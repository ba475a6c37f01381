"""Temporal consistency: a measurement now against the same one in the last two frames."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.measurements import Block, Measurement, Neighbours
from agents.models.process import Process
from agents.robust.mahalanobis import chi_square
from agents.robust.screen import Prediction
from coloc_env.observation import Observation

_FRAMES = 2
_PROBABILITY = 0.99  # that two good measurements of the same thing agree


class TemporalConsistency:
    """Innovations against the residuals that the last frames left at their posteriors.

    Gross errors are drawn afresh at every step and seldom agree with themselves. The memory holds,
    for each frame, the residuals and variances (0 where nothing was measured) of all blocks, and,
    where slots change hands, whose they were.
    """

    def __init__(self, process: Process, models: Sequence[Measurement]) -> None:
        self.process, self.models = process, models

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        """Frames in which nothing was measured."""
        x, _ = self.process.initial(observation["prior"].double())
        nowhere = x.new_zeros(*observation["links"].shape, self.process.dim)
        nobody = Neighbours(nowhere, nowhere, nowhere[..., 0] > 0)
        blocks = [
            model.linearize(self.process, x, observation, nobody, derivatives=False)
            for model in self.models
        ]
        return torch.cat([torch.zeros_like(_frame(blocks, observation))] * _FRAMES, -1)

    def judge(
        self, blocks: Sequence[Block], prediction: Prediction, memory: Float[Tensor, "B N K"]
    ) -> list[Float[Tensor, "B N m"]]:
        """1 for measurements that agree with one of the frames that they were in, or were in none:
        r_t − r_s has the variance of both and of what the error has changed by in between."""
        moved = self._moved(prediction)
        frames = memory.unflatten(-1, (_FRAMES, -1)).unbind(-2)
        size = sum(2 * block.residual[0, 0].numel() for block in blocks)
        agreed = [torch.zeros_like(block.mask) for block in blocks]
        known = [torch.zeros_like(block.mask) for block in blocks]
        for lag, frame in enumerate(frames, 1):
            start = 0
            for i, block in enumerate(blocks):
                m, k = block.residual.shape[-2:]
                part = frame[..., start : start + 2 * m * k].unflatten(-1, (2, m, k))
                start += 2 * m * k
                residual, variance = part.unbind(-3)
                seen = (variance[..., 0] > 0) & _still(block, frame[..., size:], prediction)
                h = block.jacobian
                drift = lag**2 * ((h @ moved.unsqueeze(-3)) * h).sum(-1)  # F² − I ≈ 2 (F − I)
                spread = block.total_variance + variance + drift
                distance = ((block.residual - residual) ** 2 / spread).sum(-1)
                known[i] = known[i] | seen
                agreed[i] = agreed[i] | (seen & (distance <= chi_square(_PROBABILITY, k)))
        return [
            (a | ~s).to(block.residual.dtype)
            for a, s, block in zip(agreed, known, blocks, strict=True)
        ]

    def remember(
        self, blocks: Sequence[Block], prediction: Prediction, memory: Float[Tensor, "B N K"]
    ) -> Float[Tensor, "B N K"]:
        """The memory with this frame, its ``blocks`` at the posterior, in place of the oldest."""
        frame = _frame(blocks, prediction.observation)
        return torch.cat((frame, memory[..., : -frame.shape[-1]]), -1)

    def _moved(self, prediction: Prediction) -> Float[Tensor, "B N E E"]:
        """Covariance of what one step changes the error by: (F − I) P (F − I)ᵀ + Q."""
        x = prediction.state
        dt = torch.full_like(x[..., 0], self.process.dt)
        f, q = self.process.linearize(x, self.process.inputs(prediction.observation).to(x), dt)
        change = f - torch.eye(f.shape[-1], dtype=f.dtype, device=f.device)
        return change @ prediction.covariance @ change.mT + q


def _frame(blocks: Sequence[Block], observation: Observation) -> Float[Tensor, "B N F"]:
    """What the memory keeps of a step."""
    parts = []
    for block in blocks:
        for value in (block.residual, block.total_variance):
            parts.append(torch.where(block.mask.unsqueeze(-1), value, 0.0).flatten(-2))
    if "neighbours" in observation and any(block.partner is not None for block in blocks):
        parts.append(observation["neighbours"].to(parts[0]))
    return torch.cat(parts, -1)


def _still(
    block: Block, whose: Float[Tensor, "B N S"], prediction: Prediction
) -> Bool[Tensor, "B N m"]:
    """Whether a measurement involves the same UAV as in the frame where slots were ``whose``."""
    if block.partner is None or "neighbours" not in prediction.observation:
        return torch.ones_like(block.mask)
    same = whose == prediction.observation["neighbours"]
    by_slot = block.mask.unflatten(-1, (-1, same.shape[-1], block.per_slot))
    return same[..., None, :, None].expand_as(by_slot).flatten(-3)
