"""Actions as corrections on a base localizer's estimate: for learners that start from a filter."""

from typing import Any, Protocol, TypeVar

import torch
from jaxtyping import Float32
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Localizer
from agents.models.measurements import make_measurements, received
from agents.models.measurements.bearings import UavRangeBearings
from agents.models.measurements.ranges import AnchorRanges, UavRanges
from agents.models.measurements.vectors import Heights
from agents.models.process import make_process
from agents.registry import make
from agents.wrappers.residuals import pulls, robust_statistics
from coloc_env.envs.action_mode import ActionMode, Leaves
from coloc_env.envs.displacement import Displacement
from coloc_env.envs.fixes import fix_leaves, relative_fixes
from coloc_env.observation import Observation, prior_action
from coloc_env.scenario import Believed, Scenario
from coloc_env.sensors.base import Leaf

_LARGEST = 1.0  # m: no correction is larger, in an arena of up to 100 m
_PULLS = (AnchorRanges, Heights, UavRangeBearings, UavRanges)  # beside the landmarks' fixes


class CorrectionMemory(TensorClass):
    """The base's belief, its estimate as an action, how far an action of 1 moves that (m), and the
    last action; batch (B, N)."""

    belief: Any
    estimate: Float32[Tensor, "B N A"]
    scale: Float32[Tensor, "B N d"]
    last_action: Float32[Tensor, "B N d"]


