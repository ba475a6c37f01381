"""The joint Gaussian of some UAVs and a map, and its update by what they measure."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.measurements import Block
from agents.models.process import Process
from agents.robust import SoftName, soft_trust


@dataclass(frozen=True)
class Joint:
    """G groups of n UAVs, each with a map of its own of L landmarks: states, landmarks (m), and the
    covariance of all errors, the n UAVs' first, then the landmarks' (M = n E + L d)."""

    state: Float64[Tensor, "B G n S"]
    landmarks: Float64[Tensor, "B G L d"]
    covariance: Float64[Tensor, "B G M M"]

    @property
    def mapped(self) -> Float64[Tensor, "B G L*d L*d"]:
        """Covariance of the map."""
        size = self.landmarks.shape[-2] * self.landmarks.shape[-1]
        return self.covariance[..., -size:, -size:]

    def moved(self, process: Process, delta: Float64[Tensor, "B G M"]) -> "Joint":
        """The same with errors δ added to its mean."""
        n, size = self.state.shape[2], self.landmarks.shape[-2] * self.landmarks.shape[-1]
        poses = delta[..., :-size].unflatten(-1, (n, -1))
        landmarks = self.landmarks + delta[..., -size:].view_as(self.landmarks)
        return Joint(process.boxplus(self.state, poses), landmarks, self.covariance)

    def predicted(
        self,
        process: Process,
        inputs: Float64[Tensor, "B G n U"],
        dt: Float64[Tensor, "B G n"],
    ) -> "Joint":
        """A step later: P ← F P Fᵀ + Q, in which the map stays as it is."""
        f, q = process.linearize(self.state, inputs, dt)
        n, e = f.shape[2], f.shape[-1]
        p = self.covariance.clone()
        rows = f @ p[..., : n * e, :].unflatten(-2, (n, e))
        p[..., : n * e, :] = rows.flatten(-3, -2)
        columns = p[..., : n * e].unflatten(-1, (n, e)).movedim(-2, 2) @ f.mT
        p[..., : n * e] = columns.movedim(2, -2).flatten(-2)
        for i in range(n):
            own = slice(i * e, (i + 1) * e)
            p[..., own, own] += q[:, :, i]
        return Joint(process.propagate(self.state, inputs, dt), self.landmarks, p)


def information(
    blocks: Sequence[Block], landmarks: Block, shape: tuple[int, int], robust: SoftName
) -> tuple[Float64[Tensor, "B G M M"], Float64[Tensor, "B G M"]]:
    """Λ = Σ Hᵀ R⁻¹ H and η = Σ Hᵀ R⁻¹ r by the errors of groups of ``shape`` (G, n), from blocks of
    all UAVs. The derivative of z = Rᵀ(L − p) by L is minus that by p. What is measured of UAVs in
    slots is about the errors of one's own group where it holds the whole team."""
    count, d = landmarks.residual.shape[-2:]
    e, n = landmarks.jacobian.shape[-1], shape[1]
    size = n * e + count * d
    rows, weights, residuals = [], [], []
    for block in (*blocks, landmarks):
        b, _, m, k = block.residual.shape
        h = block.jacobian.new_zeros(b, *shape, m, k, size)
        grouped = block.jacobian.unflatten(1, shape)
        for i in range(n):
            h[:, :, i, ..., i * e : (i + 1) * e] = grouped[:, :, i]
        if block is landmarks:
            index = torch.arange(count, device=h.device)
            by_landmark = h[..., n * e :].unflatten(-1, (count, d))
            own = -grouped[..., :d].movedim(-3, 0)  # [L, B, G, n, k, d]
            by_landmark[:, :, :, index, :, index] = own
        weight = soft_trust(robust, block).information(block)
        if block.partner is not None and n > 1:
            spread = h.unflatten(3, (-1, n, block.per_slot))
            partner = block.partner.unflatten(1, shape).unflatten(3, (-1, n, block.per_slot))
            for j in range(n):
                spread[:, :, :, :, j, ..., j * e : j * e + d] += partner[:, :, :, :, j]
            weight = 0.5 * weight if block.mutual else weight  # one number that both ends read
        rows.append(h.flatten(2, 4))
        weights.append(weight.unflatten(1, shape).flatten(2))
        residuals.append(block.residual.unflatten(1, shape).flatten(2))
    h, w, r = torch.cat(rows, 2), torch.cat(weights, 2), torch.cat(residuals, 2)
    wh = (h * w.unsqueeze(-1)).mT
    return wh @ h, (wh @ r.unsqueeze(-1))[..., 0]
