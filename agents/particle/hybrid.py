"""Hybrid filters: a main one, a detector of its failure, and an auxiliary one to restart it from.

NN-HPFF paper: particle filter, Mahalanobis test or neural network, and FIR filter.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float, Float32, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.bank import BankOptions, Trial
from agents.bank.kalman_fallback import KalmanFallback
from agents.errors import NotServed
from agents.localizer import Estimate, Localizer
from agents.models.measurements import AnchorRanges
from agents.models.process import make_process
from agents.particle.failure import Detector, Evidence, evidence
from agents.particle.filter import ParticleFilter
from agents.registry import make_inner
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.scenario import Believed
from coloc_env.sensors import AnchorRanging

_ILL = 30.0  # ratio of standard deviations beyond which a position is a line


class HybridBelief(TensorClass):
    """Both filters' beliefs, the Mahalanobis distance d, the residuals' root mean square (m) and
    the probability of a failure that were found last, for how many steps in a row it counts as
    failed, and whether the main filter was restarted in the last (or a restart was put on trial);
    batch (B, N)."""

    main: Any
    auxiliary: Any
    distance: Float32[Tensor, "B N"]
    residual: Float32[Tensor, "B N"]
    probability: Float32[Tensor, "B N"]
    alarms: Int64[Tensor, "B N"]
    reset: Bool[Tensor, "B N"]


class HybridFilter(Localizer[HybridBelief]):
    """Any main filter, restarted from any auxiliary one where a detector finds that it has failed.

    ``main`` is a filter that can be restarted (particle and Kalman filters), ``auxiliary`` one
    that gives a Gaussian; both are named with their options (``pf@particles=2000``).
    ``threshold``: the probability beyond which a failure counts; 1: never. ``patience``: for so
    many steps in a row it must count before anything is restarted. An auxiliary that finds itself
    outside the arena, or knows no more than that it is inside, restarts nothing.

    Restarts are on trial (``agents.bank.Trial``): the main filter speaks until one has predicted
    better, and the auxiliary's place must besides be well-posed and fit what is measured better. A
    particle filter speaks, besides, only while it predicts no worse than ``ekf:robust=huber``.
    ``bank=false``: they take effect at once.
    """

    name = "hybrid"

    def __init__(
        self,
        believed: Believed,
        detector: Detector,
        main: str,
        auxiliary: str,
        threshold: float,
        patience: int,
        bank: BankOptions,
    ) -> None:
        super().__init__(believed)
        sensor = believed.sensor(AnchorRanging)
        if sensor is None:
            raise NotServed("the team has no distances to anchors to judge its filter by")
        self.main: Localizer[Any] = make_inner(main, believed)
        self.auxiliary: Localizer[Any] = make_inner(auxiliary, believed)
        if type(self.main).restart_from is Localizer.restart_from:
            raise ValueError(f"main={main!r} is not allowed: a particle or Kalman filter")
        if type(self.auxiliary).gaussian is Localizer.gaussian:
            raise ValueError(f"auxiliary={auxiliary!r} is not allowed: emvf or a Kalman filter")
        self.on_trial = bank.bank
        if self.on_trial:
            on_trial = Trial(self.main, bank)
            particles = isinstance(self.main, ParticleFilter)
            self.main = KalmanFallback(on_trial, bank, "main_share") if particles else on_trial
        self.detector, self.threshold, self.patience = detector, threshold, patience
        self.process, self.model = make_process(believed), AnchorRanges(sensor)
        arena = (believed.arena.low, believed.arena.high)
        self._low, self._high = (torch.tensor(end, dtype=torch.float64) for end in arena)
        self._anywhere = float((self._high - self._low).square().sum()) / 12

    @property
    def exchanges(self) -> bool:
        return self.main.exchanges or self.auxiliary.exchanges

    def reset(self, observation: Observation) -> HybridBelief:
        nothing = torch.zeros_like(observation["prior"][..., 0])
        return HybridBelief(
            main=self.main.reset(observation),
            auxiliary=self.auxiliary.reset(observation),
            distance=nothing,
            residual=nothing,
            probability=nothing,
            alarms=torch.zeros_like(nothing, dtype=torch.int64),
            reset=nothing > 0,
            batch_size=nothing.shape,
        )

    def step(self, belief: HybridBelief, observation: Observation) -> tuple[HybridBelief, Estimate]:
        observation = observation.kept()
        main, estimate = self.main.step(belief.main, observation)
        auxiliary = self.auxiliary.advance(belief.auxiliary, observation)
        seen = evidence(self.model, self.process, self._state(main, estimate), observation)
        probability = self.detector.probability(seen)
        alarms = (belief.alarms + 1) * (probability > self.threshold)
        rows = alarms >= self.patience
        if bool(rows.any()):
            state, covariance = self.auxiliary.gaussian(auxiliary, observation)
            d = self.process.dim
            spread, like = covariance[..., :d, :d], estimate.position
            rows = rows & self._usable(state[..., :d], spread)
            if self.on_trial:
                rows = rows & self._sound(state, spread, seen, observation)
            main = self.main.restart_from(main, rows, state, covariance)
            if not self.on_trial:
                row = rows.unsqueeze(-1)
                estimate = Estimate(
                    position=torch.where(row, state[..., :d].to(like), like),
                    velocity=torch.where(row, state[..., d : 2 * d].to(like), estimate.velocity),
                    covariance=torch.where(row.unsqueeze(-1), spread, estimate.covariance),
                    batch_size=rows.shape,
                )
        after = build(
            HybridBelief,
            rows.shape,
            main=main,
            auxiliary=auxiliary,
            distance=seen.distance,
            residual=seen.rms,
            probability=probability,
            alarms=alarms * ~rows,
            reset=rows,
        )
        return after, estimate

    def mean(self, belief: HybridBelief) -> Float[Tensor, "B N S"]:
        return self.main.mean(belief.main)

    def shifted(self, belief: HybridBelief, offset: Float[Tensor, "B N d"]) -> HybridBelief:
        return belief.replace(main=self.main.shifted(belief.main, offset))

    def diagnostics(self, belief: HybridBelief) -> dict[str, Float[Tensor, "B N"]]:
        own = {
            "mahalanobis": belief.distance,
            "residual_rms": belief.residual,
            "failure": belief.probability,
        }
        own["trials_per_run" if self.on_trial else "resets_per_run"] = belief.reset.float()
        return self.main.diagnostics(belief.main) | own

    def _usable(
        self, position: Float[Tensor, "B N d"], covariance: Float[Tensor, "B N d d"]
    ) -> Bool[Tensor, "B N"]:
        """Whether an auxiliary's position is one to restart from."""
        low, high = (end.to(position.device) for end in (self._low, self._high))
        inside = ((position >= low) & (position <= high)).all(-1)
        return inside & (covariance.diagonal(dim1=-2, dim2=-1).sum(-1) < self._anywhere)

    def _sound(
        self,
        state: Float[Tensor, "B N S"],
        covariance: Float[Tensor, "B N d d"],
        seen: Evidence,
        observation: Observation,
    ) -> Bool[Tensor, "B N"]:
        """Whether the auxiliary's position is known about as well in all directions (condition),
        and leaves less of what is measured now than the main filter's (cost)."""
        variances = torch.linalg.eigvalsh(covariance)
        posed = (variances[..., 0] > 0) & (variances[..., -1] < _ILL**2 * variances[..., 0])
        where = state if self.model.tags else state[..., : self.process.dim]
        left = evidence(self.model, self.process, where, observation)
        return posed & (left.distance < seen.distance)

    def _state(self, main: Any, estimate: Estimate) -> Float[Tensor, "B N S"]:
        """What distances to anchors need to know of the main filter's state."""
        if self.model.tags:
            return self.main.mean(main)
        return estimate.position
