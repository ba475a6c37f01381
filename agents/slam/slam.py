"""Cooperative simultaneous localization and mapping: UAVs among landmarks that nobody knows."""

from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float32, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.errors import NotServed
from agents.kalman.filter import elapsed, gaussian_estimate
from agents.localizer import Estimate, Localizer
from agents.models.measurements import (
    MODELS,
    LandmarkVectors,
    Neighbours,
    make_measurements,
    received,
)
from agents.models.process import make_process
from agents.models.update import posterior
from agents.robust import SoftName
from agents.slam.joint import Joint, information
from agents.slam.maps import first_seen, others_maps, uniform
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed
from coloc_env.sensors import Sensor, UnmappedLandmarks

Maps = Literal["shared", "own"]


class MapBelief(TensorClass):
    """Each UAV's state, its map (m), its rows and the map's of the joint covariance, steps taken,
    which landmarks are on the map, and what it sent of its map last, the newest last; batch
    (B, N)."""

    state: Float64[Tensor, "B N S"]
    landmarks: Float64[Tensor, "B N L d"]
    covariance: Float64[Tensor, "B N R M"]
    step: Int64[Tensor, "B N"]
    found: Bool[Tensor, "B N L"]
    sent: Float64[Tensor, "B N A K"]


class Slam(Localizer[MapBelief]):
    """EKF-SLAM (Smith, Self & Cheeseman 1990; Durrant-Whyte & Bailey 2006): each UAV has a filter
    of its own state and of landmarks that can be told apart, in the frame of the UAVs' priors.
    Landmarks start uniform in the arena; each update is a Gauss–Newton one of ``iterations``, about
    where landmarks were seen.

    ``maps=shared``: a UAV's filter uses its own sensors alone, without ranges between UAVs, and it
    sends the mean and covariance of its map; what it receives is added to its estimate, and never
    sent on or kept, so that nothing counts twice (DDF-SAM, Cunningham, Paluri & Dellaert 2010). As
    maps are about what stands still, those that come late are as good; what all of them start from
    is taken off. ``own``: maps stay where they are, and ranges to where neighbours say they are
    join the filter, as ``ekf`` has them.

    ``robust``: Huber's weights on all that is measured, or those of Student's t or of a mixture.
    """

    name = "slam"
    serves: ClassVar[tuple[type[Sensor], ...] | None] = (*MODELS, UnmappedLandmarks)

    def __init__(
        self,
        believed: Believed,
        *,
        maps: Maps = "shared",
        iterations: PositiveCount = 3,
        robust: SoftName = "none",
    ) -> None:
        super().__init__(believed)
        sensor = believed.sensor(UnmappedLandmarks)
        if sensor is None:
            raise NotServed("the team has no landmarks to map (landmarks_known=false)")
        self.process = make_process(believed)
        if self.process.attitude_error is None:
            raise NotServed("landmarks are in the body frame: the motion model has no attitude")
        self.vectors, self.count = LandmarkVectors(sensor.landmarks), sensor.landmarks.count
        self.iterations, self.robust = iterations, robust
        self.shared = maps == "shared" and not self.centralized
        if (self.shared or self.centralized) and believed.slots != believed.arena.n_uavs:
            raise NotServed("each UAV needs a slot for every other, unless maps=own")
        models = make_measurements(believed)
        self.models = [m for m in models if not (self.shared and m.cooperative)]
        self.age = 1 + believed.message_delay

    @property
    def exchanges(self) -> bool:
        return self.shared or self.centralized

    def reset(self, observation: Observation) -> MapBelief:
        x, own = self.process.initial(observation["prior"].double())
        (b, n, _), e, d = x.shape, self.process.error_size, self.process.dim
        middle, unknown = uniform(self.believed.arena, self.count, x)
        landmarks = middle.view(self.count, d).expand(b, n, -1, -1)
        size = self.count * d
        width = (n if self.centralized else 1) * e + size
        covariance = x.new_zeros(b, n, e + size, width)
        for i in range(n):
            first = i * e if self.centralized else 0
            covariance[:, i, :e, first : first + e] = own[:, i]
        covariance[..., e:, -size:] = unknown.diag()
        sent = size + size**2 if self.shared else 0
        return MapBelief(
            state=x,
            landmarks=landmarks.clone(),
            covariance=covariance,
            step=torch.zeros(b, n, dtype=torch.int64, device=x.device),
            found=torch.zeros(b, n, self.count, dtype=torch.bool, device=x.device),
            sent=x.new_full((b, n, self.age, sent), torch.nan),
            batch_size=(b, n),
        )

    def step(self, belief: MapBelief, observation: Observation) -> tuple[MapBelief, Estimate]:
        n = belief.state.shape[1]
        shape = (1, n) if self.centralized else (n, 1)
        dt = elapsed(self.process, belief.step).double().unflatten(1, shape)
        u = self.process.inputs(observation).expand(*belief.step.shape, -1).unflatten(1, shape)
        prior = self._joint(belief, shape).predicted(self.process, u, dt)
        after = self._updated(prior, belief.found, observation)
        e, size = self.process.error_size, self.count * self.process.dim
        x, landmarks = after.state.flatten(1, 2), after.landmarks
        poses, rest = after.covariance[..., :-size, :], after.covariance[..., -size:, :]
        rows = poses.unflatten(2, (-1, e)).flatten(1, 2)  # [B, N, E, M]
        each = n // shape[0]
        rest = rest.repeat_interleave(each, 1)
        seen = self.vectors.read(observation, self.process.dim)[1]
        if self.centralized:
            seen = seen.any(1, keepdim=True).expand_as(seen)
        state, own = x, self._own(rows)
        sent = belief.sent
        if self.shared:
            message = torch.cat((landmarks.flatten(-2), after.mapped.flatten(-2)), -1)
            state, own = self._fused(after, belief.sent[:, :, 0], observation)
            sent = torch.cat((sent[:, :, 1:], message.unsqueeze(2)), 2)
        belief = build(
            MapBelief,
            belief.step.shape,
            state=x,
            landmarks=landmarks.repeat_interleave(each, 1),
            covariance=torch.cat((rows, rest), 2),
            step=belief.step + 1,
            found=belief.found | seen,
            sent=sent,
        )
        return belief, gaussian_estimate(self.process, state, own)

    def mean(self, belief: MapBelief) -> Float64[Tensor, "B N S"]:
        return belief.state

    def diagnostics(self, belief: MapBelief) -> dict[str, Float32[Tensor, "B N"]]:
        return {"mapped": belief.found.float().sum(-1)}

    # ---------------------------------------------------------------- parts

    def _joint(self, belief: MapBelief, shape: tuple[int, int]) -> Joint:
        e = self.process.error_size
        rows = belief.covariance.unflatten(1, shape)
        poses, rest = rows[..., :e, :].flatten(2, 3), rows[:, :, 0, e:]
        return Joint(
            belief.state.unflatten(1, shape),
            belief.landmarks.unflatten(1, shape)[:, :, 0],
            torch.cat((poses, rest), 2),
        )

    def _own(self, rows: Float64[Tensor, "B N E M"]) -> Float64[Tensor, "B N E E"]:
        """Each UAV's own block of its rows."""
        n, e = rows.shape[1:3]
        if not self.centralized:
            return rows[..., :e]
        split = rows[..., : n * e].unflatten(-1, (n, e))
        return split.diagonal(dim1=1, dim2=3).movedim(-1, 1)

    def _updated(
        self, prior: Joint, found: Bool[Tensor, "B N L"], observation: Observation
    ) -> Joint:
        """Gauss–Newton from the prior, from where landmarks that are new were seen."""
        shape = (prior.state.shape[1], prior.state.shape[2])
        delta = self._first_guess(prior, found, observation)
        covariance = prior.covariance
        for _ in range(self.iterations):
            at = prior.moved(self.process, delta)
            x = at.state.flatten(1, 2)
            neighbours = self._neighbours(x, observation)
            blocks = [m.linearize(self.process, x, observation, neighbours) for m in self.models]
            each = at.landmarks.repeat_interleave(shape[1], 1)
            mapped = Observation({**observation.leaves, "landmark_map": each.flatten(-2)})
            seen = self.vectors.linearize(self.process, x, mapped, neighbours)
            precision, vector = information(blocks, seen, shape, self.robust)
            vector = vector + (precision @ delta.unsqueeze(-1))[..., 0]
            delta, covariance = posterior(prior.covariance, precision, vector)
        after = prior.moved(self.process, delta)
        return Joint(after.state, after.landmarks, covariance)

    def _first_guess(
        self, prior: Joint, found: Bool[Tensor, "B N L"], observation: Observation
    ) -> Float64[Tensor, "B G M"]:
        """Errors δ that put landmarks seen for the first time where they are seen, p + R z on the
        average; 0 for all else."""
        z, seen = self.vectors.read(observation, self.process.dim)
        x = prior.state.flatten(1, 2)
        moved = first_seen(self.process, x, z, seen & ~found, prior.landmarks) - prior.landmarks
        delta = prior.covariance.new_zeros(prior.covariance.shape[:-1])
        delta[..., -moved[0, 0].numel() :] = moved.flatten(-2)
        return delta

    def _neighbours(self, x: Float64[Tensor, "B N S"], observation: Observation) -> Neighbours:
        if not self.centralized:
            return received(self.believed, observation)
        b, n, d = *x.shape[:2], self.process.dim
        place = x[:, None, :, :d].expand(b, n, n, d)
        return Neighbours(place, torch.zeros_like(place), torch.ones_like(place[..., 0]) > 0)

    def _fused(
        self, own: Joint, sent: Float64[Tensor, "B N K"], observation: Observation
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """A UAV's state with the maps that have arrived."""
        size, e = self.count * self.process.dim, self.process.error_size
        heard = (observation["message_mask"] > 0) & sent.isfinite().all(-1).unsqueeze(1)
        mean = torch.where(sent.isfinite(), sent, 0.0)[..., :size]
        start = uniform(self.believed.arena, self.count, mean)
        spread = sent[..., size:].unflatten(-1, (size, size))
        spread = torch.where(spread.isfinite(), spread, start[1].diag())
        precision = torch.linalg.inv(spread)
        added, eta = others_maps(start, mean, precision, heard, own.landmarks.flatten(-2))
        whole = torch.zeros_like(own.covariance)
        whole[..., e:, e:] = added
        delta, covariance = posterior(own.covariance, whole, torch.nn.functional.pad(eta, (e, 0)))
        after = own.moved(self.process, delta)
        return after.state.flatten(1, 2), covariance[..., :e, :e]
