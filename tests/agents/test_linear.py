"""A linear Gaussian world, where the Kalman filter is the answer: every filter against it.

Truth moves as the team believes; each UAV measures its own position and the way to every other.
"""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from filterpy.kalman import KalmanFilter
from scipy.linalg import block_diag, expm
from torch import Tensor

from agents import make
from agents.models.measurements import Block, Measurement, Neighbours
from agents.models.process import Process, make_process
from coloc_env.observation import Observation
from coloc_env.scenario import Believed

OFFSET = 0.3  # standard deviation of the way to another UAV, m


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
        d = process.dim
        z = observation["offsets"].to(x.dtype).unflatten(-1, (-1, d))
        residual = z - (neighbours.position.to(x.dtype) - x[..., None, :d])
        jacobian = x.new_zeros(*residual.shape, process.error_size)
        jacobian[..., :d] = -torch.eye(d)
        return Block(
            residual,
            jacobian,
            x.new_tensor(OFFSET**2).expand_as(residual),
            (observation["offset_mask"] > 0) & neighbours.known,
            partner=torch.eye(d, dtype=x.dtype).expand(*residual.shape, d),
            partner_variance=neighbours.variance.to(x.dtype).expand_as(residual),
        )


@pytest.fixture
def linear(monkeypatch: pytest.MonkeyPatch, tools: SimpleNamespace) -> SimpleNamespace:
    """The linear world, of whose measurements all filters have these models."""
    models = [tools.linear.fixes, Offsets()]
    for module in ("kalman.ekf", "kalman.ekf_joint", "particle.filter"):
        monkeypatch.setattr(f"agents.{module}.make_measurements", lambda _: models)
    return tools.linear


def worlds(
    linear: Any, count: int, steps: int, seed: int = 0
) -> Iterator[tuple[Tensor, Observation]]:
    """Truth [B, N, 6] and what is seen of it, at each step; a third of it goes missing."""
    g = torch.Generator().manual_seed(seed)
    team, fix = linear.believed, linear.fixes.std
    n, d = team.arena.n_uavs, team.arena.dim

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    process = make_process(team)
    std = torch.tensor([team.prior.position_std] * d + [team.prior.velocity_std] * d).double()
    truth = 5 * normal(count, n, 2 * d)
    mean = truth + std * normal(count, n, 2 * d)
    stated = torch.cat((std[: d + 1], torch.tensor([0.05]))).expand(count, n, -1)
    attitude = torch.zeros(count, n, 4)
    prior = torch.cat((mean, attitude, stated), -1).float()
    truth = truth + (prior[..., : 2 * d] - mean)  # so that rounding leaves the error as it was
    others = (1 - torch.eye(n)).expand(count, n, n)
    dt = torch.full((count, n), team.arena.dt).double()
    for k in range(steps):
        if k:
            truth = process.propagate(truth, truth[..., :0], dt, normal(count, n, 2 * d))
        place = truth[..., :d]
        offsets = place.unsqueeze(1) - place.unsqueeze(2) + OFFSET * normal(count, n, n, d)
        masks = [torch.rand(count, n, m, generator=g) < 0.67 for m in (1, n)]
        leaves = {
            "prior": prior,
            "fix": place + fix * normal(count, n, d),
            "fix_mask": masks[0],
            "offsets": offsets.flatten(-2),
            "offset_mask": masks[1] * others,
            "messages": torch.zeros(count, n, n * 3 * d),
            "message_mask": torch.zeros(count, n, n),
            "links": others,
        }
        yield truth, Observation({name: leaf.float() for name, leaf in leaves.items()})


def run(name: str, linear: Any, count: int, steps: int, seed: int = 0) -> Iterator[SimpleNamespace]:
    """Truth, observation, belief and estimate after each step."""
    localizer, belief = make(name, linear), None
    for truth, seen in worlds(linear, count, steps, seed):
        belief = localizer.reset(seen) if belief is None else belief
        belief, estimate = localizer.step(belief, seen)
        yield SimpleNamespace(truth=truth, seen=seen, belief=belief, estimate=estimate)


