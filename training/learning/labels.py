"""Labels that need no ground truth: where UAVs were, as their own measurements say later.

What is computed here sees observations alone, of the same worlds as the training's.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agents import make
from agents.models.measurements import AnchorRanges
from agents.policies.adapters import LocalizerPolicy
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.sensors import AnchorRanging, Landmarks
from training.learning.episodes import Episode

LATE = 1.0  # s, after which a smoothed window's state is a label
AROUND = 5  # steps before and after, whose ranges a trilateration fits
_WINDOW = 20  # steps of the smoother, and more where LATE asks for them
_ITERATIONS = 20  # of Gauss–Newton
_KNOWN = 1.0  # m, standard deviation of a trilaterated position that is no label any more
_GROSS = 4.0  # standard deviations of a tie, beyond which somebody took one landmark for another


@dataclass(frozen=True)
class Labels:
    """Positions (m, world) of B worlds over T steps, and where there is one."""

    position: Float[Tensor, "B T N d"]
    known: Bool[Tensor, "B T N"]

    def at(self, step: int) -> tuple[Float[Tensor, "B N d"], Bool[Tensor, "B N"]]:
        """Those of a step."""
        return self.position[:, step], self.known[:, step]


def labels_of(kind: str, scenario: Scenario, worlds: int, seed: int, device: str) -> Labels:
    """``calibration`` or ``self_supervised`` labels of the worlds from ``seed`` on."""
    if kind == "calibration":
        return calibrated(scenario, worlds, seed, device)
    return smoothed(scenario, worlds, seed, device)


# ---------------------------------------------------------------- calibration: anchors


def calibrated(scenario: Scenario, worlds: int, seed: int, device: str = "cpu") -> Labels:
    """Trilateration from the anchor ranges of ± ``AROUND`` steps. ValueError for a scenario
    without anchors, or whose antennas are off the centre."""
    sensor = scenario.believed.sensor(AnchorRanging)
    if sensor is None or sensor.tags:
        raise ValueError(
            f"{scenario.name}: labels=calibration needs ranges to anchors, of one antenna at the "
            "centre of each UAV; in indoor-v0: anchors=4"
        )
    ekf: Any = make("ekf", scenario).to(device)
    policy = LocalizerPolicy(ekf, scenario)
    batch = _episode(scenario, worlds, seed, policy, device)
    d = scenario.arena.dim
    seen = batch["uav", "observation"]
    ranges, there = AnchorRanges(sensor).read(Observation(dict(seen.items())))
    anchors = seen["anchor_map"].double().unflatten(-1, (-1, d))
    start = batch["uav", "action"][..., :d].double()
    offset = torch.arange(-AROUND, AROUND + 1, device=start.device)
    steps = torch.arange(batch.shape[1], device=start.device).unsqueeze(-1) + offset  # [T, W]
    inside = (steps >= 0) & (steps < batch.shape[1])
    near = steps.clamp(0, batch.shape[1] - 1)
    z = ranges.double()[:, near].transpose(2, 3)  # [B, T, N, W, A]
    counted = (there[:, near] & inside[..., None, None]).transpose(2, 3)
    lag = offset.double() * scenario.arena.dt
    p, known = trilaterated(start, anchors, z, counted, lag, max(sensor.noise.std, 1e-3))
    return Labels(p, known & batch["uav", "mask"])


def trilaterated(
    start: Float[Tensor, "*s d"],
    anchors: Float[Tensor, "*s A d"],
    ranges: Float[Tensor, "*s W A"],
    there: Bool[Tensor, "*s W A"],
    lag: Float[Tensor, " W"],
    std: float,
) -> tuple[Float[Tensor, "*s d"], Bool[Tensor, "*s"]]:
    """min Σ_wa (ρ_wa − ‖p + v τ_w − a‖)² over position and velocity by Gauss–Newton from
    ``start``, ranges of σ ``std`` (m) being measured ``lag`` τ (s) later; known where the
    position's standard deviation is below ``_KNOWN``."""
    d = start.shape[-1]
    x = torch.cat((start, torch.zeros_like(start)), -1)
    weight = there.to(x)
    eye = torch.eye(2 * d, dtype=x.dtype, device=x.device)
    information = eye.expand(*x.shape, 2 * d)
    for _ in range(_ITERATIONS):
        p = x[..., None, :d] + lag.unsqueeze(-1) * x[..., None, d:]  # [*s, W, d]
        apart = p.unsqueeze(-2) - anchors.unsqueeze(-3)
        distance = apart.norm(dim=-1).clamp_min(1e-6)
        u = apart / distance.unsqueeze(-1) * weight.unsqueeze(-1)
        j = torch.cat((u, lag[:, None, None] * u), -1).flatten(-3, -2)
        information = j.mT @ j + 1e-9 * eye
        residual = ((ranges - distance) * weight).flatten(-2)
        x = x + torch.linalg.solve(information, j.mT @ residual.unsqueeze(-1))[..., 0]
    variance = torch.linalg.inv(information).diagonal(dim1=-2, dim2=-1)[..., :d].sum(-1)
    known = (std**2 * variance < _KNOWN**2) & x.isfinite().all(-1)
    return torch.where(known.unsqueeze(-1), x[..., :d], 0.0), known


