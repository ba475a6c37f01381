"""Parts of the Stein filter against closed forms and plain loops."""

import math
from collections import deque
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from agents.stein import consensus
from agents.stein import match_window as window
from agents.stein.likelihood import Scale, factors, fit, outlier_level
from agents.stein.update import kernel, stein_step
from coloc_env.geometry import Poses, Se2, Se3, poses_in

BOTH = pytest.mark.parametrize("poses", [Se2, Se3])
ONE = torch.ones(1, 1, dtype=torch.float64)
SIZE = (0.8, 0.15)  # m, rad: of the Gaussian targets


def some(poses: type[Poses], *shape: int, seed: int = 0, spread: float = 1.0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    xi = spread * torch.randn(*shape, poses.dof, generator=g, dtype=torch.float64)
    return poses.exp(xi)


def one_match(poses: type[Poses], first: int, second: int, pose: Tensor) -> window.MatchWindow:
    new = window.Matches(
        torch.tensor([[[first]]]),
        torch.tensor([[[second]]]),
        pose.view(1, 1, 1, -1),
        torch.ones(1, 1, 1, dtype=torch.bool),
    )
    return window.insert(window.empty(poses, torch.Size((1, 1)), 3, pose), new)


# ---------------------------------------------------------------- Gauss–Newton targets


@BOTH
def test_the_step_is_the_residual_itself(poses: type[Poses]) -> None:
    r = poses.log(some(poses, 200, spread=0.9))
    turned = (poses.right_jacobian(r) @ r.unsqueeze(-1))[..., 0]
    torch.testing.assert_close(turned, r, rtol=0, atol=1e-12)
    solved = torch.linalg.solve(poses.right_jacobian_inverse(r), r)  # (JᵀJ)⁻¹ Jᵀ r for square J
    torch.testing.assert_close(solved, r, rtol=0, atol=1e-12)


@BOTH
@pytest.mark.parametrize("end", [0, 1])
def test_one_match_is_satisfied_by_one_step_at_either_end(poses: type[Poses], end: int) -> None:
    x = some(poses, 1, 1, 3, 20)
    pose = some(poses, 1, seed=1)[0]
    held, scale = one_match(poses, 1, 2, pose), Scale(0.7 * ONE, 0.4 * ONE)
    found = fit(poses, x, held, factors(poses, held, scale, 3), scale, 0 * ONE + 1e-300)
    uav = 1 + end
    size = torch.tensor((poses.dim, poses.dof - poses.dim))
    step = found.steps[:, :, uav] / found.weight[:, :, uav].repeat_interleave(size, -1)
    moved = x.clone()
    moved[:, :, uav] = poses.plus(x[:, :, uav], step)
    between = poses.between(moved[:, :, 1], moved[:, :, 2])
    left = poses.minus(between, pose)
    sure = found.inliers[0, 0, 0] > 0.999  # elsewhere the Gaussian underflows
    assert sure.sum() > 5
    assert float(left[0, 0][sure].abs().max()) < 1e-12
    assert not found.steps[:, :, 0].any()


@BOTH
def test_responsibilities_are_those_of_the_mixture(poses: type[Poses]) -> None:
    """Against the two densities written out."""
    scale, share, volume = Scale(0.3 * ONE, 0.2 * ONE), 0.25, 70.0
    x, pose = some(poses, 1, 1, 2, 50, spread=0.2), some(poses, 1, spread=0.1)[0]
    held = one_match(poses, 0, 1, pose)
    beta = outlier_level(poses, scale, share, volume)
    found = fit(poses, x, held, factors(poses, held, scale, 2), scale, beta)
    r = poses.minus(poses.between(x[0, 0, 0], x[0, 0, 1]), pose)
    d = poses.dim
    std = torch.tensor([0.3] * d + [0.2] * (poses.dof - d), dtype=torch.float64)
    density = torch.exp(torch.distributions.Normal(0.0, std).log_prob(r).sum(-1))
    expected = (1 - share) * density / ((1 - share) * density + share / volume)
    torch.testing.assert_close(found.inliers[0, 0, 0], expected)
    torch.testing.assert_close(
        found.log_density[0, 0] - found.log_density[0, 0, 0],
        torch.log((1 - share) * density + share / volume)
        - torch.log((1 - share) * density[0] + share / volume),
    )


# ---------------------------------------------------------------- Stein steps


def flat(x: Tensor) -> Tensor:
    """Agent 1's cloud [m, 3] of an SE(2) belief, with headings that never get near π."""
    return x[0, 0, 1]


def descend(
    x: Tensor, score: Callable[[Tensor], Tensor], steps: int, repulsion: float = 1.0
) -> Tensor:
    """Stein steps on agent 1 of two, to a target of known score (in units of ``SIZE``)."""
    scale = Scale(SIZE[0] * ONE, SIZE[1] * ONE)
    density = torch.ones(1, 1, x.shape[3], 2, 2, dtype=torch.float64)
    for _ in range(steps):
        shift = score(flat(x))
        heading = flat(x)[:, 2]
        c, s = heading.cos(), heading.sin()
        body = torch.stack(
            (c * shift[:, 0] + s * shift[:, 1], c * shift[:, 1] - s * shift[:, 0], shift[:, 2]), -1
        )
        wanted = torch.stack((torch.zeros_like(body), body), 1)[None, None]
        phi = stein_step(kernel(Se2, x, scale), wanted, density, repulsion).transpose(2, 3)
        moved = Se2.plus(x, 0.3 * phi)
        x = torch.cat((x[:, :, :1], moved[:, :, 1:]), 2)
    return x


def start(m: int) -> Tensor:
    g = torch.Generator().manual_seed(0)
    x = torch.randn(1, 1, 2, m, 3, generator=g, dtype=torch.float64)
    x[:, :, 0] = 0.0
    x[:, :, 1] = x[:, :, 1] * torch.tensor([2.0, 2.0, 0.4]) + torch.tensor([1.0, -1.0, 0.2])
    return x


def discrepancy(cloud: Tensor, score: Tensor) -> float:
    """Kernelized Stein discrepancy with an inverse multiquadric (Gorham & Mackey 2017), written
    out, in whitened coordinates."""
    apart = cloud.unsqueeze(1) - cloud
    squared = apart.square().sum(-1)
    base, d = 1 + squared, cloud.shape[-1]
    k = base**-0.5
    dx = -apart * (base**-1.5).unsqueeze(-1)
    trace = d * base**-1.5 - 3 * squared * base**-2.5
    product = (score.unsqueeze(1) * score).sum(-1) * k
    cross = (dx * score.unsqueeze(0)).sum(-1) - (dx * score.unsqueeze(1)).sum(-1)
    return float((trace + product + cross).mean())


def test_a_gaussian_is_left_with_its_moments_and_the_discrepancy_falls() -> None:
    centre, white = torch.tensor([0.5, 1.0, 0.3]).double(), torch.tensor([0.8, 0.8, 0.15]).double()
    x = start(150)
    before = flat(x).clone()

    def score(cloud: Tensor) -> Tensor:
        return centre - cloud

    x = descend(x, score, 250)
    cloud = (flat(x) - centre) / white
    assert float(cloud.mean(0).abs().max()) < 0.05
    covariance = torch.cov(cloud.T)
    assert float((covariance - torch.eye(3)).abs().max()) < 0.2
    first = (before - centre) / white
    falls = [discrepancy(points, -points) for points in (first, cloud)]
    assert falls[1] < 0.05 * falls[0]


def test_two_modes_stay_two_with_the_right_moments() -> None:
    """In each coordinate's own unit: ½ N(−3, 1) + ½ N(3, 1) along x, N(0, 1) along the others."""
    white = torch.tensor([0.8, 0.8, 0.15]).double()
    modes = torch.tensor([[-3.0, 0.0, 0.0], [3.0, 0.0, 0.0]]).double() * white

    def score(cloud: Tensor) -> Tensor:
        apart = modes - cloud.unsqueeze(1)
        share = (-0.5 * (apart / white).square().sum(-1)).softmax(-1)
        return (share.unsqueeze(-1) * apart).sum(1)

    x = start(200)
    x[:, :, 1, :, :] *= 1.5
    cloud = flat(descend(x, score, 250)) / white
    right = cloud[:, 0] > 0
    assert 0.3 < float(right.double().mean()) < 0.7
    for side, at in ((right, 3.0), (~right, -3.0)):
        assert abs(float(cloud[side, 0].mean()) - at) < 0.3
        assert 0.5 < float(cloud[side, 0].std()) < 1.3
    assert abs(float(cloud[:, 1:].std()) - 1) < 0.25


def test_without_repulsion_particles_fall_onto_the_mode() -> None:
    centre = torch.tensor([0.5, 1.0, 0.3]).double()
    x = descend(start(30), lambda cloud: centre - cloud, 200, repulsion=0.0)
    assert float((flat(x) - centre).abs().max()) < 1e-6


@pytest.mark.parametrize("dim", [2, 3])
def test_repulsion_is_the_kernels_gradient(dim: int) -> None:
    """Against autograd through the kernel by right perturbations of one particle."""
    poses = poses_in(dim)
    x, scale = some(poses, 1, 1, 3, 6), Scale(0.7 * ONE, 0.9 * ONE)
    near = kernel(poses, x, scale)
    zero = torch.zeros(1, 1, 6, 3, poses.dof, dtype=torch.float64)
    density = torch.ones(1, 1, 6, 3, 2, dtype=torch.float64)
    found = stein_step(near, zero, density, 1.0)[0, 0, 2] * near.k[0, 0, 2].sum()

    def total(xi: Tensor) -> Tensor:
        """−Σ_r k(x_2 exp(ξ), x_r): by symmetry its gradient is Σ_r ∇_{x_r} k."""
        moved = poses.plus(x[0, 0, :, 2], xi).unsqueeze(1)
        rest = x[0, 0]
        apart = (poses.split(moved)[0] - poses.split(rest)[0]).square().sum(-1) / 0.7**2
        angle = poses.minus(rest, moved)[..., dim:].square().sum(-1).clamp_min(1e-24).sqrt()
        q = apart + (2 * (0.5 * angle).sin()).square() / 0.9**2
        k = torch.exp(-0.5 * q.sum(0) / near.bandwidth[0, 0])
        return -torch.cat((k[:2], k[3:])).sum()

    gradient = torch.autograd.functional.jacobian(total, torch.zeros(3, poses.dof).double())
    unit = x.new_tensor([0.7**2] * dim + [0.9**2] * (poses.dof - dim))
    torch.testing.assert_close(found, gradient * unit, rtol=1e-8, atol=1e-12)


# ---------------------------------------------------------------- consensus


def scalar_problem(rate: float, steps: int) -> Tensor:
    """Two holders of one number each, f_i = ½ (x − a_i)², as translations of one agent."""
    wanted, gamma = torch.tensor([1.0, 5.0]).double(), 0.3
    c = torch.zeros(1, 2, 2, 1, 3, dtype=torch.float64)
    c[..., 0] = wanted.view(1, 2, 1, 1)
    x = wanted.clone()
    for _ in range(steps):
        received = c.transpose(1, 2)
        dual = torch.stack((received[0, 0, 1, 0, 0], received[0, 1, 0, 0, 0]))
        x = (wanted + gamma * dual) / (1 + gamma)
        estimate = torch.zeros(1, 2, 1, 3, dtype=torch.float64)
        estimate[0, :, 0, 0] = x
        c = consensus.dual_update(Se2, c, received, estimate, rate)
    return x


def test_the_corrected_sign_of_eq_21_agrees_on_the_optimum() -> None:
    assert float((scalar_problem(1.0, 200) - 3.0).abs().max()) < 1e-9


def test_the_printed_sign_of_eq_21_blows_up() -> None:
    early, late = (float(scalar_problem(-1.0, k).abs().max()) for k in (10, 60))
    assert late > 1e4 * early


# ---------------------------------------------------------------- the window


@BOTH
def test_the_window_is_a_queue_that_moves_along(poses: type[Poses]) -> None:
    """Against a deque, and against poses of a team that moves."""
    g = torch.Generator().manual_seed(2)
    n, size = 3, 5
    kept, queue = window.empty(poses, torch.Size((1, 1)), size, some(poses, 1)), deque(maxlen=size)
    team = some(poses, n)
    for step in range(12):
        moved = some(poses, n, seed=step, spread=0.3)
        team = poses.compose(team, moved)
        kept = window.propagate(poses, kept, moved.view(1, 1, n, -1), (0.01, 0.02))
        ends = torch.stack([torch.randperm(n, generator=g)[:2] for _ in range(2)])
        known = torch.rand(2, generator=g) < 0.7
        pose = poses.between(team[ends[:, 0]], team[ends[:, 1]])
        new = window.Matches(*(v[None, None] for v in (ends[:, 0], ends[:, 1], pose, known)))
        kept = window.insert(kept, new)
        queue.extend([(*e, step) for e, t in zip(ends.tolist(), known.tolist(), strict=True) if t])
    held = kept.mask[0, 0]
    found = sorted(
        zip(kept.first[0, 0, held].tolist(), kept.second[0, 0, held].tolist(), strict=True)
    )
    assert found == sorted((i, j) for i, j, _ in queue)
    assert len(queue) == size
    here = poses.between(team[kept.first[0, 0]], team[kept.second[0, 0]])
    assert float(poses.minus(kept.pose[0, 0], here).abs().max()) < 1e-10
    ages = sorted(11 - step for *_, step in queue)
    turns = sorted((kept.added_variance[0, 0, :, 1] / (2 * 0.02**2)).round().long().tolist())
    assert turns == ages


def test_propagated_matches_have_the_variance_stated() -> None:
    """Monte Carlo: T ← D_i⁻¹ T D_j with noisy odometry, about the truth."""
    g, draws, steps = torch.Generator().manual_seed(0), 4000, 10
    std = (0.005, math.radians(0.2))
    pose = torch.tensor([4.0, -3.0, 0.7]).double()
    shape = torch.Size((1, draws))
    noisy = window.empty(Se2, shape, 1, pose)
    new = window.Matches(
        torch.zeros(1, draws, 1, dtype=torch.int64),
        torch.ones(1, draws, 1, dtype=torch.int64),
        pose.expand(1, draws, 1, 3),
        torch.ones(1, draws, 1, dtype=torch.bool),
    )
    noisy = window.insert(noisy, new)
    for _ in range(steps):
        xi = torch.randn(1, draws, 2, 3, generator=g, dtype=torch.float64)
        step = Se2.exp(xi * torch.tensor([std[0], std[0], std[1]]))
        noisy = window.propagate(Se2, noisy, step, std)
    error = Se2.minus(noisy.pose[0, :, 0], pose.expand(draws, 3))
    position = float(error[:, :2].square().sum(-1).mean())
    said = float(noisy.added_variance[0, :, 0, 0].mean())
    across = 2 * steps * 2 * std[0] ** 2 + 25 * steps * std[1] ** 2  # both axes together
    assert abs(position / across - 1) < 0.1
    assert abs(2 * said / position - 1) < 0.1  # per axis
    turn = float(error[:, 2].square().mean())
    assert abs(turn / float(noisy.added_variance[0, :, 0, 1].mean()) - 1) < 0.1
