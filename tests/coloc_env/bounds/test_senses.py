"""Fisher information of the senses: of their log-likelihoods, by automatic differentiation."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from scipy.stats import vonmises_fisher
from torch import Tensor

from coloc_env.bounds.information import own_information, shared_information
from coloc_env.geometry import rotate_by, unrotate
from coloc_env.motion import Kinematics, RandomVelocity
from coloc_env.observation import Observation
from coloc_env.sensors import Compass, Light, Magnetic, Rssi, Sensor, UavRssi, Ultrasonic
from tests.coloc_env.bounds.test_posterior import ANCHORS, N, first_step, scenario

ROOM = ((0.0, 0.0, 0.0), (10.0, 8.0, 4.0))
LAMPS = ((2.0, 2.0, 4.0), (8.0, 6.0, 4.0))


def compass(s: Compass, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    w, x, y, z = p.attitude[0].unbind(-1)
    yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return yaw.unsqueeze(-1), seen["compass_mask"][0].double() / s.std**2


def plane_compass(s: Compass, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    return p.attitude[0], seen["compass_mask"][0].double() / s.std**2


def rssi(s: Rssi, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    points = torch.tensor(s.points, dtype=torch.float64)
    d = (p.position[0].unsqueeze(1) - points).norm(dim=-1)
    return -40 - 22 * d.log10(), seen["rssi_mask"][0].double() / 16


def uav_rssi(s: UavRssi, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    pairs = [(i, j) for i in range(N) for j in range(N) if i != j]
    far = torch.stack([(p.position[0, i] - p.position[0, j]).norm() for i, j in pairs])
    mask = torch.stack([seen["uav_rssi_mask"][0, i, j] for i, j in pairs]).double()
    return -40 - 22 * far.log10(), mask / 16


def ultrasonic(s: Ultrasonic, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    """By turning the plane that each beam meets into the body frame."""
    found = []
    for i in range(N):
        x, to = p.position[0, i], torch.tensor(ROOM[1], dtype=torch.float64)
        far = []
        for axis in range(3):
            normal = torch.eye(3, dtype=torch.float64)[axis]
            across = unrotate(p.attitude[0, i], normal)  # component of each body axis along it
            for sign in (1, -1):
                t = torch.where(sign * across > 0, to[axis] - x[axis], -x[axis])
                far.append(torch.stack((t / (sign * across),)))
        each = torch.cat(far).view(3, 2, 3).amin(0)  # [sign, body axis]
        found.append(each.mT.flatten())
    return torch.stack(found), seen["ultrasonic_mask"][0].double() / s.std**2


def magnetic(s: Magnetic, p: Kinematics, seen: Observation) -> tuple[Tensor, Tensor]:
    grid = torch.cartesian_prod(*(torch.arange(n).double() for n in s.nodes))
    nodes = s.field(grid)[0].view(*s.nodes, 3)
    found = []
    for i in range(N):
        x = p.position[0, i]
        total: Tensor = torch.zeros(3, dtype=torch.float64)
        for a in range(s.nodes[0]):
            for b in range(s.nodes[1]):
                for c in range(s.nodes[2]):
                    near = 1 - (x - x.new_tensor((a, b, c))).abs()
                    if bool((near > 0).all()):
                        total = total + near.prod() * nodes[a, b, c]
        found.append(unrotate(p.attitude[0, i], total))
    return torch.stack(found), seen["magnetic_mask"][0].double().expand(N, 3) / s.std**2


CASES: list[tuple[Sensor, int, Callable]] = [
    (Compass(0.1, dropout=0.3), 3, compass),
    (Compass(0.1), 2, plane_compass),
    (Rssi(ANCHORS, dropout=0.3), 3, rssi),
    (Rssi(tuple(a[:2] for a in ANCHORS)), 2, rssi),
    (UavRssi(dropout=0.3), 3, uav_rssi),
    (UavRssi(), 2, uav_rssi),
    (Ultrasonic(ROOM, 0.03, dropout=0.2), 3, ultrasonic),
    (Magnetic(ROOM, 0.5), 3, magnetic),
]


def tilted(sensor: Sensor, dim: int) -> tuple[Kinematics, Observation]:
    truth, seen = first_step(scenario(sensor, dim=dim, motion=RandomVelocity()))
    tilt = torch.tensor([0.3, -0.2, 0.5][: 3 if dim == 3 else 1], dtype=torch.float64)
    return replace(truth, attitude=rotate_by(truth.attitude, tilt.expand(1, N, -1))), seen


def near(truth: Kinematics, delta: Tensor, dim: int) -> Kinematics:
    return Kinematics(
        truth.position + delta[..., :dim],
        truth.velocity,
        rotate_by(truth.attitude, delta[..., dim:]),
    )


@pytest.mark.parametrize("case", CASES, ids=[f"{type(s).__name__}-{d}d" for s, d, _ in CASES])
def test_information_is_that_of_the_log_likelihood(case: tuple[Sensor, int, Callable]) -> None:
    """Hᵀ R⁻¹ H with H by automatic differentiation at ⊞ 0."""
    sensor, dim, predicted = case
    truth, seen = tilted(sensor, dim)
    d = 6 if dim == 3 else 3

    def expect(delta: Tensor) -> tuple[Tensor, Tensor]:
        mean, weight = predicted(sensor, near(truth, delta, dim), seen)
        return mean.flatten(), weight.flatten()

    zero = torch.zeros(1, N, d, dtype=torch.float64)
    jacobian, weights = torch.func.jacrev(expect, has_aux=True)(zero)
    jacobian = jacobian.reshape(-1, N * d)
    assert (weights > 0).any()
    wanted = jacobian.mT @ (weights.unsqueeze(-1) * jacobian)
    if sensor.between_uavs:
        found = shared_information(sensor, truth, seen)[0].flatten(2).flatten(0, 1)
    else:
        found = torch.block_diag(*own_information(sensor, truth, seen)[0])
    torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-6)


def test_information_of_lamps_is_the_expected_curvature_of_their_log_likelihood() -> None:
    """Of N(I, s(I)²) and von Mises–Fisher densities, at their means: E ∂² over what is drawn is
    exact for both, since it is linear in (z, z²) and in the direction."""
    sensor = Light(LAMPS, share=0.3, floor=2.0, angle_std=0.4)
    truth, seen = tilted(sensor, 3)
    lamps = torch.tensor(LAMPS, dtype=torch.float64)
    kappa = 1 / 0.4**2
    length = 1 / math.tanh(kappa) - 1 / kappa
    assert length == pytest.approx(  # scipy's, by its own samples
        float(vonmises_fisher((0, 0, 1), kappa).rvs(50_000, random_state=0)[:, 2].mean()), abs=4e-3
    )

    def model(delta: Tensor, i: int) -> tuple[Tensor, Tensor, Tensor]:
        there = near(truth, delta.view(1, 1, 6).expand(1, N, 6), 3)
        v = lamps - there.position[0, i]
        r = v.norm(dim=-1)
        size = 1000 * v[:, 2] / r / (r**2 + 0.1) + 20
        return size, (0.3 * size) ** 2 + 4, unrotate(there.attitude[0, i], v / r.unsqueeze(-1))

    found = own_information(sensor, truth, seen)[0]
    for i in range(2):
        zero = torch.zeros(6, dtype=torch.float64)
        size, variance, way = model(zero, i)
        mask = seen["light_mask"][0, i].double()

        def expected(delta: Tensor, i: int = i, s=size, v=variance, u=way, m=mask) -> Tensor:
            mean, spread, toward = model(delta, i)
            bright = -0.5 * spread.log() - 0.5 * (v + (s - mean) ** 2) / spread
            return (m * (bright + kappa * length * (u * toward).sum(-1))).sum()

        assert mask.any()
        wanted = -torch.func.hessian(expected)(zero)
        torch.testing.assert_close(found[i], wanted, rtol=1e-6, atol=1e-6)
