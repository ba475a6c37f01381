"""What Kalman filters have in common: a Gaussian belief on the manifold, and its prediction."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.models.biases import Biases, reported
from agents.models.measurements import Measurement
from agents.models.process import Process, make_process
from agents.robust import Prediction
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed


class GaussianBelief(TensorClass):
    """Mean state, error covariance (float64), what sensors' biases have made of the error (see
    ``agents.models.biases``), what a fusion method keeps of other UAVs, steps taken, and what a
    screen remembers of earlier measurements; batch (B, N)."""

    state: Float[Tensor, "B N S"]
    covariance: Float[Tensor, "B N E F"]
    considered: Float[Tensor, "B N E G"]
    shared: Float[Tensor, "B N H"]
    step: Int64[Tensor, "B N"]
    memory: Float[Tensor, "B N K"]

    def shifted(self, offset: Float[Tensor, "B N d"]) -> "GaussianBelief":
        """Its position shifted by ``offset`` (m)."""
        d = offset.shape[-1]
        return self.replace(
            state=torch.cat((self.state[..., :d] + offset, self.state[..., d:]), -1)
        )


def elapsed(process: Process, step: Int64[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Seconds since the belief's step: none before the first observation."""
    return (step > 0).to(torch.float32) * process.dt


@dataclass(frozen=True)
class Beside:
    """What a belief holds beside mean and covariance; fields as ``GaussianBelief`` has them."""

    considered: Float[Tensor, "B N E G"]
    shared: Float[Tensor, "B N H"]
    step: Int64[Tensor, "B N"]


def predict(
    process: Process, belief: GaussianBelief, observation: Observation
) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N E E"]]:
    """Mean and covariance at the observation's step, before its measurements are used, and the
    transition F that led there."""
    dt = elapsed(process, belief.step).double()
    u = process.inputs(observation)
    f, q = process.linearize(belief.state, u, dt)
    x = process.propagate(belief.state, u, dt)  # x⁻ = f(x, u)
    return x, f @ belief.covariance @ f.mT + q, f  # P⁻ = F P Fᵀ + Q


def gaussian_estimate(
    process: Process, x: Float[Tensor, "B N S"], covariance: Float[Tensor, "B N E E"]
) -> Estimate:
    """Position, velocity and their covariance of a Gaussian belief."""
    d = process.dim
    return build(
        Estimate,
        x.shape[:2],
        position=x[..., :d],
        velocity=x[..., d : 2 * d],
        covariance=covariance[..., :d, :d],
    )


class GaussianFilter(Localizer[GaussianBelief]):
    """A Kalman filter for each UAV: prediction by the motion model, then ``update``.

    Where the team believes that what ``models`` measure is biased, its estimates' covariances
    consider that, and gains are what they are without.
    """

    models: Sequence[Measurement] = ()

    def __init__(self, believed: Believed) -> None:
        super().__init__(believed)
        self.process = make_process(believed)

    @property
    def biases(self) -> Biases:
        return Biases(self.models, self.process.dt)

    def reset(self, observation: Observation) -> GaussianBelief:
        x, covariance = self.process.initial(observation["prior"].double())
        return GaussianBelief(
            state=x,
            covariance=covariance,
            considered=self.biases.initial(observation, covariance),
            shared=self.shared(observation),
            step=torch.zeros(x.shape[:2], dtype=torch.int64, device=x.device),
            memory=self.memory(observation),
            batch_size=x.shape[:2],
        )

    def step(
        self, belief: GaussianBelief, observation: Observation
    ) -> tuple[GaussianBelief, Estimate]:
        return self.corrected(*self.predicted(belief, observation.kept()))

    def predicted(
        self, belief: GaussianBelief, observation: Observation
    ) -> tuple[Prediction, Beside]:
        """What the observation's measurements will be used on."""
        x, covariance, f = self.predict(belief, observation)
        considered = self.biases.predict(belief.considered, f, observation)
        beside = Beside(considered, self.moved(belief.shared, f), belief.step)
        return Prediction(x, covariance, observation, belief.memory), beside

    def corrected(self, prior: Prediction, beside: Beside) -> tuple[GaussianBelief, Estimate]:
        """The belief after its measurements were used."""
        x, covariance, memory, beside = self.update(prior, beside)
        after = build(
            GaussianBelief,
            x.shape[:2],
            state=x,
            covariance=covariance,
            considered=beside.considered,
            shared=beside.shared,
            step=beside.step + 1,
            memory=memory,
        )
        honest = reported(covariance, beside.considered)
        return after, gaussian_estimate(self.process, x, honest)

    def predict(
        self, belief: GaussianBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N E E"]]:
        """Mean and covariance before the measurements are used, and the transition F."""
        return predict(self.process, belief, observation)

    def mean(self, belief: GaussianBelief) -> Float[Tensor, "B N S"]:
        return belief.state

    def shifted(self, belief: GaussianBelief, offset: Float[Tensor, "B N d"]) -> GaussianBelief:
        return belief.shifted(offset)

    def gaussian(
        self, belief: GaussianBelief, observation: Observation
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        return belief.state, belief.covariance

    def restart_from(
        self,
        belief: GaussianBelief,
        rows: Bool[Tensor, "B N"],
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
    ) -> GaussianBelief:
        row = rows.unsqueeze(-1)
        return belief.replace(
            state=torch.where(row, state, belief.state),
            covariance=torch.where(row.unsqueeze(-1), covariance, belief.covariance),
            considered=torch.where(row.unsqueeze(-1), 0.0, belief.considered),
            shared=torch.where(row, 0.0, belief.shared),
        )

    def shared(self, observation: Observation) -> Float[Tensor, "B N H"]:
        """What is kept of other UAVs before the first step: nothing."""
        return observation["prior"][..., :0].double()

    def moved(
        self, shared: Float[Tensor, "B N H"], f: Float[Tensor, "B N E E"]
    ) -> Float[Tensor, "B N H"]:
        """The same after a step of transition F."""
        return shared

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        """What is remembered of measurements before the first: nothing."""
        return observation["prior"][..., :0]

    def update(
        self, prior: Prediction, beside: Beside
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N K"], Beside]:
        """Use the observation's measurements: none here."""
        return prior.state, prior.covariance, prior.memory, beside
