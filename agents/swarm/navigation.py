"""Each UAV's own Kalman filter, and how a position that the team estimates corrects its state.

Where a motion model has more states than the position (velocity, attitude, biases), the full error
covariance is kept: a position that the team estimates then corrects the other states through their
covariance with it, without which strapdown integration diverges.
"""

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.measurements import (
    BodyVelocities,
    Heights,
    PositionFixes,
    RangeDifferences,
    Slowness,
    make_measurements,
    no_neighbours,
)
from agents.models.process import Process
from agents.models.update import information, posterior
from agents.robust import Trust
from agents.swarm.marginals import regular
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import PositionFix

_OWN = (Heights, Slowness, BodyVelocities, RangeDifferences, PositionFixes)


def all_have_fixes(believed: Believed) -> bool:
    """Whether position fixes are measurements that everybody has, and do not make some UAVs
    anchors."""
    fixes = believed.sensor(PositionFix)
    return fixes is not None and fixes.count >= believed.arena.n_uavs


class NavigationFilter:
    """A Kalman filter for each UAV: motion model, height, slow flight, optical flow, time
    differences, and position fixes that everybody has."""

    def __init__(self, believed: Believed, process: Process) -> None:
        self.process = process
        kinds = _OWN if all_have_fixes(believed) else _OWN[:-1]
        own = [model for model in make_measurements(believed) if isinstance(model, kinds)]
        self.models = sorted(own, key=lambda model: _OWN.index(type(model)))

    def predict(
        self,
        state: Float64[Tensor, "B N S"],
        covariance: Float64[Tensor, "B N E E"],
        dt: Float64[Tensor, "B N"],
        observation: Observation,
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """State and covariance after ``dt`` seconds and the UAV's own measurements: P ← F P Fᵀ + Q,
        then an information update."""
        u = self.process.inputs(observation)
        f, q = self.process.linearize(state, u, dt)
        state, covariance = self.process.propagate(state, u, dt), f @ covariance @ f.mT + q
        if not self.models:
            return state, covariance
        around = no_neighbours(state[..., : self.process.dim])
        blocks = [m.linearize(self.process, state, observation, around) for m in self.models]
        precision, vector = information(blocks, [Trust()] * len(blocks))
        delta, covariance = posterior(covariance, precision, vector)
        return self.process.boxplus(state, delta), covariance

    def replace_marginal(
        self,
        state: Float64[Tensor, "B N S"],
        covariance: Float64[Tensor, "B N E E"],
        position: Float64[Tensor, "B N d"],
        marginal: Float64[Tensor, "B N d d"],
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """State and covariance with another ``marginal`` of the position: ``position`` p (m) with
        covariance V (m²). The distribution of the rest given the position stays (Jeffrey's rule
        for Gaussians): x ← x ⊞ K (p − x_p), P ← P + K (V − P_pp) Kᵀ with K = P_·p P_pp⁻¹.
        """
        d = self.process.dim
        p_pp = covariance[..., :d, :d]
        gain = torch.linalg.solve(regular(p_pp), covariance[..., :d, :]).mT
        delta = (gain @ (position - state[..., :d]).unsqueeze(-1))[..., 0]
        after = covariance + gain @ (marginal - p_pp) @ gain.mT
        return self.process.boxplus(state, delta), 0.5 * (after + after.mT)

    def update(
        self,
        state: Float64[Tensor, "B N S"],
        covariance: Float64[Tensor, "B N E E"],
        position: Float64[Tensor, "B N d"],
        noise: Float64[Tensor, "B N d d"],
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """State and covariance after a measurement of the position whose error is independent of
        dead reckoning's, with covariance R (m²): K = P Hᵀ (H P Hᵀ + R)⁻¹, P ← P − K H P. A position
        that equals the predicted one is no measurement."""
        d = self.process.dim
        innovation = position - state[..., :d]
        s = covariance[..., :d, :d] + noise
        gain = torch.linalg.solve(regular(s), covariance[..., :d, :])
        gain = gain.mT * (innovation != 0).any(-1)[..., None, None]
        delta = (gain @ innovation.unsqueeze(-1))[..., 0]
        after = covariance - gain @ covariance[..., :d, :]
        return self.process.boxplus(state, delta), 0.5 * (after + after.mT)
