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
from coloc_env.scenario import Scenario
from coloc_env.sensors import AnchorRanging, Landmarks
from training.learning.episodes import Episode

LATE = 1.0  # s, after which a smoothed window's state is a label
AROUND = 5  # steps before and after, over which trilaterated positions are averaged
_WINDOW = 20  # steps of the smoother, and more where LATE asks for them
_ITERATIONS = 10  # of Gauss–Newton
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
    """Trilateration from anchor ranges, averaged over ± ``AROUND`` steps. ValueError for a scenario
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
    ranges, there = AnchorRanges(sensor).read(_Leaves(seen))
    anchors = seen["anchor_map"].double().unflatten(-1, (-1, d))
    start = batch["uav", "action"][..., :d].double()
    return averaged(trilaterated(start, anchors, ranges.double(), there))


class _Leaves(dict[str, Tensor]):
    """An episode's leaves, as a measurement model reads those of a step."""

    def __init__(self, seen: TensorDictBase) -> None:
        super().__init__(seen.items())

    def once(self, key: object, make: Any) -> Any:
        return make()


def trilaterated(
    start: Float[Tensor, "*s d"],
    anchors: Float[Tensor, "*s A d"],
    ranges: Float[Tensor, "*s A"],
    there: Bool[Tensor, "*s A"],
) -> Labels:
    """min Σ (ρ − ‖p − a‖)² by Gauss–Newton from ``start``; known where more anchors than dimensions
    answer and the normal equations are well conditioned."""
    p, weight = start, there.to(start)
    d = start.shape[-1]
    eye = torch.eye(d, dtype=start.dtype, device=start.device)
    normal = eye.expand(*start.shape, d)
    for _ in range(_ITERATIONS):
        apart = p.unsqueeze(-2) - anchors
        distance = apart.norm(dim=-1).clamp_min(1e-6)
        j = apart / distance.unsqueeze(-1) * weight.unsqueeze(-1)
        normal = j.mT @ j
        step = j.mT @ ((ranges - distance) * weight).unsqueeze(-1)
        p = p + torch.linalg.solve(normal + 1e-6 * eye, step)[..., 0]
    least = torch.linalg.eigvalsh(normal)[..., 0]
    known = (there.sum(-1) > d) & (least > 0.01) & p.isfinite().all(-1)
    return Labels(torch.where(known.unsqueeze(-1), p, 0.0), known)


def averaged(labels: Labels, around: int = AROUND) -> Labels:
    """Each label the mean of those within ``around`` steps; known where it was."""
    steps = labels.known.shape[1]
    k = torch.arange(steps, device=labels.known.device)
    near = ((k[:, None] - k).abs() <= around).to(labels.position)
    weight = labels.known.to(labels.position)
    total = torch.einsum("tk,bknd->btnd", near, labels.position * weight.unsqueeze(-1))
    count = torch.einsum("tk,bkn->btn", near, weight).clamp_min(1)
    return Labels(total / count.unsqueeze(-1), labels.known)


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
