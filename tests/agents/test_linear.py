"""A linear Gaussian world, where the Kalman filter is the answer: every filter against it.

Truth moves as the team believes; each UAV measures its own position and the way to every other.
"""

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from scipy.linalg import block_diag, expm
from torch import Tensor

from agents import Localizer, make
from agents.models.measurements import Block, Measurement, Neighbours
from agents.models.process import Process, make_process
from coloc_env.motion import Arena
from coloc_env.observation import Observation
from coloc_env.scenario import Believed, ConstantVelocity, Prior

N, D, DT = 3, 3, 0.5
ACCEL, DAMPING = 0.6, 2.0
FIX, OFFSET = 0.8, 0.3  # standard deviations of what is measured, m
PRIOR = Prior(position_std=1.5, velocity_std=0.5)
BELIEVED = Believed(
    arena=Arena(D, N, DT, (-50.0,) * D, (50.0,) * D),
    slots=N,
    process=ConstantVelocity(ACCEL, DAMPING),
    sensors=(),
    prior=PRIOR,
)


class Fixes(Measurement):
    """z = p + noise."""

    def linearize(
        self,
        process: Process,
        x: Tensor,
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        residual = observation["fix"].to(x.dtype).unsqueeze(-2) - x[..., None, :D]
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., :D] = torch.eye(D)
        variance = x.new_tensor(FIX**2).expand_as(residual)
        return Block(residual, jacobian, variance, observation["fix_mask"] > 0)


class Offsets(Measurement):
    """z = p_j − p + noise for the UAV j in each slot."""

    cooperative = True

    def linearize(
        self,
        process: Process,
        x: Tensor,
        observation: Observation,
        neighbours: Neighbours,
        derivatives: bool = True,
    ) -> Block:
        z = observation["offsets"].to(x.dtype).unflatten(-1, (-1, D))
        residual = z - (neighbours.position.to(x.dtype) - x[..., None, :D])
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., :D] = -torch.eye(D)
        return Block(
            residual,
            jacobian,
            x.new_tensor(OFFSET**2).expand_as(residual),
            (observation["offset_mask"] > 0) & neighbours.known,
            partner=torch.eye(D, dtype=x.dtype).expand(*residual.shape, D),
            partner_variance=neighbours.variance.to(x.dtype).expand_as(residual),
        )


@pytest.fixture(autouse=True)
def _linear(monkeypatch: pytest.MonkeyPatch) -> None:
    """These models for all filters."""
    for module in ("ekf", "ekf_joint", "pf"):
        monkeypatch.setattr(f"agents.{module}.make_measurements", lambda _: [Fixes(), Offsets()])


def build(name: str) -> Localizer:
    return make(name, SimpleNamespace(believed=BELIEVED))  # type: ignore[arg-type]