# ---------------------------------------------------------------- self-supervised: the team agrees


def smoothed(scenario: Scenario, worlds: int, seed: int, device: str = "cpu") -> Labels:
    """Positions in ``dfgo``'s smoothed window, ``LATE`` s later, and, where UAVs see the same
    landmarks as vectors, tied to each other by these."""
    d, n = scenario.arena.dim, scenario.arena.n_uavs
    late = max(1, round(LATE / scenario.arena.dt))
    smoother: Any = make("dfgo", scenario, window=max(_WINDOW, late + 2)).to(device)

    def window(before: Any, after: Any, tensordict: TensorDictBase) -> dict[str, Tensor]:
        x = after.states[:, :, -1 - late]
        rotation = smoother.process.rotation(x)
        return {"p": x[..., :d], **({} if rotation is None else {"rotation": rotation})}

    policy = LocalizerPolicy(smoother, scenario, record=window)
    batch = _episode(scenario, worlds, seed, policy, device)
    steps = batch.shape[1]
    then = (torch.arange(steps, device=batch["train", "p"].device) + late).clamp_max(steps - 1)
    p = batch["train", "p"][:, then]
    known = (then - late == torch.arange(steps, device=then.device))[:, None]
    known = known & batch["uav", "mask"] & p.isfinite().all(-1)
    p = torch.where(known.unsqueeze(-1), p, 0.0)
    sensor = scenario.believed.sensor(Landmarks)
    if sensor is not None and n > 1:
        seen = batch["uav", "observation"]
        z = seen["landmarks"].double().unflatten(-1, (-1, d))
        there = (seen["landmark_mask"] > 0) & known.unsqueeze(-1)
        vectors = z @ batch["train", "rotation"][:, then].mT
        p = tied(p, torch.where(there.unsqueeze(-1), vectors, 0.0), there, sensor.std)
    return Labels(p, known)


def tied(
    p: Float[Tensor, "*s N d"],
    vectors: Float[Tensor, "*s N M d"],
    there: Bool[Tensor, "*s N M"],
    std: float,
) -> Float[Tensor, "*s N d"]:
    """Positions that agree with what UAVs see in common: least squares of

    R_i z_im − R_j z_jm = p_j − p_i

    for all landmarks m that both see (``vectors``: R z, m, world), a tie of variance 2 σ², and of
    p = p̃, of information n/σ² where n landmarks are seen. A tie that is gross against p̃ is left
    out: one of the two took a landmark for another."""
    apart = vectors.unsqueeze(-3) - vectors.unsqueeze(-4)  # [*s, N, N, M, d]: i, j
    both = there.unsqueeze(-2) & there.unsqueeze(-3)
    far = apart - (p.unsqueeze(-3) - p.unsqueeze(-2)).unsqueeze(-2)
    both = both & (far.norm(dim=-1) < _GROSS * std * (2 * p.shape[-1]) ** 0.5)
    counted = 0.5 * both.to(p)
    counted = counted * (1 - torch.eye(p.shape[-2], dtype=p.dtype, device=p.device)).unsqueeze(-1)
    c, b = counted.sum(-1), (counted.unsqueeze(-1) * apart).sum((-2, -3))  # b_i = Σ c_ij b_ij
    own = there.sum(-1).clamp_min(1).to(p)
    normal = torch.diag_embed(own + c.sum(-1)) - c
    return torch.linalg.solve(normal, own.unsqueeze(-1) * p - b)


def _episode(
    scenario: Scenario, worlds: int, seed: int, policy: LocalizerPolicy, device: str
) -> TensorDict:
    return Episode(scenario, worlds, seed, policy, device=device).run(lambda size: None)
