"""The base of swarm filters: dead reckoning, position fixes, and weights of links."""

from abc import abstractmethod

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.filter import elapsed
from agents.localizer import Estimate, Localizer
from agents.models.biases import Biases, reported
from agents.models.measurements import UavRanges
from agents.models.process import make_process
from agents.swarm import calibration, delays, ins_bias, joint, joint_bias, persistence, window
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.confidence import CONFIDENCES, SolvedKind, Weights
from agents.swarm.considered import Moments, after_step
from agents.swarm.dead_reckoning import DeadReckoning, Predicted
from agents.swarm.links import Links, links_of, of_both_ends
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
    jointly_biased = False  # the covariance of all biases is kept
    dense = True  # many links to each UAV: enough to calibrate all, and to over-relax

    def __init__(
        self,
        believed: Believed,
        confidence: SolvedKind,
        bias: bool = False,
        delays: bool = False,
    ) -> None:
        """``bias``: estimate the INS's, where the team believes in one; ``delays``: estimate those
        of antennas and clocks, where it believes in them."""
        super().__init__(believed)
        sensor = believed.sensor(Ranging)
        if sensor is None or sensor.tags:
            raise NotServed("a team with ranges between UAVs, without lever arms, is needed")
        if sensor.noise.std == 0:
            raise NotServed("ranges believed to have no noise weigh too much: uwb_std=0")
        self.std, self.process = sensor.noise.std, make_process(believed)
        self.range_models = [UavRanges(sensor)]
        self.confidence = CONFIDENCES[confidence](self.std)
        ins = believed.sensor(Ins) if isinstance(believed.process, InsDriven) else None
        self.ins = ins if bias and ins is not None and ins.bias > 0 else None
        clock = sensor.clock
        off = clock is not None and clock.offset + clock.skew > 0
        self.clock = clock if delays and off else None
        self.dead_reckoning = DeadReckoning(
            self.process, self.ins, self.clock, believed.sensor(PositionFix)
        )

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
        offsets = delays.initial(position, self.clock)
        return SwarmBelief(
            state=state,
            variance=variance,
            joint=covariance,
            ins_bias=ins_bias.initial(position, self.ins),
            joint_bias=joint_bias.initial(position, offsets, self.ins, self.jointly_biased),
            step=torch.zeros(shape, dtype=torch.int64, device=state.device),
            error_sums=_per_uav(model.sums, shape),
            transitions=_per_uav(persistence.prior_counts(model.share[:, 1]), shape),
            link_memory=self.confidence.initial_memory(model, shape),
            localizable=torch.zeros(shape, dtype=torch.bool, device=state.device),
            window=window.empty(position, covariance, self.window),
            delays=offsets,
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
        at = self.dead_reckoning.predict(belief, observation)
        links, pair_variance = links_of(observation), self._pair_variance(at)
        if self.clock is not None:
            distance = links.distance - delays.offsets(at.delays.delay)
            links = Links(torch.where(links.mask, distance, 0.0), links.mask)
            pair_variance = pair_variance + delays.offset_variance(at.delays)
        sums = belief.error_sums[:, 0]
        inputs = StepInput(
            state=at.state,
            prior=at.prior,
            variance=at.variance,
            process_noise=at.process_noise,
            fixed=at.fixed,
            links=links,
            error_model=calibration.ErrorModel(sums=sums, batch_size=sums.shape[:1]),
            predicted_variance=at.predicted_variance,
            joint=at.joint,
            pair_variance=pair_variance,
            ins_bias=at.ins_bias,
            joint_bias=at.joint_bias,
            transitions=belief.transitions[:, 0],
            delays=at.delays,
            window=self._window(belief, at),
        )
        return self.confidence.calibrate(inputs, belief.link_memory, self.dense)

    def update(self, belief: SwarmBelief, inputs: StepInput, solution: Solution) -> SwarmBelief:
        """The belief after a step with this solution."""
        d, shape = self.process.dim, inputs.fixed.shape
        bias, known = belief.ins_bias, belief.joint_bias
        if solution.joint_bias is not None:
            bias, known = solution.joint_bias
        elif inputs.ins_bias is not None:
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
            joint_bias=known,
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

    def of_members(self, belief: SwarmBelief, count: int) -> SwarmBelief:
        """The belief in N UAVs and ``count`` anchors, M in all, from the UAVs' rows, with memories
        of links between N and M; an anchor's state is yet to be written."""
        n = belief.shape[1]
        index = torch.arange(n + count, device=belief.state.device).clamp_max(n - 1)
        members = belief[:, index]
        if not belief.link_memory.shape[-1]:
            return members
        return members.replace(link_memory=of_both_ends(belief.link_memory))

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
        return self.weights_at(inputs.links.distance - inputs.links.lengths(y), inputs)

    def weights_at(self, residual: Float64[Tensor, "B *L"], inputs: StepInput) -> Weights:
        """The same at residuals (m)."""
        return scaled(self.confidence.weights(residual, inputs), inputs.confidence)

    def _pair_variance(self, at: Predicted) -> Float64[Tensor, "B N N"]:
        """Of the vectors between the priors (m² per axis)."""
        if at.joint.shape[-1]:
            return joint.pair_variance(at.joint)
        return at.variance.unsqueeze(-1) + at.variance.unsqueeze(-2)

    def decay_rate(
        self,
        noise: Float64[Tensor, "B N"],
        fixed: Bool[Tensor, "B N"],
        dt: Float64[Tensor, "B N"],
    ) -> float | Float64[Tensor, "B 1"]:
        """λ of w(τ) = exp(−λ (t − τ)) in 1/s, in a step with this process ``noise`` (m²)."""
        return self.decay

    def _window(self, belief: SwarmBelief, at: Predicted) -> RangeWindow | None:
        """The window of past steps, moved on to the present."""
        if not self.window:
            return None
        return window.predict(
            belief.window,
            at.prior - belief.state[..., : self.process.dim],
            at.factor.masked_fill(at.fixed, 0.0),
            at.process_noise.masked_fill(at.fixed, at.fix_variance),
            window.fading(self.decay_rate(at.process_noise, at.fixed, at.dt), at.dt),
        )


def scaled(found: Weights, confidence: Float64[Tensor, "B *L"] | None) -> Weights:
    """Weights times what links are trusted beside."""
    weight, shift = found
    return (weight if confidence is None else confidence * weight), shift


def _per_uav(x: Float64[Tensor, "B *s"], shape: torch.Size) -> Float64[Tensor, "B N *s"]:
    """A world's values, repeated for each of its UAVs."""
    return x.unsqueeze(1).expand(*shape, *x.shape[1:]).contiguous()


def _localizable(inputs: StepInput, dim: int) -> Bool[Tensor, "B N"]:
    """Who is connected, over any number of links, to at least ``dim`` + 1 anchors."""
    component = inputs.links.pairs.components()
    anchors = torch.zeros_like(component).scatter_add(1, component, inputs.fixed.long())
    return anchors.gather(1, component) > dim
