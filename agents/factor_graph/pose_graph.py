"""Robust pose graph over a team's whole history, solved by GTSAM: the reference with all data.

Worlds are solved one by one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Float64, Int64
from tensordict import TensorClass
from torch import Tensor

from agents.localizer import Estimate, Localizer
from agents.stein import odometry
from agents.stein.team import RelativeTeam
from agents.tensorclasses import build
from coloc_env.observation import Observation
from coloc_env.options import PositiveCount
from coloc_env.scenario import Believed, Inertial

Robust = Literal["huber", "gnc", "none"]

_HUBER = 1.345  # standard deviations beyond which Huber's loss is linear
_TIGHT = 1e-4  # m, rad: of variables that are fixed
_INLIER = 0.99  # probability that GNC keeps a match that is right
_CLOSE = (0.5, 0.35)  # m, rad: matches that agree in the initial estimate


class PoseGraphBelief(TensorClass):
    """Each UAV's ``track`` by odometry over T steps (or the means of its IMU, [T, 6]), the M
    ``matches`` of each step with their ``ends`` and ``mask``, the ``estimate`` relative to UAV 0
    and the ``covariance`` of its position in its body frame (m²); batch (B, N)."""

    track: Float64[Tensor, "B N T P"]
    ends: Int64[Tensor, "B N T M 2"]
    matches: Float64[Tensor, "B N T M P"]
    mask: Bool[Tensor, "B N T M"]
    estimate: Float64[Tensor, "B N P"]
    covariance: Float64[Tensor, "B N d d"]
    step: Int64[Tensor, "B N"]


@dataclass(frozen=True)
class _Factors:
    """One world's odometry factors [N, T−1], its matches, each once (UAVs ``first`` and ``second``
    in step ``at``), and an initial estimate of all poses (``start``)."""

    odometry: Float64[Tensor, "N S P"]
    first: list[int]
    second: list[int]
    at: list[int]
    pose: Float64[Tensor, "C P"]
    start: Float64[Tensor, "N T P"]


class PoseGraph(RelativeTeam[PoseGraphBelief]):
    """All poses of all UAVs at all steps, from all odometry and matches, whatever the network.

    ``robust``: Huber's loss on matches, ``gnc`` (graduated non-convexity with truncated least
    squares, Yang et al. 2020), or ``none``. Solved at every ``every``-th step, and propagated
    by odometry in between. Needs GTSAM (``pip install coloc-env[graph]``).
    """

    name = "pose_graph"
    centralized = True

    def __init__(
        self, believed: Believed, *, robust: Robust = "huber", every: PositiveCount = 10
    ) -> None:
        super().__init__(believed, 0.2, 1.0)
        try:
            import gtsam
        except ImportError as error:
            raise ValueError("GTSAM is missing: pip install coloc-env[graph]") from error
        self.gtsam, self.robust, self.every = gtsam, robust, every

    @classmethod
    def for_team(cls, believed: Believed, **options: Any) -> Localizer[Any]:
        """The graph; in a team that moves by its IMUs the one that has them as factors."""
        if not isinstance(believed.process, Inertial):
            return cls(believed, **options)
        from agents.factor_graph.pose_graph_inertial import InertialPoseGraph

        return InertialPoseGraph(believed, **options)

    def reset(self, observation: Observation) -> PoseGraphBelief:
        b, n = observation.batch_size
        poses, m = self.poses, self.matches.matches
        origin = observation["reference"].double()
        at = poses.identity(origin)
        zero = torch.zeros(b, n, dtype=torch.int64, device=origin.device)
        return PoseGraphBelief(
            track=at.expand(b, n, 0, -1),
            ends=zero[..., None, None, None].expand(b, n, 0, m, 2),
            matches=at.expand(b, n, 0, m, -1),
            mask=zero[..., None, None].bool().expand(b, n, 0, m),
            estimate=at.expand(b, n, -1).clone(),
            covariance=torch.diag(origin.new_tensor(self.uniform[: poses.dim])).expand(
                b, n, -1, -1
            ),
            step=zero,
            batch_size=(b, n),
        )

    def step(
        self, belief: PoseGraphBelief, observation: Observation
    ) -> tuple[PoseGraphBelief, Estimate]:
        poses = self.poses
        dt = (belief.step > 0).double() * self.believed.arena.dt
        moved = odometry.increments(poses, observation, dt)
        before = belief.track[:, :, -1] if belief.track.shape[2] else belief.estimate
        ends, pose, mask = self._measured(observation)

        def append(steps: Tensor, new: Tensor) -> Tensor:
            return torch.cat((steps, new.unsqueeze(2)), 2)

        after = build(
            PoseGraphBelief,
            belief.step.shape,
            track=append(belief.track, poses.compose(before, moved)),
            ends=append(belief.ends, ends),
            matches=append(belief.matches, pose),
            mask=append(belief.mask, mask),
            estimate=odometry.propagate(poses, belief.estimate, moved),
            covariance=belief.covariance,
            step=belief.step + 1,
        )
        if after.track.shape[2] % self.every == 0:
            solved = [self._solved(row) for row in after.to("cpu").unbind(0)]  # where GTSAM works
            estimate, covariance = (
                torch.stack(part).to(moved.device) for part in zip(*solved, strict=True)
            )
            after = after.replace(estimate=estimate, covariance=covariance)
        origin = observation["reference"].double()
        return after, self.world_estimate(
            after.estimate, after.covariance, origin, odometry.speed(poses, observation, dt > 0)
        )

    def _measured(self, observation: Observation) -> tuple[Tensor, Tensor, Tensor]:
        """The step's matches: their ends, poses, and which are there."""
        m, poses = self.matches.matches, self.poses
        pose = observation["relative_poses"].double().unflatten(-1, (m, poses.size))
        mask = (observation["relative_pose_mask"] > 0) & pose.isfinite().all(-1)
        pose = torch.where(mask.unsqueeze(-1), pose, poses.identity(pose))
        ends = observation["relative_pose_ends"].unflatten(-1, (m, 2))
        return torch.where(mask.unsqueeze(-1), ends, 0.0).to(torch.int64), pose, mask

    def team(self, belief: PoseGraphBelief) -> Float[Tensor, "B H N P"]:
        n = belief.step.shape[1]
        return belief.estimate[..., : self.poses.size].unsqueeze(1).expand(-1, n, -1, -1)

    # ---------------------------------------------------------------- one world's graph

    def _solved(
        self, row: PoseGraphBelief
    ) -> tuple[Float64[Tensor, "N P"], Float64[Tensor, "N d d"]]:
        """Poses relative to UAV 0's last one, and the marginal covariances of their positions."""
        factors, gtsam = self._factors(row), self.gtsam
        n, steps = factors.start.shape[:2]
        graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
        kind = "Pose3" if self.poses.dim == 3 else "Pose2"
        prior, between = (getattr(gtsam, f"{f}Factor{kind}") for f in ("Prior", "Between"))
        exact = gtsam.noiseModel.Isotropic.Sigma(self.poses.dof, _TIGHT)
        graph.add(prior(steps - 1, self._to_gtsam(factors.start[0, -1]), exact))
        uniform = self._noise([variance**0.5 for variance in self.uniform])
        odometry = self._noise(self.std)
        for uav in range(n):
            for k in range(steps):
                initial.insert(uav * steps + k, self._to_gtsam(factors.start[uav, k]))
            if uav:
                identity = self.poses.identity(factors.start)
                graph.add(prior(uav * steps + steps - 1, self._to_gtsam(identity), uniform))
            for k in range(steps - 1):
                key = uav * steps + k
                graph.add(between(key, key + 1, self._to_gtsam(factors.odometry[uav, k]), odometry))
        known = graph.size()
        match = self._match_noise()
        for i, j, k, pose in zip(
            factors.first, factors.second, factors.at, factors.pose, strict=True
        ):
            graph.add(between(i * steps + k, j * steps + k, self._to_gtsam(pose), match))
        values, graph = self._optimized(graph, initial, known)
        keys = [uav * steps + steps - 1 for uav in range(n)]
        estimate = torch.stack([self._from_gtsam(values, key) for key in keys])
        estimate = self.poses.between(estimate[:1], estimate)
        marginals = gtsam.Marginals(graph, values)
        cut = slice(3, 6) if self.poses.dim == 3 else slice(0, 2)
        covariance = [torch.tensor(marginals.marginalCovariance(key)[cut, cut]) for key in keys]
        return estimate, torch.stack(covariance).to(estimate.dtype)

    def _optimized(self, graph: Any, initial: Any, known: int) -> tuple[Any, Any]:
        """The solution, and the graph of the inliers, whose Hessian is its information."""
        gtsam = self.gtsam
        if self.robust != "gnc" or graph.size() == known:
            return gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize(), graph
        params = gtsam.GncLMParams()
        params.setLossType(gtsam.GncLossType.TLS)
        params.setKnownInliers(list(range(known)))
        optimizer = gtsam.GncLMOptimizer(graph, initial, params)
        optimizer.setInlierCostThresholdsAtProbability(_INLIER)
        values = optimizer.optimize()
        weights, kept = optimizer.getWeights(), gtsam.NonlinearFactorGraph()
        for index in range(graph.size()):
            if weights[index] > 0.5:
                kept.add(graph.at(index))
        return values, kept

    def _factors(self, row: PoseGraphBelief) -> _Factors:
        """The factors, and an initial estimate: each UAV's track, placed relative to UAV 0's by the
        matches that most others between the same two UAVs agree with."""
        poses, n = self.poses, row.track.shape[0]
        uav = torch.arange(n, device=row.track.device)[:, None, None]
        once = row.mask & (row.ends[..., 0] == uav)
        index = once.nonzero()
        first, second = row.ends[once].unbind(-1)
        at, pose = index[:, 1], row.matches[once]
        to_now = poses.between(row.track, row.track[:, -1:])  # [N, T, P]: D from then to now
        present = poses.between(to_now[first, at], poses.compose(pose, to_now[second, at]))
        placed = self._layout(first.tolist(), second.tolist(), present, n)
        if not any(self.std):  # exact odometry makes one unknown of all of a UAV's poses
            still = [0] * len(pose)
            ends = first.tolist(), second.tolist()
            return _Factors(row.track[:, :0], *ends, still, present, placed.unsqueeze(1))
        start = poses.compose(placed.unsqueeze(1), poses.inverse(to_now))
        odometry = poses.between(row.track[:, :-1], row.track[:, 1:])
        return _Factors(odometry, first.tolist(), second.tolist(), at.tolist(), pose, start)

    def _layout(
        self, first: Sequence[int], second: Sequence[int], pose: Float64[Tensor, "C P"], n: int
    ) -> Float64[Tensor, "N P"]:
        """Poses relative to UAV 0 along the tree of the best-supported matches."""
        poses = self.poses
        best: dict[tuple[int, int], tuple[int, Tensor]] = {}
        for a in range(n):
            for b in range(a + 1, n):
                there = [c for c in range(len(first)) if (first[c], second[c]) == (a, b)]
                back = [c for c in range(len(first)) if (first[c], second[c]) == (b, a)]
                if there or back:
                    found = torch.cat((pose[there], poses.inverse(pose[back])))
                    apart = poses.minus(found.unsqueeze(1), found)
                    close = apart[..., : poses.dim].norm(dim=-1) < _CLOSE[0]
                    close &= apart[..., poses.dim :].norm(dim=-1) < _CLOSE[1]
                    votes = close.sum(-1)
                    best[a, b] = int(votes.max()), found[votes.argmax()]
        placed = {0: poses.identity(pose)}
        while True:
            edges = [e for e in best if (e[0] in placed) != (e[1] in placed)]
            if not edges:
                break
            a, b = max(edges, key=lambda e: best[e][0])
            step = best[a, b][1]
            if a in placed:
                placed[b] = poses.compose(placed[a], step)
            else:
                placed[a] = poses.compose(placed[b], poses.inverse(step))
        return torch.stack([placed.get(j, placed[0]) for j in range(n)])

    def _match_noise(self) -> Any:
        """The noise model of matches, with Huber's loss if that is asked for."""
        gtsam, d = self.gtsam, self.poses.dim
        std = [self.matches.std] * d + [self.matches.turn_std] * (self.poses.dof - d)
        match = self._noise(std)
        if self.robust != "huber":
            return match
        loss = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
        return gtsam.noiseModel.Robust.Create(loss, match)

    def _noise(self, std: Sequence[float]) -> Any:
        """A diagonal noise model; GTSAM puts a rotation in space first."""
        d = self.poses.dim
        std = [max(size, _TIGHT) for size in std]
        ordered = std if d == 2 else [*std[d:], *std[:d]]
        return self.gtsam.noiseModel.Diagonal.Sigmas(torch.tensor(ordered).double().numpy())

    def _to_gtsam(self, pose: Float64[Tensor, "P"]) -> Any:
        x = pose.tolist()
        if self.poses.dim == 2:
            return self.gtsam.Pose2(*x)
        return self.gtsam.Pose3(self.gtsam.Rot3.Quaternion(*x[3:]), x[:3])

    def _from_gtsam(self, values: Any, key: int) -> Float64[Tensor, "P"]:
        if self.poses.dim == 2:
            pose = values.atPose2(key)
            return torch.tensor([pose.x(), pose.y(), pose.theta()], dtype=torch.float64)
        pose = values.atPose3(key)
        turn = pose.rotation().toQuaternion()
        return torch.tensor([*pose.translation(), turn.w(), turn.x(), turn.y(), turn.z()]).double()