def worlds(count: int, steps: int, seed: int = 0) -> Iterator[tuple[Tensor, Observation]]:
    """Truth [B, N, 6] and what is seen of it, at each step; a third of it goes missing."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    process = make_process(BELIEVED)
    std = torch.tensor([PRIOR.position_std] * D + [PRIOR.velocity_std] * D).double()
    truth = 5 * normal(count, N, 2 * D)
    told = truth + std * normal(count, N, 2 * D)
    stated = torch.cat((std[: D + 1], torch.tensor([0.05]))).expand(count, N, -1)
    attitude = torch.zeros(count, N, 4)
    prior = torch.cat((told, attitude, stated), -1).float()
    truth = truth + (prior[..., : 2 * D] - told)  # so that rounding leaves the error as it was
    others = (1 - torch.eye(N)).expand(count, N, N)
    dt = torch.full((count, N), DT).double()
    for k in range(steps):
        if k:
            truth = process.propagate(truth, truth[..., :0], dt, normal(count, N, 2 * D))
        place = truth[..., :D]
        offsets = place.unsqueeze(1) - place.unsqueeze(2) + OFFSET * normal(count, N, N, D)
        masks = [torch.rand(count, N, m, generator=g) < 0.67 for m in (1, N)]
        leaves = {
            "prior": prior,
            "fix": place + FIX * normal(count, N, D),
            "fix_mask": masks[0],
            "offsets": offsets.flatten(-2),
            "offset_mask": masks[1] * others,
            "messages": torch.zeros(count, N, N * 3 * D),
            "message_mask": torch.zeros(count, N, N),
            "links": others,
        }
        yield truth, Observation({name: leaf.float() for name, leaf in leaves.items()})


def run(localizer: Localizer, count: int, steps: int, seed: int = 0) -> Iterator[SimpleNamespace]:
    """Truth, observation, belief and estimate after each step."""
    belief = None
    for truth, seen in worlds(count, steps, seed):
        belief = localizer.reset(seen) if belief is None else belief
        belief, estimate = localizer.step(belief, seen)
        yield SimpleNamespace(truth=truth, seen=seen, belief=belief, estimate=estimate)


# ---------------------------------------------------------------- the textbook


def motion() -> tuple[np.ndarray, np.ndarray]:
    """F and Q of one UAV by Van Loan's method."""
    system = np.array([[0.0, 1.0], [0.0, -1 / DAMPING]])
    drive = np.diag([0.0, ACCEL**2])
    whole = expm(DT * np.block([[-system, drive], [np.zeros((2, 2)), system.T]]))
    f = whole[2:, 2:].T
    return np.kron(f, np.eye(D)), np.kron(f @ whole[:2, 2:], np.eye(D))


