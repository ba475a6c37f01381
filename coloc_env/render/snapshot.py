"""What one picture shows of a world, as plain arrays."""

from dataclasses import dataclass

import numpy as np
import torch

from coloc_env.geometry import rotation_matrix
from coloc_env.world import World

_CLOSEST = 3  # links drawn per UAV of a large team
_FULL = 16  # teams up to this size show every link


@dataclass(frozen=True)
class Snapshot:
    """The first world of a batch at one step: N UAVs in d dimensions, NaN for what is unknown.

    ``position`` [N, d] (m) is NaN for failed UAVs and where a recording has no truth; ``ahead``
    [N, d] is the body's forward axis in the world frame; ``estimate`` [N, d] (m) and ``std`` [N, d]
    (m) are NaN before an estimate was made. ``links`` [M, 2] are pairs of UAVs one of
    which hears the other; ``landmarks`` [L, d] and ``anchors`` [A, d] lie on the team's map, and
    ``watching`` is the UAV that sees the points ``seen`` [K, d] among them (-1: all have failed).
    ``obstacles`` [C, d] is where the axes of those that move are.
    """

    step: int
    position: np.ndarray
    ahead: np.ndarray
    alive: np.ndarray
    estimate: np.ndarray
    std: np.ndarray
    links: np.ndarray
    landmarks: np.ndarray
    anchors: np.ndarray
    seen: np.ndarray
    watching: int
    obstacles: np.ndarray

    @property
    def close_links(self) -> bool:
        """Whether ``links`` holds only each UAV's closest ones."""
        return len(self.position) > _FULL

    @property
    def error(self) -> np.ndarray:
        """Position errors [N] in m; NaN where there is no truth or no estimate."""
        return np.linalg.norm(self.estimate - self.position, axis=-1)


def take(world: World, estimates: torch.Tensor | None) -> Snapshot:
    """The world at its current step with the ``estimates`` [1, N, 3d] made of it, if any."""
    truth, sensed, now = world.truth, world.sensed, world.cursor
    leaves = {name: leaf[0, now].cpu().numpy() for name, leaf in sensed.leaves.items()}
    dim = world.scenario.arena.dim
    maps = {
        kind: world.static[f"{kind}_map"][0, 0].cpu().numpy().reshape(-1, dim).astype(float)
        if f"{kind}_map" in world.static
        else np.empty((0, dim))
        for kind in ("landmark", "anchor")
    }
    alive = world.alive[0].cpu().numpy()
    anchors = alive & (np.arange(len(alive)) < world.scenario.anchor_uavs)
    known = sensed.scored[0, now].cpu().numpy() | anchors
    position = np.where(known[:, None], truth.position[0].cpu().numpy(), np.nan)
    unknown = np.full_like(position, np.nan)
    estimate, std = unknown, unknown
    if estimates is not None:
        values = estimates[0].detach().cpu().numpy().astype(float)
        shown = (alive & ~anchors)[:, None]  # nobody asks an anchor UAV
        estimate = np.where(shown, values[:, :dim], np.nan)
        log_std = np.clip(values[:, 2 * dim :], -10.0, 10.0)
        std = np.where(shown, np.exp(log_std), np.nan)
    watching = int(np.argmax(alive)) if alive.any() else -1
    return Snapshot(
        step=int(world.step_index[0]),
        position=position,
        ahead=rotation_matrix(truth.attitude[0])[..., 0].cpu().numpy(),
        alive=alive,
        estimate=estimate,
        std=std,
        links=_links(leaves, truth.position[0].cpu().numpy()),
        landmarks=maps["landmark"],
        anchors=maps["anchor"],
        seen=_seen(leaves, maps, watching),
        watching=watching,
        obstacles=world.obstacles[0].cpu().numpy(),
    )


def _links(leaves: dict[str, np.ndarray], position: np.ndarray) -> np.ndarray:
    """Pairs [M, 2] of UAVs that hear each other one way or both; a large team's closest ones."""
    heard = leaves["links"] > 0
    n, slots = heard.shape
    if "neighbours" in leaves:
        senders = leaves["neighbours"].astype(int)
    else:
        senders = np.broadcast_to(np.arange(n), (n, slots))
    if n > _FULL and slots > _CLOSEST:
        apart = np.linalg.norm(position[senders] - position[:, None], axis=-1)
        apart = np.where(heard, apart, np.inf)
        heard &= apart <= np.sort(apart, axis=1)[:, _CLOSEST - 1 : _CLOSEST]
    receivers, slot = np.nonzero(heard)
    pairs = np.stack((receivers, senders[receivers, slot]), -1)
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _seen(leaves: dict[str, np.ndarray], maps: dict[str, np.ndarray], watching: int) -> np.ndarray:
    """Map points [K, d] of which the watching UAV has a measurement now (mask leaves [… · L])."""
    seen = [np.empty((0, maps["landmark"].shape[1]))]
    for kind, points in maps.items():
        for name, mask in leaves.items():
            ours = name.startswith(kind) and name.endswith("_mask")
            if ours and watching >= 0 and len(points):
                seen.append(points[(mask[watching].reshape(-1, len(points)) > 0).any(0)])
    return np.concatenate(seen)