# ---------------------------------------------------------------- the textbook


def motion(team: Believed) -> tuple[np.ndarray, np.ndarray]:
    """F and Q of one UAV by Van Loan's method."""
    model, dt = team.process, team.arena.dt
    system = np.array([[0.0, 1.0], [0.0, -1 / model.damping]])
    drive = np.diag([0.0, model.accel_std**2])
    whole = expm(dt * np.block([[-system, drive], [np.zeros((2, 2)), system.T]]))
    f, axes = whole[2:, 2:].T, np.eye(team.arena.dim)
    return np.kron(f, axes), np.kron(f @ whole[:2, 2:], axes)


def rows(linear: Any, seen: Observation, cooperate: bool) -> tuple[np.ndarray, ...]:
    """H, R and z of what world 0 measured, over the team's stacked state [2 d N]."""
    n, d = linear.believed.arena.n_uavs, linear.believed.arena.dim
    h, r, z = [np.zeros((0, 2 * d * n))], [], []
    for i in range(n):
        at = np.zeros((d, n, 2 * d))
        at[:, i, :d] = np.eye(d)
        if seen["fix_mask"][0, i, 0]:
            h.append(at.reshape(d, -1))
            r += [linear.fixes.std**2] * d
            z += seen["fix"][0, i].tolist()
        for j in range(n):
            if cooperate and seen["offset_mask"][0, i, j]:
                way = -at
                way[:, j, :d] = np.eye(d)
                h.append(way.reshape(d, -1))
                r += [OFFSET**2] * d
                z += seen["offsets"][0, i, d * j : d * (j + 1)].tolist()
    return np.concatenate(h), np.diag(r), np.array(z)


