"""The last steps' ranges as further terms of today's stress (ST-DCL paper, section 4.1.1).

S(y) = Σ_τ w(τ) Σ_{i<j} W_ij(τ) (d̃_ij(τ) − ‖(y_i − Δ_i(τ)) − (y_j − Δ_j(τ))‖)² (equation 19) with
w(τ) = exp(−λ (t − τ)) (equation 15) and Δ_i(τ) what dead reckoning says i has moved since τ, so
that today's positions y remain all that is unknown. What was known before the oldest of these
steps, and dead reckoning has carried on since, is the prior: no range counts twice.
"""

import torch
from jaxtyping import Float64
from tensordict import TensorClass
from torch import Tensor

from agents.swarm import joint
from agents.swarm.links import along_links, lengths
from agents.tensorclasses import build


class History(TensorClass):
    """The last T steps, the latest first, batch (B, N): where dead reckoning (or a fix) had each
    UAV before a step's ranges (``place``, m) and its rows of what was then known of all in common
    (``joint``, m², one covariance for all axes); what it has ``moved`` since (m), and by what
    factor (``kept``) and with how much variance more (``added``, m²) that knowledge has come down
    to today; the step's links: what is left of the ranges without their shifts (``distance``, m),
    how much they count today (``weight``, 1/m²) and how much they tell (``told``, 1/m²)."""

    place: Float64[Tensor, "B N T d"]
    joint: Float64[Tensor, "B N T N"]
    moved: Float64[Tensor, "B N T d"]
    kept: Float64[Tensor, "B N T"]
    added: Float64[Tensor, "B N T"]
    distance: Float64[Tensor, "B N T N"]
    weight: Float64[Tensor, "B N T N"]
    told: Float64[Tensor, "B N T N"]


def begun(
    place: Float64[Tensor, "B N d"], known: Float64[Tensor, "B N 1 K"], steps: int
) -> History:
    """``steps`` steps without ranges, before which as much was ``known`` as now (m²)."""
    shape = (*place.shape[:2], steps)
    links = place.new_zeros(*shape, shape[1])
    rows = known if known.shape[-1] else links[:, :, :1]
    return History(
        place=place.unsqueeze(2).repeat(1, 1, steps, 1),
        joint=rows.repeat(1, 1, steps, 1),
        moved=torch.zeros(*shape, place.shape[-1], dtype=place.dtype, device=place.device),
        kept=place.new_ones(shape),
        added=place.new_zeros(shape),
        distance=links,
        weight=links.clone(),
        told=links.clone(),
        batch_size=place.shape[:2],
    )


def carried(
    past: History,
    moved: Float64[Tensor, "B N d"],
    kept: Float64[Tensor, "B N"],
    added: Float64[Tensor, "B N"],
    faded: Float64[Tensor, "B 1"],
) -> History:
    """A step later, in which everybody ``moved`` (m); knowledge goes on as k_i k_j P_ij with
    ``added`` (m²) on the diagonal, and ranges count ``faded`` times what they did."""
    kept, faded = kept.unsqueeze(-1), faded[..., None, None]
    return build(
        History,
        past.batch_size,
        place=past.place,
        joint=past.joint,
        moved=past.moved + moved.unsqueeze(2),
        kept=kept * past.kept,
        added=kept.square() * past.added + added.unsqueeze(-1),
        distance=past.distance,
        weight=faded * past.weight,
        told=faded * past.told,
    )


def pushed(
    past: History,
    place: Float64[Tensor, "B N d"],
    known: Float64[Tensor, "B N 1 K"],
    distance: Float64[Tensor, "B N N"],
    weight: Float64[Tensor, "B N N"],
    told: Float64[Tensor, "B N N"],
) -> History:
    """With the step that is now, and without the oldest."""
    none = torch.zeros_like(place[..., 0])
    now = {
        "place": place,
        "joint": known[:, :, 0],
        "moved": torch.zeros_like(place),
        "kept": none + 1,
        "added": none,
        "distance": distance,
        "weight": weight,
        "told": told,
    }
    after = {k: torch.cat((x.unsqueeze(2), getattr(past, k)[:, :, :-1]), 2) for k, x in now.items()}
    return build(History, past.batch_size, **after)


def before(past: History) -> tuple[Float64[Tensor, "B N d"], Float64[Tensor, "B N 1 N"]]:
    """What was known before the oldest step, as carried on to now: places (m) and their covariance
    (m²). The velocity terms of equation 19 tie the two together."""
    nobody = torch.zeros_like(past.kept[..., 0], dtype=torch.bool)
    known = joint.carried(
        past.joint[:, :, -1:], past.kept[..., -1], past.added[..., -1], nobody, 0.0
    )
    return past.place[:, :, -1] + past.moved[:, :, -1], known


def at(
    y: Float64[Tensor, "B N d"], past: History
) -> tuple[Float64[Tensor, "B T N d"], Float64[Tensor, "B T N N"]]:
    """Where everybody was in each step if it is at ``y`` now, and the distances between them."""
    then = (y.unsqueeze(2) - past.moved).transpose(1, 2)
    return then, lengths(then.flatten(0, 1)).view(*then.shape[:3], -1)


def stress(y: Float64[Tensor, "B N d"], past: History) -> Float64[Tensor, "B"]:
    """What the last steps add to the stress, in units of ``weight`` · m²."""
    _, length = at(y, past)
    residual = past.distance.transpose(1, 2) - length
    return 0.5 * (past.weight.transpose(1, 2) * residual.square()).sum((1, 2, 3))


def pull(y: Float64[Tensor, "B N d"], past: History) -> Float64[Tensor, "B N d"]:
    """−½ ∂S/∂y of that."""
    then, length = at(y, past)
    strength = past.weight.transpose(1, 2) * (past.distance.transpose(1, 2) - length)
    return along_links(then, strength, length).sum(1)


def fading(decay: float, dt: Float64[Tensor, "B N"]) -> Float64[Tensor, "B 1"]:
    """exp(−λ dt), λ in 1/s."""
    return torch.exp(-decay * dt[:, :1])
