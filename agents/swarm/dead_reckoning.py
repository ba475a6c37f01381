"""Dead reckoning of a team: state and covariances at the next observation, with its fixes."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.kalman.filter import elapsed
from agents.models.process import Process
from agents.swarm import delays, ins_bias, joint, joint_bias
from agents.swarm.belief import SwarmBelief
from agents.swarm.delays import Delays
from agents.swarm.ins_bias import InsBias
from agents.swarm.joint_bias import JointBias
from coloc_env.observation import Observation
from coloc_env.sensors import Clock, Ins, PositionFix
from coloc_env.sensors.base import usable


@dataclass(frozen=True)
class Predicted:
    """The prior of a step; fields as ``StepInput`` has them. ``dt`` (s) since the belief's step;
    positions' covariances shrink by ``factor`` f, and fixes have ``fix_variance`` (m²)."""

    state: Float64[Tensor, "B N S"]
    prior: Float64[Tensor, "B N d"]
    variance: Float64[Tensor, "B N"]
    predicted_variance: Float64[Tensor, "B N"]
    process_noise: Float64[Tensor, "B N"]
    fixed: Bool[Tensor, "B N"]
    joint: Float64[Tensor, "B N e K"]
    ins_bias: InsBias | None
    joint_bias: JointBias | None
    delays: Delays
    dt: Float64[Tensor, "B N"]
    factor: Float64[Tensor, "B N"]
    fix_variance: float


@dataclass(frozen=True)
class DeadReckoning:
    """Of a motion model ``process``, with the INS whose bias and the clocks whose delays are
    estimated (None: not estimated), and fixes of positions (None: there are none)."""

    process: Process
    ins: Ins | None
    clock: Clock | None
    fix: PositionFix | None

    def predict(self, belief: SwarmBelief, observation: Observation) -> Predicted:
        """From the belief to the step of the observation."""
        d, dt = self.process.dim, elapsed(self.process, belief.step).double()
        u = self.process.inputs(observation)
        covariance, offsets, known = belief.joint, belief.delays, None
        factor, bias = torch.ones_like(dt), None
        jointly = belief.joint_bias.own.shape[-1] > 0
        if self.ins is None:
            _, q = self.process.linearize(belief.state, u, dt)
            noise = q[..., :d, :d].diagonal(dim1=-2, dim2=-1).mean(-1)
        else:
            bias = ins_bias.decay(belief.ins_bias, dt, self.ins)
            u = u - bias.bias
            if jointly:
                known = joint_bias.decay(belief.joint_bias, dt, self.ins)
                known, covariance, offsets = joint_bias.predict(
                    known, covariance, offsets, dt, self.ins
                )
                noise = torch.zeros_like(dt)  # it is in the covariance
            else:
                bias, factor, noise = ins_bias.predict(bias, belief.variance, dt, self.ins)
        state = self.process.propagate(belief.state, u, dt)
        fixed, prior, fix_variance = self._fixes(observation, state[..., :d])
        if jointly:
            assert bias is not None
            assert known is not None
            predicted = joint.marginal_variances(covariance)
            innovation = prior - state[..., :d]
            bias, known = joint_bias.at_fixes(
                bias, known, covariance, offsets, fixed, innovation, fix_variance
            )
        else:
            predicted = factor.square() * belief.variance + noise  # P ← f² P + q²
        if covariance.shape[-1]:
            covariance = joint.predict(covariance, factor, noise, fixed, fix_variance)
        if self.clock is not None:
            offsets = delays.predict(offsets, factor, fixed, dt, self.clock)
            if known is not None:
                known = joint_bias.with_delays_after(known, dt, self.clock)
        return Predicted(
            state=state,
            prior=prior,
            variance=torch.where(fixed, fix_variance, predicted),
            predicted_variance=predicted,
            process_noise=predicted - belief.variance if jointly else noise,
            fixed=fixed,
            joint=covariance,
            ins_bias=bias,
            joint_bias=known,
            delays=offsets,
            dt=dt,
            factor=factor,
            fix_variance=fix_variance,
        )

    def _fixes(
        self, observation: Observation, position: Float64[Tensor, "B N d"]
    ) -> tuple[Bool[Tensor, "B N"], Float64[Tensor, "B N d"], float]:
        """Who has a position fix, the predicted positions with the fixes in their place (m), and
        the variance of fixes (m², of the axis that they know least of)."""
        if self.fix is None:
            return torch.zeros_like(position[..., 0], dtype=torch.bool), position, 0.0
        there = observation["position_fix_mask"] > 0
        z, there = usable(observation["position_fix"].double().unsqueeze(-2), there)
        fix, fixed = z[..., 0, :], there[..., 0]
        least = max(self.fix.axis_std(position.shape[-1]))
        return fixed, torch.where(fixed.unsqueeze(-1), fix, position), least**2
