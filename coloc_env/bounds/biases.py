"""Biases of ranges and heights as states of their own, beside a team's errors.

A measurement z = h(x) + b + noise with information w about its distance contributes
[H, 1]ᵀ w [H, 1] to the information on (x, b); b is Gauss–Markov.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from coloc_env.bounds.expected import moved, twice
from coloc_env.bounds.information import anchor_rows, range_links
from coloc_env.bounds.mixture import EXACT
from coloc_env.bounds.recursion import add
from coloc_env.motion import Kinematics
from coloc_env.observation import Observation
from coloc_env.scenario import Scenario
from coloc_env.sensors import AnchorRanging, Height, LandmarkBearings, Ranging, Sensor, UavBearings

# About a team's errors and biases, and about each bias.
BiasInformation = tuple[Float64[Tensor, "T m b"], Float64[Tensor, "T b"]]


@dataclass(frozen=True)
class LinkBiases:
    """The biases of a team of ``n_uavs``: of each of its UAVs' own links of each sensor, then of
    each pair of tags. What a recording's errors truly are is not known: none are counted there."""

    sensors: tuple[AnchorRanging | Height | Ranging, ...]
    n_uavs: int
    dt: float

    @classmethod
    def of(cls, scenario: Scenario, cooperative: bool) -> "LinkBiases":
        """Those of a scenario's sensors; not ``cooperative``: of a single UAV. NotImplementedError
        for biases of sightings."""
        found: list[AnchorRanging | Height | Ranging] = []
        for sensor in scenario.sensors:
            if isinstance(sensor, LandmarkBearings | UavBearings) and any(sensor.bias_std):
                raise NotImplementedError("bounds: biases of sightings are not counted")
            if sensor.between_uavs and not cooperative:
                continue
            if isinstance(sensor, AnchorRanging | Height | Ranging) and _settings(sensor)[0]:
                found.append(sensor)
        n = scenario.arena.n_uavs if cooperative else 1
        return cls(tuple(found), n, scenario.arena.dt)

    @cached_property
    def counts(self) -> list[int]:
        """How many biases each sensor has in a team."""
        return [self._count(sensor) for sensor in self.sensors]

    @property
    def count(self) -> int:
        return sum(self.counts)

    @property
    def prior(self) -> Float64[Tensor, "b b"]:
        """Covariance of the biases before anything is measured, and whenever nothing is."""
        return self._each(lambda std, time: std**2).diag()

    @property
    def kept(self) -> Float64[Tensor, "b"]:
        """The share of each bias that a step leaves, e^(−dt/τ)."""
        return self._each(lambda std, time: math.exp(-self.dt / time))

    def information(
        self,
        truth: Kinematics,
        seen: Observation,
        drawn: Float64[Tensor, "B N E"],
        pose: Float64[Tensor, "D E"],
        n: int,
    ) -> BiasInformation:
        """What a step's measurements say of errors and biases together, and of biases: the mean
        over the truth moved by +drawn and −drawn, as ``expected_information`` has it."""
        there, what = moved(truth, drawn @ pose.mT), twice(seen)
        parts = [self._of(sensor, there, what, pose, n) for sensor in self.sensors]
        cross, own = (torch.cat(each, -1) for each in zip(*parts, strict=True))
        cross, own = (x.unflatten(0, (2, -1)).mean(0) for x in (cross, own))
        return cross, own

    def _of(
        self,
        sensor: Sensor,
        truth: Kinematics,
        seen: Observation,
        pose: Float64[Tensor, "D E"],
        n: int,
    ) -> BiasInformation:
        if isinstance(sensor, Ranging):
            return _of_pairs(sensor, truth, seen, pose)
        if isinstance(sensor, AnchorRanging):
            rows, weights = anchor_rows(sensor, truth, seen)
        else:
            assert isinstance(sensor, Height)
            rows = truth.position.new_zeros(*truth.position.shape[:2], 1, pose.shape[0])
            rows[..., 2] = 1.0
            weights = seen["height_mask"].double() / max(sensor.std, EXACT) ** 2
        each = ((rows * weights.unsqueeze(-1)) @ pose).mT  # [B, N, E, l]
        e, count = each.shape[-2:]
        wide = torch.diag_embed(each.reshape(-1, n, e, count).movedim(1, -1))  # [T, E, l, n, n]
        return wide.permute(0, 3, 1, 4, 2).flatten(3).flatten(1, 2), weights.reshape(-1, n * count)

    def _count(self, sensor: Sensor) -> int:
        if isinstance(sensor, Ranging):
            tags = self.n_uavs * sensor.n_tags
            return tags * (tags - 1) // 2
        each = len(sensor.anchors) * sensor.n_tags if isinstance(sensor, AnchorRanging) else 1
        return self.n_uavs * each

    def _each(self, number: Callable[[float, float], float]) -> Float64[Tensor, "b"]:
        pairs = zip(self.sensors, self.counts, strict=True)
        values = [[number(*_settings(sensor))] * count for sensor, count in pairs]
        return torch.tensor([x for one in values for x in one], dtype=torch.float64)


