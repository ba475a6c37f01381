"""Dead reckoning and the cooperative error-state EKF, one filter per UAV.

Roumeliotis & Bekey 2002 with the error state on the manifold: (δp, δv, δθ) and, where the team
believes in them, IMU biases. Ranges to neighbours use their broadcast estimate *and* its
uncertainty. What the UAVs' estimates have in common is ignored by that (``fusion="naive"``), so the
filter can grow overconfident; ``fusion="ci"`` never does, at a price.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate, Localizer, register
from agents.models.measurements import Block, Neighbours, heard, make_measurements
from agents.models.process import Process, make_process
from agents.models.robust import Robust, check_gate, weigh
from agents.models.update import information, iterated_update, posterior
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

_OMEGA = (
    1.0,
    0.99,
    0.97,
    0.93,
    0.87,
    0.8,
    0.7,
    0.55,
    0.4,
)  # weights tried by covariance intersection


class GaussianBelief(TensorClass):
    """Mean state, error covariance (float64) and steps taken; batch (B, N)."""

    state: Float[Tensor, "B N S"]
    covariance: Float[Tensor, "B N E F"]
    step: Int64[Tensor, "B N"]


def elapsed(process: Process, step: Int64[Tensor, "B N"]) -> Float[Tensor, "B N"]:
    """Seconds since the belief's step: none before the first observation."""
    return (step > 0) * process.dt


def predict(
    process: Process, belief: GaussianBelief, observation: Observation
) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
    """Mean and covariance at the observation's step, before its measurements are used."""
    dt = elapsed(process, belief.step).double()
    u = process.inputs(observation)
    f, q = process.linearize(belief.state, u, dt)
    return process.propagate(belief.state, u, dt), f @ belief.covariance @ f.mT + q


def gaussian_estimate(
    process: Process, x: Float[Tensor, "B N S"], covariance: Float[Tensor, "B N E E"]
) -> Estimate:
    """What a Gaussian belief says of position and velocity."""
    d = process.dim
    return Estimate(
        position=x[..., :d],
        velocity=x[..., d : 2 * d],
        covariance=covariance[..., :d, :d],
        batch_size=x.shape[:2],
    )


@register("dead_reckoning")
class DeadReckoning(Localizer[GaussianBelief]):
    """Motion model and its sensors alone: the floor that any measurement should lift."""

    name = "dead_reckoning"

    def __init__(self, believed: Believed) -> None:
        super().__init__(believed)
        self.process = make_process(believed)

    def reset(self, observation: Observation) -> GaussianBelief:
        x, covariance = self.process.initial(observation["prior"].double())
        step = torch.zeros(x.shape[:2], dtype=torch.int64, device=x.device)
        return GaussianBelief(state=x, covariance=covariance, step=step, batch_size=x.shape[:2])

    def step(
        self, belief: GaussianBelief, observation: Observation
    ) -> tuple[GaussianBelief, Estimate]:
        x, covariance = predict(self.process, belief, observation)
        x, covariance = self.update(x, covariance, observation)
        after = GaussianBelief(
            state=x, covariance=covariance, step=belief.step + 1, batch_size=x.shape[:2]
        )
        return after, gaussian_estimate(self.process, x, covariance)

    def update(
        self,
        x: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
        observation: Observation,
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        """Use the observation's measurements: none here."""
        return x, covariance


@register("ekf")
class CooperativeEkf(DeadReckoning):
    """Cooperative error-state EKF, one per UAV, fed by neighbours' messages.

    ``robust``: ``huber`` (reweighted at every iteration) or ``gate`` (innovations outside the χ²
    quantile ``gate`` are dropped). ``fusion``: ``naive``, or ``ci`` (split covariance intersection
    for everything that involves a neighbour). ``iterations`` of each update. ``cooperate=false``
    leaves other UAVs out.
    """

    name = "ekf"

    def __init__(
        self,
        believed: Believed,
        *,
        robust: Robust = "none",
        gate: float = 0.999,
        fusion: Literal["naive", "ci"] = "naive",
        iterations: int = 2,
        cooperate: bool = True,
    ) -> None:
        super().__init__(believed)
        if iterations < 1:
            raise ValueError(f"ekf: iterations={iterations} is not allowed: at least 1")
        check_gate(gate)
        self.robust, self.gate, self.iterations = robust, gate, iterations
        models = make_measurements(believed)
        own = [m for m in models if not m.cooperative]
        shared = [m for m in models if m.cooperative and cooperate]
        self.first = own if fusion == "ci" else own + shared
        self.intersected = shared if fusion == "ci" else []

    def update(
        self,
        x: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
        observation: Observation,
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        neighbours = heard(self.believed, observation)

        def linearize(at: Tensor) -> Sequence[Block]:
            return [m.linearize(self.process, at, observation, neighbours) for m in self.first]

        prior = covariance
        if self.first:
            x, covariance = iterated_update(
                self.process,
                x,
                covariance,
                linearize,
                lambda blocks, last: weigh(self.robust, self.gate, blocks, prior, last),
                self.iterations,
            )
        if self.intersected:
            x, covariance = self._intersect(x, covariance, observation, neighbours)
        return x, covariance

    def _intersect(
        self,
        x: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N E E"],
        observation: Observation,
        neighbours: Neighbours,
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"]]:
        """Split covariance intersection (Julier & Uhlmann 2001; Li & Nashashibi 2013): own
        covariance over ω, the neighbours' over 1 − ω, ω chosen for the least position variance."""
        d = self.process.dim
        blocks = [m.linearize(self.process, x, observation, neighbours) for m in self.intersected]
        weights = weigh(self.robust, self.gate, blocks, covariance, None)
        best: tuple[Tensor, Tensor, Tensor] | None = None
        for omega in _OMEGA:
            if omega == 1.0:
                delta, updated = torch.zeros_like(covariance[..., 0]), covariance
            else:
                apart = [_inflated(block, 1 - omega) for block in blocks]
                delta, updated = posterior(covariance / omega, *information(apart, weights))
            trace = updated[..., :d, :d].diagonal(dim1=-2, dim2=-1).sum(-1)
            if best is None:
                best = (trace, delta, updated)
            else:
                better = trace < best[0]
                best = (
                    torch.where(better, trace, best[0]),
                    torch.where(better[..., None], delta, best[1]),
                    torch.where(better[..., None, None], updated, best[2]),
                )
        assert best is not None
        return self.process.boxplus(x, best[1]), best[2]


def _inflated(block: Block, share: float) -> Block:
    """The block with its partners' uncertainty divided by their share of the weight."""
    assert block.partner_variance is not None
    return replace(block, partner_variance=block.partner_variance / share)
