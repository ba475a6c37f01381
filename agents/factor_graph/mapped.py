"""Smoothers whose graphs hold the landmarks, too: cooperative SLAM by factor graphs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from jaxtyping import Bool, Float32, Float64
from tensordict import TensorClass
from torch import Tensor

from agents.errors import NotServed
from agents.factor_graph.belief import SmootherBelief
from agents.factor_graph.bordered import Bordered, Shared, Solved, solve
from agents.factor_graph.chain import block_diagonal, diagonal_blocks
from agents.factor_graph.condensed import Common, arrived, condensed
from agents.kalman.filter import gaussian_estimate
from agents.localizer import Estimate, Localizer
from agents.models.measurements import Block, LandmarkVectors, no_neighbours
from agents.slam.maps import first_seen, others_maps, uniform
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.sensors import UnmappedLandmarks

if TYPE_CHECKING:
    from agents.factor_graph.dfgo import DistributedFactorGraph


class MappedBelief(TensorClass):
    """The window (``track``; ``prior_covariance`` there is that given the map), the map (m) as it
    is and as it is known from before the window (``before``, information ``precision``), what the
    window's prior depends on it (``slope``), and which landmarks were seen; batch (B, N)."""

    track: SmootherBelief
    landmarks: Float64[Tensor, "B N L d"]
    before: Float64[Tensor, "B N L d"]
    precision: Float64[Tensor, "B N M M"]
    slope: Float64[Tensor, "B N E M"]
    found: Bool[Tensor, "B N L"]


