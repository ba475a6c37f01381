"""Distributed factor-graph optimization: a fixed-lag smoother for each UAV, tied to its neighbours'
by condensed graphs (DDF-SAM, Cunningham, Paluri & Dellaert 2010)."""

from typing import Annotated, Any, Literal

import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from agents.association import AssociationName, associated
from agents.factor_graph.belief import SmootherBelief
from agents.factor_graph.chain import Chain, Smoothed, smooth
from agents.factor_graph.condensed import Common, Tracks, arrived, condensed, tie
from agents.factor_graph.mapped import MappedFactorGraph
from agents.kalman.filter import elapsed, gaussian_estimate
from agents.localizer import Estimate, Localizer
from agents.models.measurements import (
    Block,
    Neighbours,
    make_measurements,
    received,
)
from agents.models.process import make_process
from agents.models.update import information
from agents.robust import Prediction, SoftName, Trust, soft_trust
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.options import PositiveCount, Quantity
from coloc_env.scenario import Believed
from coloc_env.sensors import UnmappedLandmarks
from coloc_env.sensors.base import Layout

_GATE = 0.999  # of a landmark's pairing
Exchange = Literal["local", "all", "none"]


class DistributedFactorGraph(Localizer[SmootherBelief]):
    """Fixed-lag smoother of each UAV over its last ``window`` steps, as a MAP estimate by
    Gauss–Newton (``iterations`` a step, from the last step's solution): IMU (or whatever the motion
    model is driven by) between steps, landmarks, anchors and ranges by Huber's loss or (``robust``)
    squares, or the likelihood of Student's t or of a mixture with wide tails. Older steps are
    marginalized out.

    ``exchange=local``: a UAV sends the marginal of its window's positions from its own sensors
    alone, and ties its window to those it receives by the ranges in it; nothing counts twice.
    ``all``: ranges to neighbours' estimates as they come join the window, so that what UAVs have in
    common counts again and again. ``none``: no ranges.

    Landmarks that nobody knows (``landmarks_known=false``) are variables of the graph: see
    ``MappedFactorGraph``. Those that come without names get them once, by the prediction of the
    newest state, within their 99.9 % gate (``association`` as ``ekf`` has it).
    """

    name = "dfgo"
    associates = True

    def __init__(
        self,
        believed: Believed,
        *,
        window: Annotated[int, Quantity("steps", 2, 200)] = 20,
        iterations: PositiveCount = 2,
        robust: SoftName = "huber",
        exchange: Exchange = "local",
        association: AssociationName = "joint",
    ) -> None:
        super().__init__(believed)
        self.size, self.iterations = window, iterations
        self.robust, self.exchange = robust, exchange
        self.process = make_process(believed)
        models = make_measurements(believed)
        self.own = [m for m in models if not m.cooperative or exchange == "all"]
        self.shared = [m for m in models if m.cooperative and exchange == "local"]
        layout = Layout(believed.arena, believed.slots)
        self.leaves = [name for s in believed.sensors for name in s.leaves(layout)]
        self.association = associated(believed, self.process, association, _GATE)
        if self.association is not None:
            self.leaves += ["landmarks", "landmark_mask"]
        self.age = 1 + believed.message_delay

    @classmethod
    def for_team(cls, believed: Believed, **options: Any) -> Localizer[Any]:
        """The smoother; among landmarks that nobody knows, the one that has them in its graph."""
        graph, unmapped = cls(believed, **options), believed.sensor(UnmappedLandmarks)
        return graph if unmapped is None else MappedFactorGraph(graph, unmapped)

    @classmethod
    def ignores(cls, believed: Believed) -> list[str]:
        return [n for n in super().ignores(believed) if n != UnmappedLandmarks.__name__]

    @property
    def exchanges(self) -> bool:
        return bool(self.shared)

    def reset(self, observation: Observation) -> SmootherBelief:
        x, covariance = self.process.initial(observation["prior"].double())
        spread = self._spread(covariance)
        if self.association is not None:
            observation = self.association.unseen(observation)
        b, n, w, d = *x.shape[:2], self.size, self.process.dim
        states = x.unsqueeze(2).expand(-1, -1, w, -1).clone()
        width = self._row(observation).shape[-1]
        heard = (2 * d + 1) * self._slots(observation)
        sent = w * d + (w * d) ** 2 if self.shared else 0
        return SmootherBelief(
            states=states,
            window=observation["prior"].new_zeros(b, n, w, width),
            heard=x.new_zeros(b, n, w, heard),
            prior=x,
            prior_covariance=covariance,
            step=torch.zeros(b, n, dtype=torch.int64, device=x.device),
            sent=x.new_full((b, n, self.age, sent), torch.nan),
            spread=spread,
            batch_size=(b, n),
        )

    def step(
        self, belief: SmootherBelief, observation: Observation
    ) -> tuple[SmootherBelief, Estimate]:
        process, step = self.process, belief.step
        observation = self._named(belief, observation)
        x, window, heard, leaves = self.entered(belief, observation)
        for _ in range(self.iterations):
            at, found = x, self._solved(x, belief, leaves, heard)
            x = process.boxplus(x, found.mean)
        prior = process.boxplus(at[:, :, 1], found.next_mean)
        state, covariance = x[:, :, -1], found.covariance[..., -1, :, :]
        sent = belief.sent
        if self.shared:
            joint = found.joint()
            message = condensed(x[..., : process.dim], joint)
            state, covariance = self._tied(x, joint, belief, leaves, observation)
            sent = torch.cat((sent[:, :, 1:], message.unsqueeze(2)), 2)
        after = build(
            SmootherBelief,
            step.shape,
            states=x,
            window=window,
            heard=heard,
            prior=prior,
            prior_covariance=found.next_covariance,
            step=step + 1,
            sent=sent,
            spread=self._spread(found.covariance[..., -1, :, :]),
        )
        return after, gaussian_estimate(process, state, covariance)

    def _spread(self, covariance: Float64[Tensor, "B N E E"]) -> Float64[Tensor, "B N E G"]:
        """What is kept of the newest state's covariance."""
        return covariance if self.association is not None else covariance[..., :0]

    def _named(self, belief: SmootherBelief, observation: Observation) -> Observation:
        """The observation with landmarks' names, by the prediction of the newest state."""
        if self.association is None:
            return observation
        process, newest = self.process, belief.states[:, :, -1]
        u, dt = process.inputs(observation), elapsed(process, belief.step).double()
        f, q = process.linearize(newest, u, dt)
        spread = f @ belief.spread @ f.mT + q
        nothing = newest[..., :0]
        prior = Prediction(process.propagate(newest, u, dt), spread, observation, nothing)
        return self.association.named(prior).observation

    # ---------------------------------------------------------------- own factors

    def entered(
        self, belief: SmootherBelief, observation: Observation
    ) -> tuple[
        Float64[Tensor, "B N W S"],
        Float32[Tensor, "B N W F"],
        Float64[Tensor, "B N W H"],
        Observation,
    ]:
        """The window a step later: its states, the newest one predicted, what was sensed and heard
        in it, and that as leaves."""
        process = self.process
        row = self._row(observation).unsqueeze(2)
        window = torch.cat((belief.window[:, :, 1:], row), 2)
        heard = torch.cat((belief.heard[:, :, 1:], self._heard(observation)), 2)
        dt = elapsed(process, belief.step).double()
        newest = process.propagate(belief.states[:, :, -1], process.inputs(observation), dt)
        x = torch.cat((belief.states[:, :, 1:], newest.unsqueeze(2)), 2)
        return x, window, heard, self._leaves(window, observation)

    def _solved(
        self,
        x: Float64[Tensor, "B N W S"],
        belief: SmootherBelief,
        leaves: Observation,
        heard: Float64[Tensor, "B N W H"],
    ) -> Smoothed:
        """The window's graph, linearized about its states and solved."""
        return smooth(self.linearized(x, belief, leaves, heard))

    def linearized(
        self,
        x: Float64[Tensor, "B N W S"],
        belief: SmootherBelief,
        leaves: Observation,
        heard: Float64[Tensor, "B N W H"],
    ) -> Chain:
        """The window's graph about its states."""
        blocks = [m.linearize(self.process, x, leaves, self._neighbours(heard)) for m in self.own]
        e = self.process.error_size
        precision, vector = x.new_zeros(*x.shape[:3], e, e), x.new_zeros(*x.shape[:3], e)
        if blocks:
            precision, vector = information(blocks, [self.trust(block) for block in blocks])
        motion = self._steps(x, belief, leaves)
        return Chain(motion[0], belief.prior_covariance, *motion[1:], precision, vector)

    def _steps(
        self, x: Float64[Tensor, "B N W S"], belief: SmootherBelief, leaves: Observation
    ) -> tuple[
        Float64[Tensor, "B N E"],
        Float64[Tensor, "B N W-1 E E"],
        Float64[Tensor, "B N W-1 E"],
        Float64[Tensor, "B N W-1 E E"],
    ]:
        """The prior's mean, and F, d and Q between the window's states, about them."""
        process = self.process
        u = process.inputs(leaves).expand(*x.shape[:3], -1)[:, :, 1:]
        last = torch.arange(2 - self.size, 1, device=x.device)
        dt = elapsed(process, belief.step.unsqueeze(-1) + last).double()
        f, q = process.linearize(x[:, :, :-1], u, dt)
        ahead = process.boxminus(process.propagate(x[:, :, :-1], u, dt), x[:, :, 1:])
        return process.boxminus(belief.prior, x[:, :, 0]), f, ahead, q

    def trust(self, block: Block) -> Trust:
        return soft_trust(self.robust, block)

    def _kept(self, observation: Observation) -> list[str]:
        """Leaves that are kept with a step."""
        return self.leaves + (["neighbours"] if "neighbours" in observation else [])

    def _row(self, observation: Observation) -> Float32[Tensor, "B N F"]:
        """What a step leaves in the window."""
        return torch.cat([observation[name].float() for name in self._kept(observation)], -1)

    def _leaves(self, window: Float32[Tensor, "B N W F"], observation: Observation) -> Observation:
        """The window's leaves [B, N, W, F]; those that no sensor writes as they are now."""
        kept = self._kept(observation)
        widths = [observation[name].shape[-1] for name in kept]
        sensed = dict(zip(kept, window.split(widths, -1), strict=True))
        still = {k: v.unsqueeze(2) for k, v in observation.leaves.items() if k not in sensed}
        return Observation(still | sensed)

    def _slots(self, observation: Observation) -> int:
        """Slots of neighbours that count in the window itself."""
        return observation["message_mask"].shape[-1] if self._hears else 0

    @property
    def _hears(self) -> bool:
        return any(m.cooperative for m in self.own)

    def _heard(self, observation: Observation) -> Float64[Tensor, "B N 1 H"]:
        """Where neighbours said they were, to be kept with the step."""
        if not self._hears:
            return observation["prior"].double()[:, :, None, :0]
        found = received(self.believed, observation)
        known = found.known.double().unsqueeze(-1)
        return torch.cat((found.position, found.variance, known), -1).flatten(-2).unsqueeze(2)

    def _neighbours(self, heard: Float64[Tensor, "B N W H"]) -> Neighbours:
        d = self.process.dim
        apart = heard.unflatten(-1, (-1, 2 * d + 1))
        return Neighbours(apart[..., :d], apart[..., d : 2 * d], apart[..., -1] > 0)

    # ---------------------------------------------------------------- neighbours' condensed graphs

    def _tied(
        self,
        x: Float64[Tensor, "B N W S"],
        joint: Float64[Tensor, "B N W W E E"],
        belief: SmootherBelief,
        leaves: Observation,
        observation: Observation,
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """The newest state and its covariance with the ranges of the window."""
        w, d = self.size, self.process.dim
        tracks = arrived(belief.sent[:, :, 0], observation, w, d, self.age)
        known = tracks.known.transpose(2, 3)
        if "neighbours" in observation:  # a slot may have been another UAV's
            known = known & (leaves["neighbours"] == observation["neighbours"].unsqueeze(2))
        return self.tied_to(x, joint, tracks, tracks.position, known, leaves)

    def tied_to(
        self,
        x: Float64[Tensor, "B N W S"],
        joint: Float64[Tensor, "B N W W E E"],
        tracks: Tracks,
        position: Float64[Tensor, "B N S W d"],
        known: Bool[Tensor, "B N W S"],
        leaves: Observation,
        common: Common | None = None,
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """The newest state and its covariance with the window's ranges to neighbours on their
        ``tracks``, which are at ``position`` (m)."""
        place = position.transpose(2, 3)
        neighbours = Neighbours(place, torch.zeros_like(place), known)

        def linearize(delta: Tensor) -> list[Block]:
            at = self.process.boxplus(x, delta)
            return [m.linearize(self.process, at, leaves, neighbours) for m in self.shared]

        found = tie(joint, tracks, linearize, self.robust, common=common)
        return self.process.boxplus(x[:, :, -1], found.delta[:, :, -1]), found.covariance
