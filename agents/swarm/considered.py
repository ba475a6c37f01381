"""What sensors' biases make of the errors of a team whose positions are estimated all at once.

Each UAV for itself, with the gains that a Kalman filter of its marginal would have: ranges to
others count their ends' variance as noise, and Huber's weights at the solution stand for those that
the solution gave its links.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from agents.models.biases import Biases, Considered
from agents.models.measurements import Neighbours
from agents.models.process import Process
from agents.models.update import information, posterior
from agents.robust import Trust
from agents.robust.huber import huber_weights
from agents.swarm.marginals import regular
from coloc_env.observation import Observation


@dataclass(frozen=True)
class Moments:
    """State and error covariance of each UAV."""

    state: Float64[Tensor, "B N S"]
    covariance: Float64[Tensor, "B N E E"]


def after_step(
    biases: Biases,
    process: Process,
    considered: Considered,
    before: Moments,
    after: Moments,
    dt: Float64[Tensor, "B N"],
    observation: Observation,
) -> Considered:
    """``considered`` after a step of ``dt`` s from the moments ``before`` to those ``after`` it."""
    if not biases:
        return considered
    f, q = process.linearize(before.state, process.inputs(observation), dt)
    prior = regular(f @ before.covariance @ f.mT + q)
    blocks = [
        m.linearize(process, after.state, observation, _others(after, observation, process.dim))
        for m in biases.models
    ]
    trusts = [Trust(huber_weights(block)) for block in blocks]
    precision, vector = information(blocks, trusts)
    _, posterior_covariance = posterior(prior, precision, vector)
    considered = biases.predict(considered, f, observation)
    return biases.of_update(
        considered, prior, regular(posterior_covariance), blocks, trusts, observation
    )


def _others(after: Moments, observation: Observation, d: int) -> Neighbours:
    """The UAVs in each UAV's slots, where the solution has them."""
    variance = after.covariance[..., :d, :d].diagonal(dim1=-2, dim2=-1)
    both = torch.cat((after.state[..., :d], variance), -1)
    links = observation["links"]
    if "neighbours" in observation:
        world = torch.arange(len(both), device=both.device)[:, None, None]
        slots = both[world, observation["neighbours"].long()]
    else:
        slots = both.unsqueeze(1).expand(*links.shape, 2 * d)
    return Neighbours(slots[..., :d], slots[..., d:], slots.isfinite().all(-1))
