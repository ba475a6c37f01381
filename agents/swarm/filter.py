"""The base of swarm filters: dead reckoning, position fixes, and weights of links."""

from abc import abstractmethod

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.kalman.filter import elapsed
from agents.localizer import Estimate, Localizer
from agents.models.biases import Biases, reported
from agents.models.measurements import UavRanges
from agents.models.process import make_process
from agents.swarm import calibration, delays, ins_bias, joint, persistence, window
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.confidence import CONFIDENCES, ConfidenceKind, Weights
from agents.swarm.considered import Moments, after_step
from agents.swarm.delays import Delays
from agents.swarm.links import Links, connected, lengths, links_of
from agents.swarm.window import RangeWindow
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, InsDriven
from coloc_env.sensors import (
    AnchorRanging,
    Height,
    Ins,
    OpticalFlow,
    PositionFix,
    Ranging,
    SlowFlight,
    Tdoa,
)
from coloc_env.sensors.base import usable

_MIN_VARIANCE = 1e-6  # m² per axis: of a prior that is believed to be exact


class SwarmFilter(Localizer[SwarmBelief]):
    """Estimates the positions of a whole team in every step, from all its ranges at once.

    One localizer acts for the whole team. A UAV's estimate depends on the connected part of the
    network that it belongs to, and on the noise that ranges between anchors show anywhere.
    """

    centralized = True
    # Teams with more than ranges between UAVs are served through ``agents.swarm.anchored``.
    serves = (Ranging, AnchorRanging, PositionFix, Height, SlowFlight, OpticalFlow, Tdoa)
    window = 0  # past steps in the stress
    decay = 0.0  # λ of w(τ) = exp(−λ (t − τ)), 1/s
    recursive = True  # the solution has dead reckoning as its prior
    dense = True  # many links to each UAV: enough to calibrate all, and to over-relax

    def __init__(
        self,
        believed: Believed,
        confidence: ConfidenceKind,
        bias: bool = False,
        delays: bool = False,
    ) -> None:
        """``bias``: estimate the INS's, where the team believes in one; ``delays``: estimate those
        of antennas and clocks, where it believes in them."""
        super().__init__(believed)
        sensor = believed.sensor(Ranging)
        if sensor is None or sensor.tags:
            raise ValueError("a team with ranges between UAVs, without lever arms, is needed")
        self.std, self.process = sensor.noise.std, make_process(believed)
        self.range_models = [UavRanges(sensor)]
        self.confidence = CONFIDENCES[confidence](self.std)
        ins = believed.sensor(Ins) if isinstance(believed.process, InsDriven) else None
        self.ins = ins if bias and ins is not None and ins.bias > 0 else None
        clock = sensor.clock
        off = clock is not None and clock.offset + clock.skew > 0
        self.clock = clock if delays and off else None

    @abstractmethod
    def solve(self, belief: SwarmBelief, inputs: StepInput) -> Solution:
        """Positions from the inputs of a step."""

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> SwarmBelief:
        state, covariance = self.process.initial(observation["prior"].double())
        d, shape = self.process.dim, state.shape[:2]
        position = state[..., :d]
        variance = covariance[..., :d, :d].diagonal(dim1=-2, dim2=-1).mean(-1)
        variance = variance.clamp_min(_MIN_VARIANCE)
        model = calibration.prior_model(len(state), self.std, state.device)
        covariance = self.initial_joint(variance)
        return SwarmBelief(
            state=state,
            variance=variance,
            joint=covariance,
            ins_bias=ins_bias.initial(position, self.ins),
            step=torch.zeros(shape, dtype=torch.int64, device=state.device),
            error_sums=_per_uav(model.sums, shape),
            transitions=_per_uav(persistence.prior_counts(model.share[:, 1]), shape),
            link_memory=self.confidence.initial_memory(model, shape),
            localizable=torch.zeros(shape, dtype=torch.bool, device=state.device),
            window=window.empty(position, covariance, self.window),
            delays=delays.initial(position, self.clock),
            considered=self.biases.initial(observation, self._marginals(variance)),
            batch_size=shape,
        )

    def initial_joint(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N e K"]:
        """The joint covariance of independent UAVs; of width 0 where it is not kept."""
        return variance.new_zeros(*variance.shape, 1, 0)

    def step(self, belief: SwarmBelief, observation: Observation) -> tuple[SwarmBelief, Estimate]:
        inputs = self.predict(belief, observation)
        solution = self.solve(belief, inputs)
        after, estimate = self.update(belief, inputs, solution), self.estimate(inputs, solution)
        if not self.biases:
            return after, estimate
        considered = after_step(
            self.biases,
            self.process,
            belief.considered,
            Moments(belief.state, self._marginals(belief.variance)),
            Moments(after.state, estimate.covariance),
            elapsed(self.process, belief.step).double(),
            observation,
        )
        honest = reported(estimate.covariance, considered)
        return after.replace(considered=considered), estimate.replace(covariance=honest)

    @property
    def biases(self) -> Biases:
        """Those of ranges between UAVs."""
        return Biases(self.range_models, self.process.dt)

    def _marginals(self, variance: Float64[Tensor, "B N"]) -> Float64[Tensor, "B N d d"]:
        """Covariances of positions with one variance (m²) for all axes."""
        eye = torch.eye(self.process.dim, dtype=variance.dtype, device=variance.device)
        return variance[..., None, None] * eye

    def predict(self, belief: SwarmBelief, observation: Observation) -> StepInput:
        """Dead reckoning to the observation's step, and the step's fixes and links."""
        d, dt = self.process.dim, elapsed(self.process, belief.step).double()
        u = self.process.inputs(observation)
        if self.ins is None:
            bias, factor = None, torch.ones_like(dt)
            _, q = self.process.linearize(belief.state, u, dt)
            noise = q[..., :d, :d].diagonal(dim1=-2, dim2=-1).mean(-1)
        else:
            bias = ins_bias.decay(belief.ins_bias, dt, self.ins)
            u = u - bias.bias
            bias, factor, noise = ins_bias.predict(bias, belief.variance, dt, self.ins)
        state = self.process.propagate(belief.state, u, dt)
        fixed, prior, fix_variance = self._fixes(observation, state[..., :d])
        predicted = factor.square() * belief.variance + noise  # P ← f² P + q²
        variance = torch.where(fixed, fix_variance, predicted)
        if belief.joint.shape[-1]:
            covariance = joint.predict(belief.joint, factor, noise, fixed, fix_variance)
            pair_variance = joint.pair_variance(covariance)
        else:
            covariance = belief.joint
            pair_variance = variance.unsqueeze(-1) + variance.unsqueeze(-2)
        links, delay = self._links(observation, belief.delays, factor, fixed, dt)
        if self.clock is not None:
            pair_variance = pair_variance + delays.offset_variance(delay)
        sums = belief.error_sums[:, 0]
        inputs = StepInput(
            state=state,
            prior=prior,
            variance=variance,
            process_noise=noise,
            fixed=fixed,
            links=links,
            error_model=calibration.ErrorModel(sums=sums, batch_size=sums.shape[:1]),
            predicted_variance=predicted,
            joint=covariance,
            pair_variance=pair_variance,
            ins_bias=bias,
            transitions=belief.transitions[:, 0],
            delays=delay,
            window=self._window(belief, prior, factor, noise, fixed, fix_variance, dt),
        )
        return self.confidence.calibrate(inputs, belief.link_memory, self.dense)

    def update(self, belief: SwarmBelief, inputs: StepInput, solution: Solution) -> SwarmBelief:
        """The belief after a step with this solution."""
        d, shape = self.process.dim, inputs.fixed.shape
        bias = belief.ins_bias
        if inputs.ins_bias is not None:
            innovation = solution.position - inputs.state[..., :d]
            bias = ins_bias.update(
                inputs.ins_bias, innovation, inputs.predicted_variance, solution.variance
            )
        return build(
            SwarmBelief,
            shape,
            state=torch.cat((solution.position, inputs.state[..., d:]), -1),
            variance=solution.variance,
            joint=inputs.joint if solution.joint is None else solution.joint,
            ins_bias=bias,
            step=belief.step + 1,
            error_sums=_per_uav(inputs.error_model.sums, shape),
            transitions=_per_uav(inputs.transitions, shape),
            link_memory=self.confidence.remember(belief.link_memory, inputs, solution),
            localizable=_localizable(inputs, d),
            window=belief.window if solution.window is None else solution.window,
            delays=inputs.delays if solution.delays is None else solution.delays,
            considered=belief.considered,
        )

    def estimate(self, inputs: StepInput, solution: Solution) -> Estimate:
        """Each UAV's estimate of itself by this solution."""
        d = self.process.dim
        eye = torch.eye(d, dtype=solution.position.dtype, device=solution.position.device)
        covariance = solution.variance[..., None, None] * eye
        if solution.joint is not None:
            own = joint.marginals(solution.joint)
            covariance = own if own.shape[-1] == d else own * eye
        return build(
            Estimate,
            inputs.fixed.shape,
            position=solution.position,
            velocity=inputs.state[..., d : 2 * d],
            covariance=covariance,
        )

    def mean(self, belief: SwarmBelief) -> Float64[Tensor, "B N S"]:
        return belief.state

    def shifted(self, belief: SwarmBelief, offset: Float64[Tensor, "B N d"]) -> SwarmBelief:
        d, state = self.process.dim, belief.state
        position = state[..., :d] + offset
        return belief.replace(state=torch.cat((position, state[..., d:]), -1))

    def diagnostics(self, belief: SwarmBelief) -> dict[str, Float64[Tensor, "B N"]]:
        """``localizable``; with ``confidence=em`` share, bias (m) and persistence ρ of outliers;
        the size of the INS's bias (m/s) and the antenna's delay (m), where they are estimated."""
        own = {"localizable": belief.localizable.double()}
        own |= self.confidence.diagnostics(belief)
        if self.ins is not None:
            own["ins_bias"] = belief.ins_bias.bias.norm(dim=-1)
        if self.clock is not None:
            own["antenna_delay"] = belief.delays.delay[..., 0]
        return own

    def weights(self, y: Float64[Tensor, "B N d"], inputs: StepInput) -> Weights:
        """Each link's weight W_ij (1/m²) and shift (m) at positions y."""
        return self.weights_at(inputs.links.distance - lengths(y), inputs)

    def weights_at(self, residual: Float64[Tensor, "B N N"], inputs: StepInput) -> Weights:
        """The same at residuals (m)."""
        weight, shift = self.confidence.weights(residual, inputs)
        return (weight if inputs.confidence is None else inputs.confidence * weight), shift

    def _fixes(
        self, observation: Observation, position: Float64[Tensor, "B N d"]
    ) -> tuple[Bool[Tensor, "B N"], Float64[Tensor, "B N d"], float]:
        """Who has a position fix, the predicted positions with the fixes in their place (m), and
        the variance of fixes (m², of the axis that they know least of)."""
        sensor = self.believed.sensor(PositionFix)
        if sensor is None:
            return torch.zeros_like(position[..., 0], dtype=torch.bool), position, 0.0
        there = observation["position_fix_mask"] > 0
        z, there = usable(observation["position_fix"].double().unsqueeze(-2), there)
        fix, fixed = z[..., 0, :], there[..., 0]
        least = max(sensor.axis_std(position.shape[-1]))
        return fixed, torch.where(fixed.unsqueeze(-1), fix, position), least**2

    def _links(
        self,
        observation: Observation,
        before: Delays,
        factor: Float64[Tensor, "B N"],
        fixed: Bool[Tensor, "B N"],
        dt: Float64[Tensor, "B N"],
    ) -> tuple[Links, Delays]:
        """The step's links, their delays taken off as far as they are known, and the delays."""
        links = links_of(observation)
        if self.clock is None:
            return links, before
        after = delays.predict(before, factor, fixed, dt, self.clock)
        distance = links.distance - delays.offsets(after.delay)
        return Links(torch.where(links.mask, distance, 0.0), links.mask), after

    def _window(
        self,
        belief: SwarmBelief,
        prior: Float64[Tensor, "B N d"],
        factor: Float64[Tensor, "B N"],
        noise: Float64[Tensor, "B N"],
        fixed: Bool[Tensor, "B N"],
        fix_variance: float,
        dt: Float64[Tensor, "B N"],
    ) -> RangeWindow | None:
        """The window of past steps, moved on to the present."""
        if not self.window:
            return None
        return window.predict(
            belief.window,
            prior - belief.state[..., : self.process.dim],
            factor.masked_fill(fixed, 0.0),
            noise.masked_fill(fixed, fix_variance),
            window.fading(self.decay, dt),
        )


def _per_uav(x: Float64[Tensor, "B *s"], shape: torch.Size) -> Float64[Tensor, "B N *s"]:
    """A world's values, repeated for each of its UAVs."""
    return x.unsqueeze(1).expand(*shape, *x.shape[1:]).contiguous()


def _localizable(inputs: StepInput, dim: int) -> Bool[Tensor, "B N"]:
    """Who is connected, over any number of links, to at least ``dim`` + 1 anchors."""
    anchors = connected(inputs.links.mask).double() @ inputs.fixed.double().unsqueeze(-1)
    return anchors[..., 0] > dim
