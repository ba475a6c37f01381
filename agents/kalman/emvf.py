"""Extended minimum-variance FIR filter: an estimate from the last few steps and from nothing else.

NN-HPFF paper, section 3, as a batch weighted least-squares problem over the window [m, k]. What
happened before the window is forgotten, and so is any failure.
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float32, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.dead_reckoning import DeadReckoning
from agents.kalman.filter import GaussianBelief, elapsed, gaussian_estimate
from agents.localizer import Estimate, Localizer
from agents.models.measurements import (
    AnchorRanges,
    Block,
    RangeDifferences,
    make_measurements,
    model_of,
    no_neighbours,
)
from agents.models.process import Process
from agents.robust import SoftName, widened
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.options import PositiveCount, Quantity
from coloc_env.scenario import Believed
from coloc_env.sensors import AnchorRanging, Tdoa
from coloc_env.sensors.base import Layout

_NOTHING = 1e-6  # m⁻², s²/m²: information on position and velocity before anything is measured
_FLAT = 1e-6  # of anchors' spread: no extent at all
_BESIDE = 0.1  # of the room's extent on one side of the anchors' plane: nothing on the other
_RIDGE = 1e-3  # m⁻²: what keeps a trilateration near the arena's centre where it is ambiguous


class WindowBelief(TensorClass):
    """What was measured in the last M steps, the newest last (zeros before the first), steps taken,
    and dead reckoning of what a short window does not observe (attitude, biases); batch (B, N)."""

    window: Float32[Tensor, "B N M F"]
    step: Int64[Tensor, "B N"]
    reckoned: GaussianBelief


@dataclass(frozen=True)
class _Window:
    """A window taken apart: leaves [B, N, M, F], the M − 1 inputs between its steps and their
    lengths (s; 0 before the first step)."""

    leaves: Observation
    inputs: Float64[Tensor, "B N L U"]
    dt: Float64[Tensor, "B N L"]


class MinimumVarianceFir(Localizer[WindowBelief]):
    """FIR filter over the last ``memory`` steps, Gauss–Newton from a trilateration.

    With Z = H̄ x_k + Ḡ w + v stacked over the window and Ξ = Ḡ Q̄ Ḡᵀ + R̄:
    x̂ = (H̄ᵀ Ξ⁻¹ H̄)⁻¹ H̄ᵀ Ξ⁻¹ Z and P = (H̄ᵀ Ξ⁻¹ H̄)⁻¹, h linearized ``iterations`` times. It uses
    what the UAV measures itself and needs no prior but, where the motion model has an attitude (and
    biases), their dead reckoning. Where the window does not observe the state, P is large.
    ``robust`` widens the variance of what is far from the iterate it is linearized about: as Huber,
    Student's t or a mixture with wide tails have it.
    """

    name = "emvf"

    def __init__(
        self,
        believed: Believed,
        *,
        memory: Annotated[int, Quantity("steps", 2, 1000)] = 3,
        iterations: PositiveCount = 4,
        robust: SoftName = "none",
    ) -> None:
        super().__init__(believed)
        self.size, self.iterations, self.robust = memory, iterations, robust
        self.reckoning = DeadReckoning(believed)
        self.process: Process = self.reckoning.process
        self.models = [m for m in make_measurements(believed) if not m.cooperative]
        if not self.models:
            raise NotServed("the team measures nothing of its own to estimate from")
        layout = Layout(believed.arena, believed.slots)
        self.leaves = [name for s in believed.sensors for name in s.leaves(layout)]
        anchors, dim = believed.sensor(AnchorRanging), believed.arena.dim
        self.normal = _normal(anchors, dim)
        for kind, sensor in ((AnchorRanges, anchors), (RangeDifferences, believed.sensor(Tdoa))):
            if sensor is not None and all(isinstance(m, kind) for m in self.models):
                self._require_one_side(sensor)

    def _require_one_side(self, sensor: AnchorRanging | Tdoa) -> None:
        """ValueError if all anchors lie in a plane, and the room on both sides of it."""
        arena = self.believed.arena
        normal = _normal(sensor, arena.dim)
        if normal is None:
            return
        corners = torch.cartesian_prod(*torch.tensor((arena.low, arena.high)).double().T)
        side = (corners - torch.tensor(sensor.anchors[0])) @ normal
        low, high = -float(side.min()), float(side.max())
        if min(low, high) > _BESIDE * max(low, high):
            flat = "plane" if arena.dim == 3 else "line"
            raise NotServed(
                f"all {len(sensor.anchors)} anchors lie in one {flat} through the room: ranges to "
                "them alone do not say on which side of it a UAV is; add anchors beside it, "
                "landmarks, or choose ekf or pf500, which have a prior"
            )

    @classmethod
    def ignores(cls, believed: Believed) -> list[str]:
        """What is measured between UAVs too, where that is all there is to estimate from."""
        sensors = [s for s in believed.sensors if model_of(type(s)) is not None]
        alone = sensors and all(sensor.between_uavs for sensor in sensors)
        between = [type(sensor).__name__ for sensor in sensors] if alone else []
        return super().ignores(believed) + between

    def reset(self, observation: Observation) -> WindowBelief:
        width = self._row(observation).shape[-1]
        prior = observation["prior"]
        step = torch.zeros(prior.shape[:2], dtype=torch.int64, device=prior.device)
        return WindowBelief(
            window=prior.new_zeros(*step.shape, self.size, width),
            step=step,
            reckoned=self.reckoning.reset(observation),
            batch_size=step.shape,
        )

    def advance(self, belief: WindowBelief, observation: Observation) -> WindowBelief:
        row = self._row(observation).unsqueeze(-2)
        reckoned = belief.reckoned
        if self.process.attitude_size:
            reckoned = self.reckoning.advance(reckoned, observation)
        return build(
            WindowBelief,
            belief.step.shape,
            window=torch.cat((belief.window[..., 1:, :], row), -2),
            step=belief.step + 1,
            reckoned=reckoned,
        )

    def step(self, belief: WindowBelief, observation: Observation) -> tuple[WindowBelief, Estimate]:
        after = self.advance(belief, observation)
        return after, gaussian_estimate(self.process, *self.gaussian(after, observation))

    def gaussian(
        self, belief: WindowBelief, observation: Observation
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        window, d = self._apart(belief, observation), self.process.dim
        arena = self.believed.arena
        reckoned = belief.reckoned
        x = reckoned.state.clone()
        x[..., :d], x[..., d : 2 * d] = self._trilaterated(window.leaves), 0.0
        known = self._reckoned_information(reckoned)
        covariance = torch.zeros_like(known)
        low, high = (x.new_tensor(end) for end in (arena.low, arena.high))
        for iteration in range(self.iterations):
            if iteration:  # a step too far is taken back to where a UAV can be
                x = torch.cat((x[..., :d].clamp(low, high), x[..., d:]), -1)
            h, r, noise = self._stacked(x, window)
            root = torch.linalg.cholesky_ex(noise).L
            whitened = torch.linalg.solve_triangular(
                root, torch.cat((h, r.unsqueeze(-1)), -1), upper=False
            )
            h, r = whitened[..., :-1], whitened[..., -1:]
            ahead = self.process.boxminus(reckoned.state, x)
            precision = h.mT @ h + known
            covariance = torch.linalg.inv(precision)
            covariance = 0.5 * (covariance + covariance.mT)
            delta = covariance @ (h.mT @ r + known @ ahead.unsqueeze(-1))
            x = self.process.boxplus(x, delta[..., 0])
        return x, covariance

    def _row(self, observation: Observation) -> Float32[Tensor, "B N F"]:
        """What a step leaves in the window."""
        return torch.cat([observation[name] for name in self.leaves], -1)

    def _apart(self, belief: WindowBelief, observation: Observation) -> _Window:
        widths = [observation[name].shape[-1] for name in self.leaves]
        sensed = dict(zip(self.leaves, belief.window.split(widths, -1), strict=True))
        still = {
            name: leaf.unsqueeze(2)
            for name, leaf in observation.leaves.items()
            if name not in sensed
        }
        leaves = Observation(still | sensed)
        last = torch.arange(1 - self.size, 0, device=belief.step.device)
        taken = belief.step.unsqueeze(-1) + last  # steps taken before each of the window's last
        dt = elapsed(self.process, taken).double()
        inputs = self.process.inputs(leaves).expand(*belief.window.shape[:-1], -1)
        return _Window(leaves, inputs[..., 1:, :], dt)

    def _reckoned_information(self, reckoned: GaussianBelief) -> Float64[Tensor, "B N E E"]:
        """All that is known beside the window: attitude and biases."""
        turn, e = self.process.attitude_error, self.process.error_size
        first = e if turn is None else turn.start
        known = torch.zeros_like(reckoned.covariance)
        known.diagonal(dim1=-2, dim2=-1)[..., :first] = _NOTHING
        if first < e:
            known[..., first:, first:] = torch.linalg.inv(reckoned.covariance[..., first:, first:])
        return known

    def _stacked(
        self, x: Float64[Tensor, "B N S"], window: _Window
    ) -> tuple[Float64[Tensor, "B N Z E"], Float64[Tensor, "B N Z"], Float64[Tensor, "B N Z Z"]]:
        """H̄, the residuals of Z, and Ξ, linearized about the states that lead to ``x``."""
        states = [x]
        for u, dt in zip(
            reversed(window.inputs.unbind(-2)), reversed(window.dt.unbind(-1)), strict=True
        ):
            states.insert(0, self.process.retreat(states[0], u, dt))
        path = torch.stack(states, -2)
        f, q = self.process.linearize(path[..., :-1, :], window.inputs, window.dt)
        back, size = torch.linalg.inv(f), f.shape[-1]
        steps = self.size - 1
        # δ_j = Φ_j δ_k − A_j w: Φ and A from the window's end backwards, w the noise of its steps.
        phi = torch.eye(size, dtype=x.dtype, device=x.device).expand_as(f[..., 0, :, :])
        lag = x.new_zeros(*phi.shape[:-1], steps * size)
        phis, lags = [phi], [lag]
        for j in range(steps - 1, -1, -1):
            lag = lag.clone()
            lag[..., j * size : (j + 1) * size] += torch.eye(size, dtype=x.dtype, device=x.device)
            phi, lag = back[..., j, :, :] @ phi, back[..., j, :, :] @ lag
            phis.insert(0, phi)
            lags.insert(0, lag)
        jacobian, residual, variance = self._measured(path, window.leaves)
        h = (jacobian @ torch.stack(phis, -3)).flatten(-3, -2)
        g = (jacobian @ torch.stack(lags, -3)).flatten(-3, -2).unflatten(-1, (steps, size))
        spread = (g.unsqueeze(-2) @ q.unsqueeze(-4)).flatten(-3)
        xi = spread @ g.flatten(-2).mT + torch.diag_embed(variance.flatten(-2))
        return h, residual.flatten(-2), xi

    def _measured(
        self, path: Float64[Tensor, "B N M S"], leaves: Observation
    ) -> tuple[
        Float64[Tensor, "B N M R E"], Float64[Tensor, "B N M R"], Float64[Tensor, "B N M R"]
    ]:
        """Each step's own rows: ∂h/∂δ, residuals and variances; a row of zeros with variance 1
        where nothing was measured."""
        alone = no_neighbours(path[..., : self.process.dim])
        rows = [self._rows(m.linearize(self.process, path, leaves, alone)) for m in self.models]
        jacobian, residual, variance = (torch.cat(parts, 3) for parts in zip(*rows, strict=True))
        return jacobian, residual, variance

    def _rows(self, block: Block) -> tuple[Tensor, Tensor, Tensor]:
        there, variance = block.mask.unsqueeze(-1), widened(self.robust, block)
        residual = torch.where(there, block.residual, 0.0).flatten(-2)
        variance = torch.where(there, variance, 1.0).flatten(-2)
        jacobian = torch.where(there.unsqueeze(-1), block.jacobian, 0.0).flatten(-3, -2)
        return jacobian, residual, variance

    def _trilaterated(self, leaves: Observation) -> Float64[Tensor, "B N d"]:
        """Where all ranges of the window, taken as of one place, meet: z² = ‖p‖² − 2 a·p + ‖a‖² is
        linear in (p, ‖p‖²). With anchors in a plane, n·a = c, what is found is ‖p‖² − 2 c n·p, and
        n·p is that root which is on the room's side. The arena's centre without anchors."""
        d, arena = self.process.dim, self.believed.arena
        centre = leaves["prior"].new_tensor(arena.centre).double()
        sensor = self.believed.sensor(AnchorRanging)
        if sensor is None:
            return centre.expand(*leaves["prior"].shape[:2], d)
        anchors = leaves["anchor_map"].double().unflatten(-1, (-1, d)) - centre
        z, mask = AnchorRanges(sensor).read(leaves)
        ranges = z.double().unflatten(-1, (-1, anchors.shape[-2]))
        there = mask.double().unflatten(-1, ranges.shape[-2:])
        ones = torch.ones_like(anchors[..., :1])
        design = torch.cat((-2 * anchors, ones), -1).unsqueeze(-3)
        design = (design * there.unsqueeze(-1)).flatten(2, 4)
        target = ((ranges.square() - anchors.square().sum(-1).unsqueeze(-2)) * there).flatten(2)
        ridge = torch.full_like(design[..., 0, :], _RIDGE)
        ridge[..., -1] = _RIDGE**2
        normal = design.mT @ design + torch.diag_embed(ridge)
        found = torch.linalg.solve(normal, (design.mT @ target.unsqueeze(-1))[..., 0])
        place = found[..., :d]
        if self.normal is not None:
            n = self.normal.to(place)
            c = (anchors[..., 0, :] @ n).flatten(2)[..., 0]
            place = place - (place @ n).unsqueeze(-1) * n
            q = found[..., d] - place.square().sum(-1)  # t² − 2 c t, t = n·p
            t = c - c.sign() * (c.square() + q).clamp_min(0.0).sqrt()
            place = place + t.unsqueeze(-1) * n
        return centre + place


def _normal(sensor: AnchorRanging | Tdoa | None, dim: int) -> Float64[Tensor, "d"] | None:
    """Unit normal of the plane (in the plane: line) that all anchors lie in; None if none does."""
    if sensor is None or len(sensor.anchors) < dim:
        return None
    places = torch.tensor(sensor.anchors, dtype=torch.float64)
    _, spread, axes = torch.linalg.svd(places - places.mean(0))
    return axes[-1] if spread[-1] <= _FLAT * spread[0] else None
