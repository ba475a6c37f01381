"""What each UAV of a swarm knows by itself, and what it learns from being placed by the swarm.

Where a motion model has more than a position to be wrong about (velocity, attitude, biases), the
full error covariance is carried along: a position that the team finds then corrects the rest
through what their errors have in common, without which strapdown integration diverges.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.measurements import Measurement, nobody
from agents.models.measurements.vectors import Heights, Slowness
from agents.models.process import Process
from agents.models.update import information, posterior
from agents.robust import Trust
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import Height, SlowFlight

_NOTHING = 1e-12  # m²: keeps the covariance of a position that is known exactly invertible


class Reckoning:
    """Motion model, height and slowness: a Kalman filter for each UAV."""

    def __init__(self, believed: Believed, process: Process) -> None:
        self.process = process
        height, slow = believed.sensor(Height), believed.sensor(SlowFlight)
        self.models: list[Measurement] = [Heights(height)] if height else []
        self.models += [Slowness(slow)] if slow else []

    def predicted(
        self,
        state: Float64[Tensor, "B N S"],
        covariance: Float64[Tensor, "B N E E"],
        dt: Float64[Tensor, "B N"],
        observation: Observation,
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """State and covariance after ``dt`` seconds and the UAV's own measurements."""
        u = self.process.inputs(observation)
        f, q = self.process.linearize(state, u, dt)
        state, covariance = self.process.propagate(state, u, dt), f @ covariance @ f.mT + q
        if not self.models:
            return state, covariance
        around = nobody(state[..., : self.process.dim])
        blocks = [m.linearize(self.process, state, observation, around) for m in self.models]
        precision, vector = information(blocks, [Trust()] * len(blocks))
        delta, covariance = posterior(covariance, precision, vector)
        return self.process.boxplus(state, delta), covariance

    def placed(
        self,
        state: Float64[Tensor, "B N S"],
        covariance: Float64[Tensor, "B N E E"],
        position: Float64[Tensor, "B N d"],
        block: Float64[Tensor, "B N d d"],
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """The same with another position and covariance ``block`` of it (m²), whatever they are
        due to: what the position tells of the rest stays (Jeffrey's rule for Gaussians).

        x ← x ⊞ G (p − x_p), P ← P + G (V − P_pp) Gᵀ with G = P_·p P_pp⁻¹.
        """
        d = self.process.dim
        own = covariance[..., :d, :d]
        gain = torch.linalg.solve(_regular(own), covariance[..., :d, :]).mT
        delta = (gain @ (position - state[..., :d]).unsqueeze(-1))[..., 0]
        after = covariance + gain @ (block - own) @ gain.mT
        return self.process.boxplus(state, delta), 0.5 * (after + after.mT)

    def fused(
        self,
        state: Float64[Tensor, "B N S"],
        covariance: Float64[Tensor, "B N E E"],
        position: Float64[Tensor, "B N d"],
        block: Float64[Tensor, "B N d d"],
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """The same after a measurement of the position that dead reckoning had no part in, with
        covariance ``block`` (m²). Who was not placed anew learns nothing."""
        d = self.process.dim
        off = position - state[..., :d]
        gain = torch.linalg.solve(_regular(covariance[..., :d, :d] + block), covariance[..., :d, :])
        gain = gain.mT * (off != 0).any(-1)[..., None, None]
        delta = (gain @ off.unsqueeze(-1))[..., 0]
        after = covariance - gain @ covariance[..., :d, :]
        return self.process.boxplus(state, delta), 0.5 * (after + after.mT)


def informed(
    block: Float64[Tensor, "B N d d"],
    position: Float64[Tensor, "B M d"],
    weight: Float64[Tensor, "B M M"],
    variance: Float64[Tensor, "B M"],
) -> Float64[Tensor, "B N d d"]:
    """Own covariances (m²) of the first N after ranges with these weights (1/m²), to others who
    are known as well as their ``variance`` (m² per axis) says: each tells of its own direction."""
    n = block.shape[1]
    apart = position[:, :n].unsqueeze(2) - position.unsqueeze(1)
    unit = apart / torch.linalg.vector_norm(apart, dim=-1, keepdim=True).clamp_min(1e-9)
    counted = weight[:, :n] / (1 + weight[:, :n] * variance.unsqueeze(1))
    told = (counted.unsqueeze(-1) * unit).mT @ unit
    _, after = posterior(block, told, torch.zeros_like(block[..., 0]))
    return after


def matched(
    joint: Float64[Tensor, "B N e N*e"],
    before: Float64[Tensor, "B N e e"],
    after: Float64[Tensor, "B N e e"],
) -> Float64[Tensor, "B N e N*e"]:
    """A joint covariance with own blocks ``after`` in place of ``before``.

    In the coordinates that make ``before`` the identity and ``after`` diag(m): where m ≥ 1, noise
    of a UAV's own was added; where m < 1, it measured something, and what it has in common with
    others goes down by m (as I − K H does). J ← S J Sᵀ + A, S = diag(min(1, m)), A = diag(m) − S².
    """
    e = joint.shape[2]
    root = torch.linalg.cholesky_ex(_regular(before)).L
    half = torch.linalg.solve_triangular(root, after, upper=False)
    ratio = torch.linalg.solve_triangular(root, half.mT, upper=False)
    sound = ratio.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
    m, turn = torch.linalg.eigh(torch.where(sound, 0.5 * (ratio + ratio.mT), _eye(ratio)))
    m, axes = m.clamp_min(0).unsqueeze(-2), root @ turn
    less = m.clamp_max(1.0)
    scale = torch.linalg.solve_triangular(root, axes * less @ turn.mT, upper=False, left=False)
    blocks = joint.unflatten(-1, (-1, e)).transpose(2, 3)  # [B, i, j, e, e]
    blocks = scale.unsqueeze(2) @ blocks @ scale.mT.unsqueeze(1)
    blocks.diagonal(dim1=1, dim2=2).add_(((axes * (m - less**2)) @ axes.mT).movedim(1, -1))
    return blocks.transpose(2, 3).flatten(-2)


def apart(blocks: Float64[Tensor, "B N e e"]) -> Float64[Tensor, "B N e N*e"]:
    """The joint covariance of UAVs with nothing in common, from each one's own."""
    return torch.diag_embed(blocks.movedim(1, -1)).permute(0, 3, 1, 4, 2).flatten(-2)


def _regular(block: Float64[Tensor, "B N e e"]) -> Float64[Tensor, "B N e e"]:
    return block + _NOTHING * _eye(block)


def _eye(like: Float64[Tensor, "B N e e"]) -> Float64[Tensor, "e e"]:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
