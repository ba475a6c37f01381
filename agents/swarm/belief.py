"""What a swarm filter carries from step to step, the inputs of a step, and its solution."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm import delays, joint
from agents.swarm.calibration import ErrorModel
from agents.swarm.delays import Delays
from agents.swarm.ins_bias import InsBias
from agents.swarm.joint_bias import JointBias
from agents.swarm.links import Links, lengths
from agents.swarm.window import RangeWindow

UNKNOWN = 1e12  # m²: variance of a position of which nothing is known


class SwarmBelief(TensorClass):
    """The belief of a swarm filter, batch (B, N).

    ``state``: position as last estimated and the rest of the state by dead reckoning;
    ``variance`` of the position (m² per axis); ``joint``: the UAV's rows of the team's joint
    covariance (m², see ``agents.swarm.joint``; of width 0 where it is not kept); ``ins_bias``, and
    ``joint_bias``: its covariances with all else (of width 0: not kept); ``step``: steps taken;
    ``error_sums`` and ``transitions``: sufficient statistics of the range errors and of how links
    change between line of sight and NLOS, the same for all UAVs;
    ``link_memory``: what the confidence remembers of each link (of width 0: nothing);
    ``localizable``: connected to at least d + 1 anchors; ``window`` of past steps (of length 0:
    none); ``delays`` of antennas and clocks; ``considered``: what sensors' biases have made of the
    error (see ``agents.models.biases``; of width 0: none are believed).
    """

    state: Float64[Tensor, "B N S"]
    variance: Float64[Tensor, "B N"]
    joint: Float64[Tensor, "B N e K"]
    ins_bias: InsBias
    joint_bias: JointBias
    step: Int64[Tensor, "B N"]
    error_sums: Float64[Tensor, "B N 2 3"]
    transitions: Float64[Tensor, "B N 2 2"]
    link_memory: Float64[Tensor, "B N L"]
    localizable: Bool[Tensor, "B N"]
    window: RangeWindow
    delays: Delays
    considered: Float64[Tensor, "B N e G"]


@dataclass(frozen=True)
class StepInput:
    """What the positions of a step are computed from.

    ``state``: predicted by dead reckoning; ``prior``: the position m predicted or, at anchors,
    fixed (m); ``variance`` P of the prior (m² per axis) and ``process_noise`` q² that the step
    added to it; ``fixed``: who has a position fix; ``links``: ranges d̃_ij, without the delays that
    are known; ``error_model`` of ranges; ``predicted_variance``: P before fixes (m²); ``joint``:
    joint covariance of the priors (m²; of width 0 where it is not kept); ``pair_variance`` of the
    vectors between UAVs (m² per axis); ``ins_bias`` (None: not estimated) and ``joint_bias`` (None:
    not kept); ``transitions`` of links
    between line of sight and NLOS; ``delays``; ``outlier_probability`` of each link beforehand
    (None: the share of all); ``packet_loss``: share of steps without a range, ρ_ij of equation 17
    (None: not used); ``confidence``: factor c_ij on each link's weight from outside (None: 1; above
    1 where a link stands for several ranges); ``window`` of past steps, moved on to the present
    (None: no window).
    """

    state: Float64[Tensor, "B N S"]
    prior: Float64[Tensor, "B N d"]
    variance: Float64[Tensor, "B N"]
    process_noise: Float64[Tensor, "B N"]
    fixed: Bool[Tensor, "B N"]
    links: Links
    error_model: ErrorModel
    predicted_variance: Float64[Tensor, "B N"]
    joint: Float64[Tensor, "B N e K"]
    pair_variance: Float64[Tensor, "B N N"]
    ins_bias: InsBias | None
    transitions: Float64[Tensor, "B 2 2"]
    delays: Delays
    joint_bias: JointBias | None = None
    outlier_probability: Float64[Tensor, "B N N"] | None = None
    packet_loss: Float64[Tensor, "B N N"] | None = None
    confidence: Float64[Tensor, "B N N"] | None = None
    window: RangeWindow | None = None

    @cached_property
    def listed(self) -> "StepInput":
        """The same with what concerns links as lists of ``links.pairs``."""
        pairs = self.links.pairs

        def of(x: Tensor | None) -> Tensor | None:
            return None if x is None else pairs.of(x)

        return replace(
            self,
            links=Links(pairs.of(self.links.distance), pairs.there, pairs),
            pair_variance=pairs.of(self.pair_variance),
            outlier_probability=of(self.outlier_probability),
            packet_loss=of(self.packet_loss),
            confidence=of(self.confidence),
        )


@dataclass(frozen=True)
class Solution:
    """Positions (m), their ``variance`` (m² per axis), the ``joint`` covariance (None: not kept),
    the ``window`` with this step in it and the ``delays`` (None: as before), the INS's biases with
    their covariances (``joint_bias``; None: they follow from the variance), and each link's
    posterior probability of NLOS (``outlier``; None: it follows from the residual)."""

    position: Float64[Tensor, "B N d"]
    variance: Float64[Tensor, "B N"]
    joint: Float64[Tensor, "B N e K"] | None = None
    window: RangeWindow | None = None
    delays: Delays | None = None
    joint_bias: tuple[InsBias, JointBias] | None = None
    outlier: Float64[Tensor, "B N N"] | None = None

    def residual(self, inputs: StepInput) -> Float64[Tensor, "B N N"]:
        """d̃_ij − ‖p_i − p_j‖ (m), less this step's correction of the delays."""
        residual = inputs.links.distance - lengths(self.position)
        if self.delays is None:
            return residual
        return residual - delays.offsets(self.delays.delay - inputs.delays.delay)

    def range_variance(self, inputs: StepInput) -> Float64[Tensor, "B N N"]:
        """Variance (m²) of each predicted range; that of the prior where there is no joint
        covariance."""
        if self.joint is None:
            return inputs.pair_variance
        variance = joint.pair_variance(self.joint)
        return variance if self.delays is None else variance + delays.offset_variance(self.delays)


def with_finite_prior(inputs: StepInput) -> StepInput:
    """The same with a finite prior for every UAV: one whose prior is not finite gets the mean of
    its neighbours' priors (of all, if it has none) with variance ``UNKNOWN``."""
    finite = inputs.prior.isfinite().all(-1)
    if bool(finite.all()):
        return inputs
    prior = torch.where(finite.unsqueeze(-1), inputs.prior, 0.0)
    count = finite.double().unsqueeze(-1)
    linked = inputs.links.mask.double()
    neighbours, team = linked @ count, count.sum(1, keepdim=True).clamp_min(1.0)
    mean = torch.where(
        neighbours > 0,
        linked @ prior / neighbours.clamp_min(1.0),
        prior.sum(1, keepdim=True) / team,
    )
    pairs = finite.unsqueeze(-1) & finite.unsqueeze(-2)
    return replace(
        inputs,
        prior=torch.where(finite.unsqueeze(-1), prior, mean),
        variance=torch.where(finite, inputs.variance, UNKNOWN),
        pair_variance=torch.where(pairs, inputs.pair_variance, UNKNOWN),
    )