def predicted(
    covariance: Float64[Tensor, "T k k"],
    errors: Float64[Tensor, "T m m"],
    f: Float64[Tensor, "T n E E"],
    kept: Float64[Tensor, "b"],
    prior: Float64[Tensor, "b b"],
) -> Float64[Tensor, "T k k"]:
    """Covariance of errors and of what is beside them after a step in which that of the errors
    became so: biases of which the share φ is ``kept`` and that keep their ``prior`` variance."""
    if not len(kept):
        return errors
    m = errors.shape[-1]
    cross = (f @ covariance[:, :m, m:].unflatten(1, f.shape[1:3])).flatten(1, 2) * kept
    own = covariance[:, m:, m:] * kept * kept.unsqueeze(-1)
    own = own + prior * (1 - kept**2)
    return torch.cat((torch.cat((errors, cross), -1), torch.cat((cross.mT, own), -1)), -2)


def updated(
    root: Float64[Tensor, "T k k"],
    own: Float64[Tensor, "T n E E"],
    shared: Float64[Tensor, "T m m"] | None,
    biases: BiasInformation,
) -> Float64[Tensor, "T k k"]:
    """``(P⁻¹ + I)⁻¹`` for P = root rootᵀ and information on errors, own and shared, and biases."""
    cross, each = biases
    m = cross.shape[1]
    whole = torch.cholesky_inverse(root)
    whole[:, :m, :m] = add(whole[:, :m, :m].clone(), own, shared)
    whole[:, :m, m:] += cross
    whole[:, m:, :m] += cross.mT
    whole[:, m:, m:].diagonal(dim1=1, dim2=2).add_(each)
    return torch.cholesky_inverse(torch.linalg.cholesky(whole))


def _of_pairs(
    sensor: Ranging, truth: Kinematics, seen: Observation, pose: Float64[Tensor, "D E"]
) -> BiasInformation:
    """Of the biases of pairs of tags p < q: w u J_p at one's UAV and −w u J_q at the other's."""
    links, along, jacobian = range_links(sensor, truth, seen)
    p, q = torch.triu_indices(links.shape[1], links.shape[1], 1, device=links.device)
    weights = links[:, p, q]  # [B, L]
    by_error = (jacobian @ pose).flatten(1, 2)  # [B, P, d, E]
    toward = (weights.unsqueeze(-1) * along[:, p, q]).unsqueeze(-2)  # [B, L, 1, d]
    b, count, e = *weights.shape, pose.shape[1]
    cross = weights.new_zeros(b, count, jacobian.shape[1], e)
    index, tags = torch.arange(count, device=p.device), sensor.n_tags
    cross[:, index, p // tags] += (toward @ by_error[:, p])[..., 0, :]
    cross[:, index, q // tags] -= (toward @ by_error[:, q])[..., 0, :]
    return cross.flatten(2).mT, weights


def _settings(sensor: AnchorRanging | Height | Ranging) -> tuple[float, float]:
    """Standard deviation (m) and time (s) of a sensor's biases."""
    noise = sensor if isinstance(sensor, Height) else sensor.noise
    return noise.bias_std, noise.bias_time
