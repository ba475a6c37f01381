"""What every motion model gives."""

import math
from abc import ABC, abstractmethod

import torch
from jaxtyping import Float
from torch import Tensor

from agents.models import rotations
from agents.models.rotations import concat, rotate_by, rotation_between
from coloc_env.observation import Observation

UNIFORM_YAW = math.pi / math.sqrt(3)  # rad, standard deviation of a heading that may be any
LEAST_STD = 1e-6  # m, m/s, rad, and of biases: of a prior, whose covariance must have an inverse


class Process(ABC):
    """A motion model. ``attitude_error`` is the attitude's slice of the error, if it is a state;
    ``drift_size``: how many states, the last ones, are biases of what measures heights;
    ``vague`` (m per axis) the position's standard deviation beyond which measurements are not
    linearized all at once; ``any_yaw``: nothing is known of the heading at the start."""

    state_size: int
    error_size: int
    noise_size: int
    attitude_size: int = 0
    drift_size: int = 0
    attitude_error: slice | None = None
    vague: float = 0.5
    any_yaw: bool = False

    def __init__(self, dim: int, dt: float) -> None:
        self.dim, self.dt = dim, dt

    @abstractmethod
    def inputs(self, observation: Observation) -> Float[Tensor, "B N U"]:
        """What drives the model over the step that ends now (float64)."""

    @abstractmethod
    def propagate(
        self,
        x: Float[Tensor, "*s S"],
        u: Float[Tensor, "*s U"],
        dt: Float[Tensor, "*s"],
        noise: Float[Tensor, "*s W"] | None = None,
    ) -> Float[Tensor, "*s S"]:
        """The state after ``dt`` seconds; a sample of it with standard normal ``noise``."""

    @abstractmethod
    def retreat(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s U"], dt: Float[Tensor, "*s"]
    ) -> Float[Tensor, "*s S"]:
        """The state ``dt`` seconds earlier: what ``propagate`` takes to ``x`` without noise."""

    @abstractmethod
    def linearize(
        self, x: Float[Tensor, "*s S"], u: Float[Tensor, "*s U"], dt: Float[Tensor, "*s"]
    ) -> tuple[Float[Tensor, "*s E E"], Float[Tensor, "*s E E"]]:
        """Transition matrix F of the error over one step from ``x``, and process noise Q."""

    def initial(
        self, prior: Float[Tensor, "*s W"]
    ) -> tuple[Float[Tensor, "*s S"], Float[Tensor, "*s E E"]]:
        """Mean and error covariance that the prior leaf states."""
        d, a = self.dim, 4 if self.dim == 3 else 1
        mean, std = prior[..., : 2 * d + a], prior[..., 2 * d + a :].clamp_min(LEAST_STD)
        parts = [std[..., :d], std[..., d : d + 1].expand_as(std[..., :d])]
        if self.attitude_size:
            parts.append(std[..., d + 1 :].expand(*std.shape[:-1], d if d == 3 else 1))
        x, covariance = self._initial(mean, torch.cat(parts, -1))
        if self.any_yaw and self.attitude_error is not None:
            e = self.attitude_error
            covariance[..., e, e] = self._of_any_yaw(x, covariance[..., e, e])
        return x, covariance

    @property
    def pose_errors(self) -> list[int]:
        """Where the errors of position and attitude stand among all."""
        turn = self.attitude_error
        return [*range(self.dim), *([] if turn is None else range(turn.start, turn.stop))]

    def _of_any_yaw(
        self, x: Float[Tensor, "*s S"], covariance: Float[Tensor, "*s t t"]
    ) -> Float[Tensor, "*s t t"]:
        """The attitude's covariance, but π²/3 about the vertical u: P + u uᵀ (π²/3 − uᵀ P u)."""
        rotation = self.rotation(x)
        assert rotation is not None
        up = rotation[..., -1, :] if self.dim == 3 else torch.ones_like(covariance[..., 0])
        along = ((covariance * up.unsqueeze(-2)).sum(-1) * up).sum(-1, keepdim=True)
        return covariance + up.unsqueeze(-1) * (up * (UNIFORM_YAW**2 - along)).unsqueeze(-2)

    def _initial(
        self, mean: Float[Tensor, "*s W"], std: Float[Tensor, "*s E"]
    ) -> tuple[Float[Tensor, "*s S"], Float[Tensor, "*s E E"]]:
        return mean[..., : self.state_size], torch.diag_embed(std**2)

    def rotation(self, x: Float[Tensor, "*s S"]) -> Float[Tensor, "*s d d"] | None:
        """Body-to-world matrix, None where attitude is no state."""
        return rotations.matrix(self.attitude(x)) if self.attitude_size else None

    def attitude(self, x: Float[Tensor, "*s S"]) -> Float[Tensor, "*s a"]:
        """The attitude's part of the state."""
        return x[..., 2 * self.dim : 2 * self.dim + self.attitude_size]

    def boxplus(
        self, x: Float[Tensor, "*s S"], delta: Float[Tensor, "*s E"]
    ) -> Float[Tensor, "*s S"]:
        """``x ⊞ δ``."""
        if not self.attitude_size:
            return x + self._linear(delta)
        d, a = self.dim, self.attitude_size
        e = self.attitude_error
        assert e is not None
        linear = x[..., : 2 * d] + self._linear(delta)
        turned = rotate_by(x[..., 2 * d : 2 * d + a], delta[..., e])
        rest = x[..., 2 * d + a :] + delta[..., e.stop :]
        return concat((linear, turned, rest))

    def boxminus(self, x: Float[Tensor, "*s S"], y: Float[Tensor, "*s S"]) -> Float[Tensor, "*s E"]:
        """``x ⊟ y``: the δ with ``y ⊞ δ = x``."""
        difference = x - y
        if not self.attitude_size:
            return difference
        d, a = self.dim, self.attitude_size
        e = self.attitude_error
        assert e is not None
        turn = rotation_between(y[..., 2 * d : 2 * d + a], x[..., 2 * d : 2 * d + a])
        return concat((difference[..., : e.start], turn, difference[..., 2 * d + a :]))

    def _linear(self, delta: Float[Tensor, "*s E"]) -> Float[Tensor, "*s 2d"]:
        return delta[..., : 2 * self.dim]
