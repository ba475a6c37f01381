"""What every measurement model gives: a block of residuals and Jacobians.

A ``Block`` holds m measurements of k numbers each, per UAV, masked; filters of every kind (one per
UAV, joint, iterated, robust) work on blocks alone and never on a sensor.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from agents.models.process import Process
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

_LEAST_STD = 1e-3  # m, rad


@dataclass(frozen=True)
class Neighbours:
    """Where the UAVs in a UAV's slots are now, as far as it knows: position (m) and variance (m²)
    per axis, and which slots it knows anything of."""

    position: Float[Tensor, "B N S d"]
    variance: Float[Tensor, "B N S d"]
    known: Bool[Tensor, "B N S"]


def no_neighbours(position: Float[Tensor, "*s d"]) -> Neighbours:
    """No slots at all, for what a UAV at some position measures without others."""
    none = position.unsqueeze(-2)[..., :0, :]
    return Neighbours(none, none, none[..., 0] > 0)


def received(believed: Believed, observation: Observation) -> Neighbours:
    """Neighbours by their messages: past estimates, propagated at constant velocity."""
    d = believed.arena.dim
    content = observation["messages"].double().unflatten(-1, (believed.slots, 3 * d))
    known = (observation["message_mask"] > 0) & content.isfinite().all(-1)
    content = content.masked_fill(~known.unsqueeze(-1), 0.0)
    age = believed.arena.dt * (1 + believed.message_delay)
    return Neighbours(
        position=content[..., :d] + age * content[..., d : 2 * d],
        variance=(2 * content[..., 2 * d :]).exp(),
        known=known,
    )


def per_state(observation: Observation, neighbours: Neighbours) -> tuple[Observation, Neighbours]:
    """The same for every one of a UAV's states [B, N, M, S] that a model is linearized at."""
    wide = Observation({name: leaf.unsqueeze(2) for name, leaf in observation.leaves.items()})
    parts = (neighbours.position, neighbours.variance, neighbours.known)
    return wide, Neighbours(*(part.unsqueeze(2) for part in parts))


@dataclass(frozen=True)
class Block:
    """m measurements of k numbers each, linearized at some state: residual z − h(x).

    ``jacobian`` is ∂h/∂δ of the UAV's own error (empty where derivatives were not asked for),
    ``variance`` the measurement's own noise (diagonal).
    Where the measurements involve the UAVs in neighbour slots, ``partner`` is ∂h/∂p of that UAV's
    position and ``partner_variance`` what its uncertainty adds; they come as (…, slot,
    ``per_slot``) flattened, and ``mutual``: both UAVs hold the very same number.
    ``distance`` (m) is that to the other UAV where it is what was measured. ``curvature``: the size
    (Frobenius norm) of ∂²h/∂p², per m², of what is far from linear while positions are broad.
    ``stray``: the density of measurements that show something else, over that at the peak.
    ``varies``: the variance depends on the state, so that a likelihood counts its logarithm.
    """

    residual: Float[Tensor, "B N m k"]
    jacobian: Float[Tensor, "B N m k E"]
    variance: Float[Tensor, "B N m k"]
    mask: Bool[Tensor, "B N m"]
    partner: Float[Tensor, "B N m k d"] | None = None
    partner_variance: Float[Tensor, "B N m k"] | None = None
    per_slot: int = 1
    mutual: bool = False
    distance: Float[Tensor, "B N m 1"] | None = None
    curvature: Float[Tensor, "B N m k"] | None = None
    varies: bool = False
    stray: float = 0.0

    @property
    def total_variance(self) -> Float[Tensor, "B N m k"]:
        """Noise and, as if independent, the partner's uncertainty."""
        if self.partner_variance is None:
            return self.variance
        return self.variance + self.partner_variance

    def curved(self, position: Float[Tensor, "B N d d"]) -> "Block":
        """With what linearizing neglects as noise: the variance of ½ δᵀ M δ, ½ tr((M P)²), for the
        covariance ``position`` P of δ as if it were round (Jazwinski 1970, section 9.3)."""
        if self.curvature is None:
            return self
        mean = position.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        return replace(self, variance=self.variance + 0.5 * (self.curvature * mean) ** 2)

    def bent(self, apart: Float[Tensor, "B N S d d"], steps: float) -> "Block":
        """With what linearizing distances neglects as noise: their variance grows by
        ((tr M − uᵀ M u) / 2 d)², M being the covariance of the two UAVs' relative position (by
        slot), d their distance and u its direction; by ``steps`` times that where so many steps
        share the error.
        """
        if self.distance is None:
            return self
        assert self.partner is not None
        m = apart.repeat_interleave(self.per_slot, 2)
        m = m.repeat(1, 1, self.mask.shape[-1] // m.shape[2], 1, 1).unsqueeze(3)
        u = self.partner  # [B, N, m, 1, d]
        along = ((u.unsqueeze(-2) @ m) * u.unsqueeze(-2)).sum((-2, -1))
        lateral = m.diagonal(dim1=-2, dim2=-1).sum(-1) - along
        return replace(self, variance=self.variance + steps * (lateral / (2 * self.distance)) ** 2)


def body_frame(
    process: Process, x: Float[Tensor, "B N S"], what: str
) -> tuple[Float[Tensor, "B N d d"], slice]:
    """The attitude R (body to world) of states, and where its error stands. ValueError where
    ``what`` is measured in the body frame (a noun with its verb), and no attitude is a state."""
    rotation, turn = process.rotation(x), process.attitude_error
    if rotation is None or turn is None:
        raise ValueError(f"{what} in the body frame: the motion model has no attitude")
    return rotation, turn


def believed_biases(*std: float) -> tuple[float, ...]:
    """Standard deviations of the biases of a link's numbers; none where all are 0."""
    return std if any(std) else ()


def noise_std(std: float) -> float:
    """The noise (m, rad) that a filter may assume: a sensor without any would leave no weights."""
    return max(std, _LEAST_STD)


class Measurement(ABC):
    """A sensor's model. ``cooperative`` ones involve other UAVs; ``mask_leaf`` names the leaf
    that marks which of its measurements are there (None: a single one, always). ``testable`` is
    false for a belief that enters like a measurement, and says nothing of who predicts well.
    ``depth``: how many measurements of one link a step can have. ``bias_std`` of each number that a
    link measures (empty: none is believed to be biased), over ``bias_time`` s."""

    cooperative = False
    testable = True
    mask_leaf: str | None = None
    depth = 1
    bias_std: tuple[float, ...] = ()
    bias_time = math.inf

    def count(self, observation: Observation) -> int:
        """How many measurements its block has."""
        return 1 if self.mask_leaf is None else observation[self.mask_leaf].shape[-1]

    @abstractmethod
    def linearize(
        self,
        process: Process,
        x: Float[Tensor, "B N S"],
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        """Residuals and, unless ``derivatives`` are not wanted, Jacobians at ``x``.

        Leading dimensions are free: for particles x is [B, N, M, S] and the leaves of the
        observation and of ``neighbours`` have a dimension 1 in place of M.
        """