def rows(seen: Observation, cooperate: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """H, R and z of what world 0 measured, over the team's stacked state [6 N]."""
    h, r, z = [], [], []
    for i in range(N):
        at = np.zeros((D, N, 2 * D))
        at[:, i, :D] = np.eye(D)
        if seen["fix_mask"][0, i, 0]:
            h.append(at.reshape(D, -1))
            r += [FIX**2] * D
            z += seen["fix"][0, i].tolist()
        for j in range(N):
            if cooperate and seen["offset_mask"][0, i, j]:
                way = -at
                way[:, j, :D] = np.eye(D)
                h.append(way.reshape(D, -1))
                r += [OFFSET**2] * D
                z += seen["offsets"][0, i, D * j : D * (j + 1)].tolist()
    return np.concatenate([np.zeros((0, 2 * D * N)), *h]), np.diag(r), np.array(z)


def textbook(seed: int, steps: int, cooperate: bool) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """filterpy's Kalman filter over the stacked state of world 0: mean and covariance."""
    f, q = motion()
    team = KalmanFilter(dim_x=2 * D * N, dim_z=1)
    team.F, team.Q = block_diag(*[f] * N), block_diag(*[q] * N)
    for k, (_, seen) in enumerate(worlds(1, steps, seed)):
        if k == 0:
            prior = seen["prior"][0].double().numpy()
            std = np.concatenate((prior[:, -D - 2 : -2], prior[:, [-2] * D]), 1)
            team.x, team.P = prior[:, : 2 * D].reshape(-1, 1), np.diag(std.reshape(-1) ** 2)
        else:
            team.predict()
        h, r, z = rows(seen, cooperate)
        if len(z):
            team.dim_z = len(z)
            team.update(z.reshape(-1, 1), R=r, H=h)
        yield team.x[:, 0].copy(), team.P.copy()


@pytest.mark.parametrize("seed", [0, 1])
def test_ekf_alone_is_the_kalman_filter(seed: int) -> None:
    found = run(build("ekf:cooperate=false"), 1, 40, seed)
    for (x, p), ours in zip(textbook(seed, 40, False), found, strict=True):
        np.testing.assert_allclose(ours.belief.state[0].flatten(), x, rtol=0, atol=1e-9)
        blocks = [p[i : i + 2 * D, i : i + 2 * D] for i in range(0, len(p), 2 * D)]
        np.testing.assert_allclose(ours.belief.covariance[0], blocks, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.estimate.position[0], x.reshape(N, -1)[:, :D], atol=1e-9)


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_joint_ekf_is_the_kalman_filter_of_the_team(iterations: int) -> None:
    found = run(build(f"ekf_joint:iterations={iterations}"), 1, 40)
    for (x, p), ours in zip(textbook(0, 40, True), found, strict=True):
        np.testing.assert_allclose(ours.belief.state[0].flatten(), x, rtol=0, atol=1e-9)
        joint = ours.belief.covariance[0].reshape(len(p), len(p))
        np.testing.assert_allclose(joint, p, rtol=0, atol=1e-9)
        own = [p[i : i + D, i : i + D] for i in range(0, len(p), 2 * D)]
        np.testing.assert_allclose(ours.estimate.covariance[0], own, rtol=0, atol=1e-9)


def test_robust_filters_leave_honest_measurements_alone() -> None:
    """A gate that lets everything pass changes nothing."""
    plain = run(build("ekf:cooperate=false"), 4, 10)
    gated = run(build("ekf:cooperate=false:robust=gate:gate=0.999999999"), 4, 10)
    for one, other in zip(plain, gated, strict=True):
        torch.testing.assert_close(one.belief.state, other.belief.state, rtol=0, atol=1e-12)


# ---------------------------------------------------------------- particles


def distance_to_kalman(particles: int) -> tuple[float, float]:
    """Root mean square difference of mean and of variance from the Kalman filter, in its σ, σ²."""
    pf = build(f"pf800:particles={particles}:cooperate=false")
    mean, variance = [], []
    for exact, ours in zip(run(build("ekf:cooperate=false"), 15, 10), run(pf, 15, 10), strict=True):
        spread = exact.estimate.covariance.diagonal(dim1=-2, dim2=-1)
        mean.append((ours.estimate.position - exact.estimate.position) / spread.sqrt())
        theirs = ours.estimate.covariance.diagonal(dim1=-2, dim2=-1)
        variance.append(theirs / spread - 1)
    return tuple(float(torch.stack(x).square().mean().sqrt()) for x in (mean, variance))


def test_particles_tend_to_the_kalman_filter() -> None:
    few, many = distance_to_kalman(100), distance_to_kalman(6400)
    assert many[0] < 0.045
    assert many[1] < 0.06
    for less, more in zip(many, few, strict=True):
        assert 4 < more / less < 16  # √64 = 8


# ---------------------------------------------------------------- consistency


@pytest.mark.parametrize("name", ["ekf:cooperate=false", "ekf_joint:cooperate=false"])
def test_errors_are_as_large_as_a_filter_says(name: str, tools: SimpleNamespace) -> None:
    nees = []
    for now in run(build(name), 100, 60):
        error = now.truth[..., :D] - now.estimate.position
        solved = torch.linalg.solve(now.estimate.covariance, error)
        nees.append((error * solved).sum(-1))
    assert tools.consistent(torch.stack(nees, 1), D) > 0.85


def test_errors_of_a_team_are_as_large_as_the_joint_filter_says(tools: SimpleNamespace) -> None:
    nees = []
    for now in run(build("ekf_joint"), 100, 60):
        error = (now.truth - now.belief.state).flatten(1)
        joint = now.belief.covariance.reshape(100, 6 * N, 6 * N)
        nees.append((error * torch.linalg.solve(joint, error)).sum(-1, keepdim=True))
    assert tools.consistent(torch.stack(nees, 1), 6 * N) > 0.85


def test_errors_are_as_large_as_particles_say(tools: SimpleNamespace) -> None:
    nees = []
    for now in run(build("pf800:cooperate=false"), 30, 25):
        error = now.truth[..., :D] - now.estimate.position.double()
        solved = torch.linalg.solve(now.estimate.covariance.double(), error)
        nees.append((error * solved).sum(-1))
    assert tools.consistent(torch.stack(nees, 1), D) > 0.7
