"""The cooperative error-state EKF, one filter per UAV.

Roumeliotis & Bekey 2002 with the error state on the manifold: (δp, δv, δθ) and, where the team
believes in them, IMU biases. Ranges to neighbours use their broadcast estimate *and* its
uncertainty. What the UAVs' estimates have in common is ignored by that (``fusion="naive"``), so the
filter can grow overconfident; the other methods of fusion are not, at a price.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from jaxtyping import Float
from torch import Tensor

from agents.association import AssociationName, associated
from agents.errors import NotServed
from agents.kalman.exchange import ExchangingEkf
from agents.kalman.filter import Beside, GaussianBelief, GaussianFilter
from agents.kalman.fusion import Fusion
from agents.kalman.intersection import Intersection
from agents.kalman.late import LateFusion
from agents.kalman.pairwise import Pairwise
from agents.localizer import Localizer
from agents.models.biases import kept_share, reported
from agents.models.measurements import Neighbours, make_measurements, received
from agents.models.ordered_update import by_kind, pick
from agents.models.update import Update, expanded_update, iterated_update
from agents.robust import Fixed, Prediction, RobustScreen, Screen, Trust
from coloc_env.observation import Observation
from coloc_env.options import OpenShare, PositiveCount
from coloc_env.scenario import Believed
from coloc_env.sensors import UnlabelledLandmarks

# Options that the exchange of measurements has not.
_OTHERS = {"fusion", "second_order", "association"}
FusionName = Literal["naive", "ci", "pairwise", "exchange"]


class CooperativeEkf(GaussianFilter):
    """Cooperative error-state EKF, one per UAV, fed by neighbours' messages.

    ``robust``: ``none``, or any of these joined by ``+``: ``huber`` reweights at every iteration
    (or ``student``, t with ν = 4, or ``mixture``, of two Gaussians); ``gate`` drops innovations
    outside the χ² quantile ``gate``, ``ransac`` landmarks that do not agree with most others,
    ``temporal`` what does not agree with the last two steps, ``cross`` what neighbours'
    measurements contradict. ``iterations`` of each update. ``cooperate=false`` leaves other UAVs
    out. ``association`` of landmarks that come without names: each with its ``nearest``
    neighbour, or all with those that are ``joint``ly compatible, within the χ² quantile ``gate``.

    ``fusion`` of what involves neighbours: ``naive``, as if their errors were independent; ``ci``,
    covariance intersection, one neighbour after the other; ``pairwise``, UAVs that meet (at most
    ``partners`` a step) update jointly and keep what they then share; ``exchange``, all raw
    measurements reach everybody, who runs ``ekf_joint`` on them. ``second_order``, with
    ``fusion=ci``: the own measurements in one iteration, distances expanded to the second order, as
    ``ekf_joint`` has them.
    """

    name = "ekf"
    associates = True

    def __init__(
        self,
        believed: Believed,
        *,
        robust: str = "none",
        gate: OpenShare = 0.999,
        fusion: FusionName = "naive",
        partners: PositiveCount = 1,
        iterations: PositiveCount = 2,
        cooperate: bool = True,
        second_order: bool = False,
        association: AssociationName = "joint",
    ) -> None:
        super().__init__(believed)
        self.iterations, self.second_order = iterations, second_order
        self.models = [m for m in make_measurements(believed) if cooperate or not m.cooperative]
        self.screen: Screen = RobustScreen(self.process, self.models, robust, gate)
        self.association = associated(believed, self.process, association, gate)
        own, shared = by_kind(self.models)
        self.kinds = own, shared
        self.fusion: Fusion | None = None
        if fusion == "ci" and shared:
            self.fusion = Intersection(believed, self.process, pick(self.models, shared))
        elif fusion == "pairwise" and shared:
            models = pick(self.models, shared)
            self.fusion = Pairwise(believed, self.process, models, partners)
        elif fusion == "exchange":
            raise ValueError("fusion='exchange' is not allowed: one of naive, ci, pairwise")

    @classmethod
    def for_team(cls, believed: Believed, **options: Any) -> Localizer[Any]:
        """The filter; with ``fusion=exchange``, or a fusion of late messages, what works so.

        Raises ValueError for options that the fusion does not have."""
        cls.require_sense(options)
        fusion = options.get("fusion", "naive")
        if fusion == "exchange":
            if believed.sensor(UnlabelledLandmarks) is not None:
                raise NotServed("fusion=exchange needs landmarks with names")
            chosen = {name: options[name] for name in options.keys() - _OTHERS}
            return ExchangingEkf(believed, **chosen)
        one = cls(believed, **options)
        if fusion == "pairwise" and believed.message_delay:
            return LateFusion(believed, one)
        return one

    @staticmethod
    def require_sense(options: Mapping[str, Any]) -> None:
        """Raise ValueError for options that the fusion does not have."""
        fusion = options.get("fusion", "naive")
        if fusion != "ci" and options.get("second_order"):
            raise ValueError(f"second_order=true is not allowed with fusion={fusion}: only with ci")
        if fusion != "pairwise" and "partners" in options:
            raise ValueError(f"partners is not allowed with fusion={fusion}: only with pairwise")

    @property
    def exchanges(self) -> bool:
        return self.screen.exchanges or self.fusion is not None

    def memory(self, observation: Observation) -> Float[Tensor, "B N K"]:
        if self.association is not None:
            observation = self.association.unseen(observation)
        return self.screen.memory(observation)

    def shared(self, observation: Observation) -> Float[Tensor, "B N H"]:
        if self.fusion is None:
            return super().shared(observation)
        return self.fusion.initial(observation)

    def moved(
        self, shared: Float[Tensor, "B N H"], f: Float[Tensor, "B N E E"]
    ) -> Float[Tensor, "B N H"]:
        return shared if self.fusion is None else self.fusion.scaled(shared, f)

    def diagnostics(self, belief: GaussianBelief) -> dict[str, Float[Tensor, "B N"]]:
        """``bytes`` that each UAV sent in the step, float32 numbers."""
        if self.screen.exchanges or not self.kinds[1]:
            return {}
        if self.fusion is not None:
            return {"bytes": self.fusion.sent(belief.shared)}
        return {"bytes": belief.state.new_full(belief.step.shape, 4 * 3 * self.process.dim)}

    def update(
        self, prior: Prediction, beside: Beside
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N K"], Beside]:
        if not self.models:
            return super().update(prior, beside)
        if self.association is not None:
            prior = self.association.named(prior)
        if self.fusion is not None:
            return self._fused(prior, beside, self.fusion)
        neighbours, seen = received(self.believed, prior.observation), prior.observation
        found = self._updated(prior, neighbours, self.screen)
        considered = self.biases.of_update(
            beside.considered, prior.covariance, found.covariance, found.blocks, found.trusts, seen
        )
        return found.state, found.covariance, found.memory, replace(beside, considered=considered)

    def _updated(self, prior: Prediction, neighbours: Neighbours, screen: Screen) -> Update:
        if self.second_order:
            return expanded_update(prior, neighbours, screen)
        return iterated_update(prior, neighbours, screen, self.iterations)

    def _fused(
        self, prior: Prediction, beside: Beside, fusion: Fusion
    ) -> tuple[Float[Tensor, "B N S"], Float[Tensor, "B N E E"], Float[Tensor, "B N K"], Beside]:
        """First the UAV's own measurements, then what involves others; each trusted as in the naive
        update."""
        seen, memory = prior.observation, prior.memory
        trusts = [Trust()] * len(self.models)
        neighbours = fusion.neighbours(prior)
        if self.screen.judges:
            naive = iterated_update(prior, neighbours, self.screen, self.iterations)
            trusts, memory = naive.trusts, naive.memory
        own, shared = self.kinds
        x, p, considered, others = prior.state, prior.covariance, beside.considered, beside.shared
        if own:
            models, fixed = pick(self.models, own), pick(trusts, own)
            screen = Fixed(self.process, models, fixed)
            found = self._updated(prior, neighbours, screen)
            others = fusion.scaled(others, kept_share(p, found.covariance))
            considered = self.biases.of_update(
                considered, p, found.covariance, found.blocks, fixed, seen, models
            )
            x, p = found.state, found.covariance
        after_own = replace(prior, state=x, covariance=p)
        taken, others = fusion.fuse(after_own, replace(beside, shared=others), pick(trusts, shared))
        for one in taken:
            x, p = one.state, one.covariance
            if self.biases:
                gain = self.biases.by_bias(one.gains, seen)
                considered = self.biases.update(considered, one.kept, gain, seen)
        others = fusion.remember(others, reported(p, considered))
        return x, p, memory, replace(beside, considered=considered, shared=others)
