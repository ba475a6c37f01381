"""Classical multidimensional scaling of whole networks (MDS-MAP).

Shang, Ruml, Zhang & Fromherz, MobiHoc 2003: shortest paths stand for missing distances, classical
scaling (Torgerson 1952) gives a relative map, and a similarity fits it to the anchors.
"""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor
from torch.nn import functional


def shortest_paths(
    distance: Float64[Tensor, "B N N"], mask: Bool[Tensor, "B N N"]
) -> Float64[Tensor, "B N N"]:
    """Lengths of the shortest paths along links (Floyd–Warshall); infinite where there is none."""
    paths = torch.where(mask, distance, torch.inf)
    paths.diagonal(dim1=-2, dim2=-1).zero_()
    for k in range(paths.shape[-1]):
        paths = torch.minimum(paths, paths[:, :, k, None] + paths[:, None, k, :])
    return paths


def classical_scaling(paths: Float64[Tensor, "B N N"], dim: int) -> Float64[Tensor, "B N d"]:
    """Coordinates about the centroid whose distances come nearest to ``paths``: the largest
    eigenvectors of −½ J D² J."""
    squared = paths.square()
    centred = squared - squared.mean(-1, keepdim=True) - squared.mean(-2, keepdim=True)
    centred = -0.5 * (centred + squared.mean((-2, -1), keepdim=True))
    missing = max(0, dim - paths.shape[-1])  # dimensions that a small team does not span
    values, vectors = torch.linalg.eigh(centred)
    values, vectors = (functional.pad(x, (missing, 0)) for x in (values, vectors))
    return vectors[..., -dim:].flip(-1) * values[..., -dim:].flip(-1).clamp_min(0).sqrt().unsqueeze(
        -2
    )


def procrustes(
    points: Float64[Tensor, "B N d"],
    target: Float64[Tensor, "B N d"],
    weight: Float64[Tensor, "B N"],
) -> Float64[Tensor, "B N d"]:
    """``points`` rotated, reflected, scaled and translated to the weighted least squares fit of
    ``target`` (Procrustes; Schönemann & Carroll 1970)."""
    w = (weight / weight.sum(-1, keepdim=True).clamp_min(1e-12)).unsqueeze(-1)
    from_, to = (w * points).sum(1, keepdim=True), (w * target).sum(1, keepdim=True)
    u, s, v = torch.linalg.svd((w * (points - from_)).mT @ (target - to))
    spread = (w * (points - from_).square()).sum((-2, -1)).clamp_min(1e-12)
    scale = (s.sum(-1) / spread)[:, None, None]
    return scale * (points - from_) @ (u @ v) + to