class Correction(ActionMode):
    """[−1, 1]^d, times what the base may be off, is added to the position that a base localizer
    estimates (m, world frame); values beyond are cut.

    What it may be off is 2 (σ + |robust residual|) an axis, at most 1 m or a hundredth of the
    arena's longest side: σ is the base's standard deviation, the robust residual the Huber mean of
    the landmarks' fixes relative to its estimate (their clipped pull where there are only ranges).
    ``feedback``: the share of the correction that the base itself is moved by.

    Leaves: ``base_estimate`` (the base's action), ``base_std`` (m), the landmarks' fixes relative
    to the base (``landmark_fixes`` …, m), ``residuals`` (m: median, Huber mean and scatter of the
    fixes; pull of the ranges, raw and clipped; the innovation, how far the estimate lies from the
    last one moved on at its velocity), ``attitude`` and ``last_action``. A base without a mean
    state, such as ``cspf``, has no residuals but the innovation, no fixes and no
    attitude.
    """

    name = "correction"
    meaning = "correction in units of what the base may be off, within [-1, 1]"

    def __init__(self, believed: Believed, base: str = "ekf", feedback: float = 0.0) -> None:
        super().__init__(believed)
        if not 0 <= feedback <= 1:
            raise ValueError(f"feedback={feedback} is not allowed: a share in [0, 1]")
        self.base: Localizer[Any] = make(base, believed)
        kind = type(self.base)
        if feedback and kind.shifted is Localizer.shifted:
            raise ValueError(
                f"base={base!r} with feedback={feedback} is not allowed: it cannot be moved; "
                "feedback=0, or a filter such as ekf or pf500"
            )
        self._base = base
        self.feedback = feedback
        longest = max(b - a for a, b in zip(believed.arena.low, believed.arena.high, strict=True))
        self._largest = max(_LARGEST, longest / 100)
        self.models: list[Any] = []
        self._fixes: dict[str, Leaf] = {}
        if kind.mean is not Localizer.mean:
            self.process = make_process(believed)
            self.models = [m for m in make_measurements(believed) if isinstance(m, _PULLS)]
            if self.process.attitude_error is not None:
                self._fixes = fix_leaves(believed)
        mean = ("fix_mean",) if self._fixes else ()
        self.features = ("base_std", *mean, "residuals", "last_action")

    @property
    def settings(self) -> dict[str, Any]:
        return {"name": self.name, "base": self._base, "feedback": self.feedback}

    @property
    def leaves(self) -> dict[str, Leaf]:
        d = self.dim
        vectors = 3 * bool(self._fixes) + 2 * bool(self.models) + 1
        attitude = {"attitude": Leaf(self.process.attitude_size)} if self._fixes else {}
        return {
            "base_estimate": Leaf(3 * d, unit="m, m/s, log m", frame="world"),
            "base_std": Leaf(d, 0.0, unit="m", frame="world"),
            **attitude,
            **self._fixes,
            "residuals": Leaf(vectors * d, unit="m", frame="world"),
            "last_action": Leaf(d, -1.0, 1.0),
        }

    def reset(self, observation: Observation) -> CorrectionMemory:
        estimate = prior_action(observation, self.dim)
        nothing = torch.zeros_like(estimate[..., : self.dim])
        return CorrectionMemory(
            belief=self.base.reset(observation),
            estimate=estimate,
            scale=nothing,
            last_action=nothing,
            batch_size=estimate.shape[:2],
        )

    @torch.no_grad()
    def observe(
        self, memory: CorrectionMemory, observation: Observation
    ) -> tuple[CorrectionMemory, Leaves]:
        d, dt = self.dim, self.believed.arena.dt
        belief, found = self.base.step(memory.belief, observation)
        estimate = found.action()
        position, std = estimate[..., :d], estimate[..., 2 * d :].exp()
        before = memory.estimate
        innovation = position - before[..., :d] - dt * before[..., d : 2 * d]
        leaves: Leaves = {"base_estimate": estimate, "base_std": std}
        residuals, robust = [], torch.zeros_like(position)
        state = self.base.mean(belief) if self.models or self._fixes else None
        if self.models:
            assert state is not None
            x, neighbours = state.double(), received(self.believed, observation)
            blocks = [m.linearize(self.process, x, observation, neighbours) for m in self.models]
            raw, clipped = (pull.to(torch.float32) for pull in pulls(blocks, d))
            residuals, robust = [raw, clipped], clipped
        if self._fixes:
            assert state is not None
            attitude = self.process.attitude(state).to(torch.float32)
            leaves["attitude"] = attitude
            relative, apart, mask = relative_fixes(self.believed, observation, attitude, position)
            leaves |= relative
            median, robust, scatter = robust_statistics(apart, mask)
            residuals = [median, robust, scatter, *residuals]
        leaves["residuals"] = torch.cat((*residuals, innovation), -1)
        leaves["last_action"] = memory.last_action
        scale = (2 * (std + robust.abs())).clamp(max=self._largest)
        return memory.replace(belief=belief, estimate=estimate, scale=scale), leaves

    def estimate(
        self, memory: CorrectionMemory, action: Float32[Tensor, "B N d"]
    ) -> tuple[CorrectionMemory, Float32[Tensor, "B N A"]]:
        action, d = action.clamp(-1.0, 1.0), self.dim
        offset = memory.scale * action
        belief = memory.belief
        if self.feedback:
            belief = self.base.shifted(belief, self.feedback * offset)
        estimate = memory.estimate
        corrected = torch.cat((estimate[..., :d] + offset, estimate[..., d:]), -1)
        return memory.replace(belief=belief, last_action=action), corrected

    def reference(self, memory: CorrectionMemory) -> Float32[Tensor, "B N d"]:
        return memory.estimate[..., : self.dim]


def learners_mode(believed: Believed, base: str, feedback: float = 0.0) -> ActionMode:
    """Corrections on a base; for ``none`` displacements of the UAV's own."""
    return Displacement(believed) if base == "none" else Correction(believed, base, feedback)


class Face(Protocol):
    """Any of the environments."""

    scenario: Scenario

    def with_action(self, action: str | ActionMode) -> Any:
        """The same environment in another action mode."""


Env = TypeVar("Env", bound=Face)


def with_base(env: Env, base: str = "ekf", feedback: float = 0.0) -> Env:
    """The same environment, whichever face, for corrections on a base localizer's estimates.

    ``base``: any localizer, with options as on the command line (``"ekf:robust=huber"``).
    Raises ValueError for one that is unknown or does not serve the scenario, and for ``feedback``
    to one that cannot be moved.
    """
    corrected: Env = env.with_action(Correction(env.scenario.believed, base, feedback))
    return corrected
