"""Cross-validation: what neighbours saw of the same landmarks, and how far away they are."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from agents.models.measurements import (
    Block,
    LandmarkRangeBearings,
    LandmarkVectors,
    Measurement,
    UavRangeBearings,
    UavRanges,
)
from agents.models.process import Process
from agents.robust.landmark_vectors import as_vectors
from agents.robust.mahalanobis import chi_square
from agents.robust.screen import Prediction
from coloc_env.observation import Observation

_PROBABILITY = 0.99  # that three good measurements vote for each other


class CrossValidation:
    """Votes of triples: UAVs i and j that range each other (r) and see the same landmark m.

    Landmark m puts UAV i at q_im = L_m − R_i z_im (its attitude being known best of all), and
    ‖q_im − q_jm‖ has to be r within what the three measurements leave open. Where a UAV thinks it
    is enters only through that: the attitude counts by how far the landmark should be. Every UAV
    sends its neighbours where the landmarks put it.
    """

    def __init__(self, process: Process, models: Sequence[Measurement]) -> None:
        self.process, self.models = process, models
        landmarks = (LandmarkVectors, LandmarkRangeBearings)
        seen = [i for i, m in enumerate(models) if isinstance(m, landmarks)]
        ranged = [i for i, m in enumerate(models) if _ranges_centres(m)]
        self.pair = (seen[0], ranged[0]) if seen and ranged else None

    def judge(
        self, blocks: Sequence[Block], prediction: Prediction
    ) -> list[Float[Tensor, "B N m"] | None]:
        """0 for measurements that are outvoted; None for blocks of which it knows nothing."""
        weights: list[Float[Tensor, "B N m"] | None] = [None] * len(blocks)
        if self.pair is None:
            return weights
        seen, ranged = self.pair
        block = blocks[seen]
        if isinstance(self.models[seen], LandmarkRangeBearings):
            block = as_vectors(block)
        place, variance = self._places(block, prediction)
        observation = prediction.observation
        theirs = _received(torch.cat((place, variance, block.mask.unsqueeze(-1)), -1), observation)
        distance, reached, noise = _distances(self.models[ranged], observation)
        apart = torch.linalg.vector_norm(place.unsqueeze(2) - theirs[..., :-2], dim=-1)
        error = apart.unsqueeze(2) - distance.unsqueeze(-1)  # [B, N, D, S, m]
        spread = (variance.unsqueeze(2) + theirs[..., -2:-1])[..., 0].unsqueeze(2) + noise
        votes = (block.mask.unsqueeze(2) & (theirs[..., -1] > 0)).unsqueeze(2)
        votes = votes & reached.unsqueeze(-1)
        against = votes & (error**2 > chi_square(_PROBABILITY, 1) * spread)
        weights[seen] = _stays(votes.sum((2, 3)), against.sum((2, 3))).to(place)
        weights[ranged] = _stays(votes.sum(-1), against.sum(-1)).to(place).flatten(-2)
        return weights

    def _places(
        self, block: Block, prediction: Prediction
    ) -> tuple[Float[Tensor, "B N m d"], Float[Tensor, "B N m 1"]]:
        """Where each landmark puts the UAV, q = p̂ + Jᵀ r with the rotation J = ∂h/∂p, and the
        variance across the line of sight: noise, and what the attitude is not sure of."""
        d, turn = self.process.dim, self.process.attitude_error
        turned, by_attitude = block.jacobian[..., :d], block.jacobian[..., turn]
        shift = (turned * block.residual.unsqueeze(-1)).sum(-2)
        attitude = prediction.covariance[..., turn, turn].unsqueeze(-3)
        doubt = ((by_attitude @ attitude) * by_attitude).sum((-2, -1)) / (d - 1)
        place = prediction.state[..., None, :d] + shift
        return place, (block.variance.amax(-1) + doubt).unsqueeze(-1)


def _ranges_centres(model: Measurement) -> bool:
    """Whether it gives distances between the UAVs themselves, now."""
    if isinstance(model, UavRanges):
        return not model.tags and model.latency == 0
    return isinstance(model, UavRangeBearings)


def _distances(
    model: Measurement, observation: Observation
) -> tuple[Float[Tensor, "B N D S"], Bool[Tensor, "B N D S"], float]:
    """Distances (m) to the UAVs in each slot, where both range and link are there, and their
    variance."""
    links = (observation["links"] > 0).unsqueeze(2)
    by_slot = (-1, links.shape[-1])
    if isinstance(model, UavRanges):
        (distance, mask), variance = model.read(observation), model.variance
    else:
        assert isinstance(model, UavRangeBearings)
        z, mask = model.read(observation)
        distance = z[..., 0]
        variance = model.std[0] ** 2
    reached = mask.unflatten(-1, by_slot) & links
    return distance.double().unflatten(-1, by_slot), reached, variance


def _received(
    sent: Float[Tensor, "B N m c"], observation: Observation
) -> Float[Tensor, "B N S m c"]:
    """What the UAVs in each UAV's slots send (``links``: whether it arrives)."""
    if "neighbours" not in observation:
        return sent.unsqueeze(1).expand(-1, sent.shape[1], -1, -1, -1)
    world = torch.arange(len(sent), device=sent.device)[:, None, None]
    return sent[world, observation["neighbours"].long()]


def _stays(votes: Int64[Tensor, "*s"], against: Int64[Tensor, "*s"]) -> Bool[Tensor, "*s"]:
    """Not outvoted: fewer than two votes, or no more than two thirds of them against (a triple is
    only as good as the other two in it: of three votes, two are too often wrong together)."""
    return (votes < 2) | (3 * against <= 2 * votes)