class MappedFactorGraph(Localizer[MappedBelief]):
    """``dfgo`` or ``dfgo_central`` (the ``graph``) among landmarks whose places nobody knows: these
    are variables of the graph from when they are first seen, uniform in the arena before.

    They border the chain of states (see ``bordered``), and their factors are marginalized out with
    the states that leave the window. With ``exchange=local`` a UAV sends what its own graph says of
    the map, its common start taken off, and of its track given the map (DDF-SAM's condensed graph):
    maps add up, and the ranges of the window tie the tracks. Nothing received is sent on or kept.
    """

    def __init__(self, graph: DistributedFactorGraph, sensor: UnmappedLandmarks) -> None:
        super().__init__(graph.believed)
        self.name, self.centralized = graph.name, graph.centralized  # type: ignore[misc]
        self.graph, self.process = graph, graph.process
        if self.process.attitude_error is None:
            raise NotServed("landmarks are in the body frame: the motion model has no attitude")
        self.shared = graph.exchange == "local" and not graph.centralized
        if self.shared and self.believed.slots != self.believed.arena.n_uavs:
            raise NotServed("each UAV needs a slot for every other to share maps (exchange=local)")
        self.vectors, self.count = LandmarkVectors(sensor.landmarks), sensor.landmarks.count
        self.size = self.count * self.process.dim

    @property
    def exchanges(self) -> bool:
        return self.shared or self.centralized

    def reset(self, observation: Observation) -> MappedBelief:
        track = self.graph.reset(observation)
        (b, n), d, x = track.step.shape, self.process.dim, track.prior
        middle, variance = uniform(self.believed.arena, self.count, x)
        landmarks = middle.view(self.count, d).expand(b, n, -1, -1)
        each = self.graph.size * d
        sent = each + each**2 + each * self.size + self.size + self.size**2 if self.shared else 0
        return MappedBelief(
            track=track.replace(sent=x.new_full((b, n, self.graph.age, sent), torch.nan)),
            landmarks=landmarks.clone(),
            before=landmarks.clone(),
            precision=(1 / variance).diag().expand(b, n, -1, -1).clone(),
            slope=x.new_zeros(b, n, self.process.error_size, self.size),
            found=torch.zeros(b, n, self.count, dtype=torch.bool, device=x.device),
            batch_size=(b, n),
        )

    def step(self, belief: MappedBelief, observation: Observation) -> tuple[MappedBelief, Estimate]:
        process, track = self.process, belief.track
        x, window, heard, leaves = self.graph.entered(track, observation)
        place, found = self._first_seen(belief, x[:, :, -1], observation)
        for _ in range(self.graph.iterations):
            at, there = x, place
            solved = self._solved(x, place, belief, leaves, heard)
            x = process.boxplus(x, self._each(solved.states.mean))
            place = place + self._map(solved.shared.mean)
        state, covariance = x[:, :, -1], self._newest(solved)
        sent = track.sent
        if self.shared:
            message = self._message(x, place, solved)
            state, covariance = self._tied(x, place, solved, track, leaves, observation)
            sent = torch.cat((sent[:, :, 1:], message.unsqueeze(2)), 2)
        b, n = track.step.shape
        e = process.error_size
        states, onward = solved.states, solved.next
        after = build(
            SmootherBelief,
            track.step.shape,
            states=x,
            window=window,
            heard=heard,
            prior=process.boxplus(at[:, :, 1], states.next_mean.view(b, n, e)),
            prior_covariance=states.next_covariance.view(b, n, e, -1),
            step=track.step + 1,
            sent=sent,
            spread=track.spread,
        )
        whole = onward.precision.view(b, -1, self.size, self.size).expand(b, n, -1, -1)
        mapped = build(
            MappedBelief,
            track.step.shape,
            track=after,
            landmarks=place,
            before=there + self._map(onward.mean),
            precision=whole,
            slope=onward.slope.view(b, n, e, self.size),
            found=found,
        )
        return mapped, gaussian_estimate(process, state, covariance)

    def mean(self, belief: MappedBelief) -> Float64[Tensor, "B N S"]:
        return belief.track.states[:, :, -1]

    def diagnostics(self, belief: MappedBelief) -> dict[str, Float32[Tensor, "B N"]]:
        return {"mapped": belief.found.float().sum(-1)}

    # ---------------------------------------------------------------- the graph

    def _solved(
        self,
        x: Float64[Tensor, "B N W S"],
        place: Float64[Tensor, "B N L d"],
        belief: MappedBelief,
        leaves: Observation,
        heard: Float64[Tensor, "B N W H"],
    ) -> Solved:
        """The graph, linearized about the window's states and the map; of each UAV or, centralized,
        of the team."""
        chain = self.graph.linearized(x, belief.track, leaves, heard)
        seen = Observation({**leaves.leaves, "landmark_map": place.flatten(-2).unsqueeze(2)})
        nobody = no_neighbours(x[..., : self.process.dim])
        block = self.vectors.linearize(self.process, x, seen, nobody)
        precision, border, about, vector, shared = self._landmarks(block)
        off = (belief.before - place).flatten(-2)
        slope, start = belief.slope, belief.precision
        if self.centralized:
            precision = block_diagonal(precision.transpose(1, 2))
            vector, border = (v.transpose(1, 2).flatten(2, 3) for v in (vector, border))
            about, shared = about.sum(1), shared.sum(1)
            off, start, slope = off[:, 0], start[:, 0], slope.flatten(1, 2)
        prior = Shared(start, (start @ off.unsqueeze(-1))[..., 0], slope)
        chain = replace(
            chain,
            mean=chain.mean - (slope @ off.unsqueeze(-1))[..., 0],
            precision=chain.precision + precision,
            vector=chain.vector + vector,
        )
        return solve(Bordered(chain, prior, border, about, shared))

    def _landmarks(
        self, block: Block
    ) -> tuple[
        Float64[Tensor, "B N W E E"],
        Float64[Tensor, "B N W E M"],
        Float64[Tensor, "B N W M M"],
        Float64[Tensor, "B N W E"],
        Float64[Tensor, "B N W M"],
    ]:
        """Information of landmark vectors about states, between states and map, and about the map,
        and the vectors η of both. The derivative of z = Rᵀ(L − p) by L is minus that by p."""
        j, r = block.jacobian, block.residual.unsqueeze(-1)
        by_place = -j[..., : self.process.dim]
        weight = self.graph.trust(block).information(block).unsqueeze(-1)
        wj, wl = j * weight, by_place * weight
        precision = j.flatten(-3, -2).mT @ wj.flatten(-3, -2)
        border = (wj.mT @ by_place).movedim(-3, -2).flatten(-2)
        about = block_diagonal(by_place.mT @ wl)
        return precision, border, about, (wj.mT @ r).sum(-3)[..., 0], (wl.mT @ r).flatten(-3)

    def _first_seen(
        self, belief: MappedBelief, x: Float64[Tensor, "B N S"], observation: Observation
    ) -> tuple[Float64[Tensor, "B N L d"], Bool[Tensor, "B N L"]]:
        """The map, with landmarks that are seen for the first time where they are, p + R z on the
        average of those that see them; and which are on it."""
        z, seen = self.vectors.read(observation, self.process.dim)
        new, before = seen & ~belief.found, belief.landmarks
        if self.centralized:
            seen, before = seen.any(1, keepdim=True).expand_as(seen), before[:, :1]
        place = first_seen(self.process, x, z, new, before)
        return place.expand_as(belief.landmarks), belief.found | seen

    # ---------------------------------------------------------------- others' maps and tracks

    def _message(
        self, x: Float64[Tensor, "B N W S"], place: Float64[Tensor, "B N L d"], solved: Solved
    ) -> Float64[Tensor, "B N K"]:
        """Own track given the map, and the map with its information."""
        d = self.process.dim
        track = condensed(x[..., :d], solved.states.joint())
        slopes = solved.slopes[..., :d, :].flatten(2)
        precision = solved.shared.precision.flatten(-2)
        return torch.cat((track, slopes, place.flatten(-2), precision), -1)

    def _tied(
        self,
        x: Float64[Tensor, "B N W S"],
        place: Float64[Tensor, "B N L d"],
        solved: Solved,
        track: SmootherBelief,
        leaves: Observation,
        observation: Observation,
    ) -> tuple[Float64[Tensor, "B N S"], Float64[Tensor, "B N E E"]]:
        """The newest state with others' maps, then with the ranges of the window."""
        graph, process, size = self.graph, self.process, self.size
        tail = size + size**2
        sent = track.sent[:, :, 0]
        theirs = sent[..., -tail:]
        heard = (observation["message_mask"] > 0) & theirs.isfinite().all(-1).unsqueeze(1)
        theirs = torch.where(theirs.isfinite(), theirs, 0.0)
        maps, precision = theirs[..., :size], theirs[..., size:].unflatten(-1, (size, size))
        start, own = uniform(self.believed.arena, self.count, x), place.flatten(-2)
        added, eta = others_maps(start, maps, precision, heard, own)
        spread = torch.linalg.inv(solved.shared.precision + added)
        shift = (spread @ eta.unsqueeze(-1))[..., 0]
        x = process.boxplus(x, (solved.slopes @ shift[:, :, None, :, None])[..., 0])
        common = Common(solved.slopes, spread)
        d = process.dim
        tracks = arrived(sent[..., :-tail], observation, graph.size, d, graph.age, size)
        off = ((own + shift).unsqueeze(2) - maps.unsqueeze(1)).unsqueeze(3)  # of the map, from j's
        where = tracks.position + (tracks.slope @ off.unsqueeze(-1))[..., 0]
        known = tracks.known.transpose(2, 3)
        return graph.tied_to(x, solved.states.joint(), tracks, where, known, leaves, common)

    # ---------------------------------------------------------------- parts

    def _each(self, mean: Float64[Tensor, "*s W E"]) -> Float64[Tensor, "B N W E"]:
        """Each UAV's part of the states."""
        if not self.centralized:
            return mean
        return mean.unflatten(-1, (-1, self.process.error_size)).transpose(1, 2)

    def _map(self, mean: Float64[Tensor, "*s M"]) -> Float64[Tensor, "B N L d"]:
        """The map's part, for each UAV."""
        mean = mean.unflatten(-1, (self.count, -1))
        n = self.believed.arena.n_uavs
        return mean.unsqueeze(1).expand(-1, n, -1, -1) if self.centralized else mean

    def _newest(self, solved: Solved) -> Float64[Tensor, "B N E E"]:
        """Covariance of each UAV's newest state: C + B Λ⁻¹ Bᵀ."""
        slope = solved.slopes[..., -1, :, :]
        spread = torch.linalg.solve(solved.shared.precision, slope.mT)
        covariance = solved.states.covariance[..., -1, :, :] + slope @ spread
        if not self.centralized:
            return covariance
        return diagonal_blocks(covariance, self.believed.arena.n_uavs)
