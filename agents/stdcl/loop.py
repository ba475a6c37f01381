"""The closed loop of a swarm filter and the ST-GNN (ST-DCL paper, section 4.2.3)."""

from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float64
from tensordict import TensorClass
from torch import Tensor

from agents.errors import NotServed
from agents.localizer import Estimate, Localizer
from agents.models.process import drives
from agents.stdcl.features import GraphInputs, RunningMeans, graph_inputs, initial_means
from agents.stdcl.feedback import FEEDBACKS, KAPPA, FeedbackKind
from agents.stdcl.network import ConvolutionState, Correction, StGnn
from agents.swarm import joint
from agents.swarm.anchored import is_plain
from agents.swarm.belief import Solution, StepInput, SwarmBelief
from agents.swarm.filter import SwarmFilter
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, InsDriven
from coloc_env.sensors import PositionFix, Ranging

MAX_OFFSET = 3.0  # δ_max in standard deviations (equation 34)
_TRAINING_DT = 1.0  # s between steps in training


class LoopBelief(TensorClass):
    """The optimizer's belief (``base``), running ``means`` of residuals and innovations, the state
    of the network's ``convolutions``, and the ``confidence`` c_ij of each link; batch (B, N)."""

    base: SwarmBelief
    means: RunningMeans
    convolutions: ConvolutionState
    confidence: Float64[Tensor, "B N N"]


class NetworkLoop(Localizer[LoopBelief]):
    """A swarm filter whose positions a graph network corrects, with feedback to the filter.

    ``feedback``: ``positions``, the next step starts from the corrected positions and their
    variance; ``links``, the network's confidence weights each link; ``learned``, both; ``paper``,
    links are weighted by equation 36 with the gain ``kappa``; ``none``. A confidence changes by
    10 % a step at most.

    Where gradients are required, feedback is differentiated through the next solution in first
    order, neighbours held: ∂y/∂m = λ H⁻¹, ∂y/∂c_ij = H⁻¹ W_ij (d̃_ij − ‖y_i − y_j‖) u_ij / c_ij.
    """

    centralized = True
    serves = (Ranging, PositionFix)

    def __init__(
        self, base: SwarmFilter, network: StGnn, feedback: FeedbackKind, kappa: float = KAPPA
    ) -> None:
        super().__init__(base.believed)
        if not is_plain(base.believed):
            raise NotServed(
                "a team is needed whose motion an INS drives, with ranges between centres"
            )
        self.base, self.feedback, self.std = base, FEEDBACKS[feedback](kappa), base.std
        self.rate = min(1.0, base.believed.arena.dt / _TRAINING_DT)
        self.network = network.double().requires_grad_(False)

    @classmethod
    def ignores(cls, believed: Believed) -> list[str]:
        """Sensors that are not served; if there are none, what drives another motion model than the
        INS's, and ranging with lever arms."""
        ignored, ranging = super().ignores(believed), believed.sensor(Ranging)
        if ignored:
            return ignored
        if not isinstance(believed.process, InsDriven):
            drivers = (sensor for sensor in believed.sensors if drives(believed, sensor))
            ignored = [type(sensor).__name__ for sensor in drivers]
        if ranging is not None and ranging.tags:
            ignored.append(Ranging.__name__)
        return ignored

    def learn(self, network: StGnn) -> None:
        """Correct by this network from now on."""
        self.network = network

    @property
    def exchanges(self) -> bool:
        return True

    def reset(self, observation: Observation) -> LoopBelief:
        base, d = self.base.reset(observation), self.base.process.dim
        shape = base.batch_size
        return build(
            LoopBelief,
            shape,
            base=base,
            means=initial_means(shape[0], shape[1], d, base.step.device),
            convolutions=self.network.start(shape, d),
            confidence=base.variance.new_ones(*shape, shape[1]),
        )

    def predict(self, belief: LoopBelief, observation: Observation) -> StepInput:
        """The optimizer's dead reckoning to the observation's step, its fixes and links."""
        return self.base.predict(belief.base, observation)

    def step(self, belief: LoopBelief, observation: Observation) -> tuple[LoopBelief, Estimate]:
        with torch.no_grad():
            inputs = self.predict(belief, observation)
            if self.feedback.links:
                inputs = replace(inputs, confidence=belief.confidence)
            solution = self.base.solve(belief.base, inputs)
            limit = self._max_offset(inputs, solution)
            weights = partial(self.base.weights_at, inputs=inputs.listed)
            graph, means = graph_inputs(inputs, solution, weights, self.std, belief.means, limit)
        correction, convolutions = self.network(graph, belief.convolutions, self.feedback.judged)
        if torch.is_grad_enabled():
            carrier = _gradient_carrier(belief, graph)
            solution = replace(solution, position=solution.position + carrier)
        corrected = _corrected(inputs, solution, correction, self.rate)
        next_start = corrected if self.feedback.positions else solution
        after = build(
            LoopBelief,
            belief.batch_size,
            base=self.base.update(belief.base, inputs, next_start),
            means=means,
            convolutions=convolutions,
            confidence=self.feedback.confidence(
                belief.confidence, inputs, corrected, correction, self.std
            ),
        )
        return after, self.base.estimate(inputs, corrected)

    def mean(self, belief: LoopBelief) -> Float64[Tensor, "B N S"]:
        return self.base.mean(belief.base)

    def shifted(self, belief: LoopBelief, offset: Float64[Tensor, "B N d"]) -> LoopBelief:
        return belief.replace(base=self.base.shifted(belief.base, offset))

    def diagnostics(self, belief: LoopBelief) -> dict[str, Float64[Tensor, "B N"]]:
        return self.base.diagnostics(belief.base)

    def _max_offset(self, inputs: StepInput, solution: Solution) -> Float64[Tensor, "B N"]:
        """δ_max (m): three standard deviations of a position, or of what the step's links took off
        its variance, if that is less. So a UAV without links is not moved."""
        reduction = (inputs.variance - solution.variance).clamp_min(0.0)
        return MAX_OFFSET * torch.minimum(solution.variance, reduction).sqrt()


def _gradient_carrier(belief: LoopBelief, graph: GraphInputs) -> Float64[Tensor, "B N d"]:
    """Zeros with the gradient of the solution by what was fed back: prior positions m and
    confidences c_ij."""
    m = belief.base.state[..., : graph.vectors.shape[-2]]
    gradient = graph.precision.unsqueeze(-1) * (m - m.detach())  # λ ∂m
    c = graph.pairs.of(belief.confidence)
    change = c / c.detach() - 1  # ∂c_ij / c_ij
    strength = graph.weight * (change * graph.residual).unsqueeze(1)
    gradient = gradient + graph.pairs.along(strength, graph.unit)
    moved = (graph.gain @ gradient.unsqueeze(-1))[..., 0]  # H⁻¹ (…)
    return torch.where(graph.free.unsqueeze(-1), moved, 0.0)


def _corrected(
    inputs: StepInput, solution: Solution, correction: Correction, rate: float
) -> Solution:
    """p̂ = p + γ Δp (equation 35) and its variance, at most that of dead reckoning; anchors stay.
    Factors of variances multiply from step to step: they are raised to the power ``rate``, a step's
    length in units of that in training."""
    free = ~inputs.fixed
    position = solution.position + correction.offset.double()
    variance = solution.variance * correction.variance_factor.double() ** rate
    variance = torch.where(free, torch.minimum(variance, inputs.variance), solution.variance)
    return replace(
        solution,
        position=torch.where(free.unsqueeze(-1), position, solution.position),
        variance=variance,
        joint=None if solution.joint is None else joint.rescale(solution.joint, variance),
    )