def textbook(
    linear: Any, seed: int, steps: int, cooperate: bool
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """filterpy's Kalman filter over the stacked state of world 0: mean and covariance."""
    n, d = linear.believed.arena.n_uavs, linear.believed.arena.dim
    f, q = motion(linear.believed)
    team = KalmanFilter(dim_x=2 * d * n, dim_z=1)
    team.F, team.Q = block_diag(*[f] * n), block_diag(*[q] * n)
    for k, (_, seen) in enumerate(worlds(linear, 1, steps, seed)):
        if k == 0:
            prior = seen["prior"][0].double().numpy()
            std = np.concatenate((prior[:, -d - 2 : -2], prior[:, [-2] * d]), 1)
            team.x, team.P = prior[:, : 2 * d].reshape(-1, 1), np.diag(std.reshape(-1) ** 2)
        else:
            team.predict()
        h, r, z = rows(linear, seen, cooperate)
        if len(z):
            team.dim_z = len(z)
            team.update(z.reshape(-1, 1), R=r, H=h)
        yield team.x[:, 0].copy(), team.P.copy()


def blocks(p: np.ndarray, linear: Any, size: int) -> list[np.ndarray]:
    """The first ``size`` rows and columns of each UAV's own block of a team's covariance."""
    return [p[i : i + size, i : i + size] for i in range(0, len(p), 2 * linear.believed.arena.dim)]


@pytest.mark.parametrize("seed", [0, 1])
def test_ekf_alone_is_the_kalman_filter(seed: int, linear: SimpleNamespace) -> None:
    d = linear.believed.arena.dim
    found = run("ekf:cooperate=false", linear, 1, 40, seed)
    for (x, p), ours in zip(textbook(linear, seed, 40, False), found, strict=True):
        np.testing.assert_allclose(ours.belief.state[0].flatten(), x, rtol=0, atol=1e-9)
        own = blocks(p, linear, 2 * d)
        np.testing.assert_allclose(ours.belief.covariance[0], own, rtol=0, atol=1e-9)
        place = x.reshape(-1, 2 * d)[:, :d]
        np.testing.assert_allclose(ours.estimate.position[0], place, atol=1e-9)


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_joint_ekf_is_the_kalman_filter_of_the_team(
    iterations: int, linear: SimpleNamespace
) -> None:
    found = run(f"ekf_joint:iterations={iterations}", linear, 1, 40)
    for (x, p), ours in zip(textbook(linear, 0, 40, True), found, strict=True):
        np.testing.assert_allclose(ours.belief.state[0].flatten(), x, rtol=0, atol=1e-9)
        joint = ours.belief.covariance[0].reshape(len(p), len(p))
        np.testing.assert_allclose(joint, p, rtol=0, atol=1e-9)
        own = blocks(p, linear, linear.believed.arena.dim)
        np.testing.assert_allclose(ours.estimate.covariance[0], own, rtol=0, atol=1e-9)


def test_robust_filters_leave_honest_measurements_alone(linear: SimpleNamespace) -> None:
    """A gate that lets everything pass changes nothing."""
    plain = run("ekf:cooperate=false", linear, 4, 10)
    gated = run("ekf:cooperate=false:robust=gate:gate=0.999999999", linear, 4, 10)
    for one, other in zip(plain, gated, strict=True):
        torch.testing.assert_close(one.belief.state, other.belief.state, rtol=0, atol=1e-12)


# ---------------------------------------------------------------- particles


def distance_to_kalman(name: str, particles: int, linear: Any) -> tuple[float, float]:
    """Root mean square difference of mean and of variance from the Kalman filter, in its σ, σ²."""
    kalman = run("ekf:cooperate=false", linear, 15, 10)
    sampled = run(f"{name}:particles={particles}:cooperate=false", linear, 15, 10)
    mean, variance = [], []
    for exact, ours in zip(kalman, sampled, strict=True):
        spread = exact.estimate.covariance.diagonal(dim1=-2, dim2=-1)
        mean.append((ours.estimate.position - exact.estimate.position) / spread.sqrt())
        theirs = ours.estimate.covariance.diagonal(dim1=-2, dim2=-1)
        variance.append(theirs / spread - 1)
    return tuple(float(torch.stack(x).square().mean().sqrt()) for x in (mean, variance))


@pytest.mark.parametrize(
    "name",
    [
        "pf800",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("pf_auxiliary", "pf_mixture:carried=0", "pf_rao_blackwell")
        ),
    ],
)
def test_particles_tend_to_the_kalman_filter(name: str, linear: SimpleNamespace) -> None:
    few, many = (distance_to_kalman(name, m, linear) for m in (100, 6400))
    assert many[0] < 0.045
    assert many[1] < 0.06
    for less, more in zip(many, few, strict=True):
        assert 4 < more / less < 16  # √64 = 8


# ---------------------------------------------------------------- consistency


def nees(name: str, linear: Any, count: int, steps: int) -> Tensor:
    """NEES of the position [B, K, N]."""
    found, d = [], linear.believed.arena.dim
    for now in run(name, linear, count, steps):
        error = now.truth[..., :d] - now.estimate.position.double()
        solved = torch.linalg.solve(now.estimate.covariance.double(), error)
        found.append((error * solved).sum(-1))
    return torch.stack(found, 1)


@pytest.mark.parametrize("name", ["ekf:cooperate=false", "ekf_joint:cooperate=false"])
def test_errors_are_as_large_as_a_filter_says(
    name: str, linear: SimpleNamespace, tools: SimpleNamespace
) -> None:
    found = nees(name, linear, 100, 60)
    assert tools.consistent(found, linear.believed.arena.dim) > 0.85


def test_errors_of_a_team_are_as_large_as_the_joint_filter_says(
    linear: SimpleNamespace, tools: SimpleNamespace
) -> None:
    found = []
    for now in run("ekf_joint", linear, 100, 60):
        error = (now.truth - now.belief.state).flatten(1)
        joint = now.belief.covariance.reshape(*error.shape, -1)
        found.append((error * torch.linalg.solve(joint, error)).sum(-1, keepdim=True))
    assert tools.consistent(torch.stack(found, 1), error.shape[1]) > 0.85


def test_errors_are_as_large_as_particles_say(
    linear: SimpleNamespace, tools: SimpleNamespace
) -> None:
    found = nees("pf800:cooperate=false", linear, 30, 25)
    assert tools.consistent(found, linear.believed.arena.dim) > 0.7
