"""Increments of IMUs as a group against GTSAM, and relative states against strapdown worlds."""

import numpy as np
import pytest
import torch
from torch import Tensor

from agents.models.preintegration import predict, preintegrate
from agents.stein import inertial_window as windows
from agents.stein.galilean import Galilean, RelativeStates, coasted, propagate
from agents.stein.inertial_target import inertial_target
from agents.stein.inertial_window import InertialNoise, InertialWindow
from agents.stein.likelihood import Scale
from agents.stein.match_window import Matches
from agents.stein.odometry import Motion
from agents.stein.target import Pull
from coloc_env.geometry import Se3, unrotate
from coloc_env.sensors import GRAVITY

DT, SAMPLES, UAVS = 0.02, 48, 3
CLOSE = {"rtol": 0, "atol": 1e-7}


def imus(seed: int = 0) -> Tensor:
    """Samples of a team's IMUs: some g, and tumbling."""
    g = torch.Generator().manual_seed(seed)
    level = torch.tensor((0.0, 0.0, GRAVITY, 0.0, 0.0, 0.5)).double()
    return level + 2 * torch.randn(UAVS, SAMPLES, 6, generator=g).double()


def increments(imu: Tensor) -> Tensor:
    held = torch.full(imu.shape[:-1], DT, dtype=torch.float64)
    found = preintegrate(imu, held, torch.zeros_like(imu[..., 0, :]), 0.0, 0.0)
    return torch.cat((found.increments, found.duration.unsqueeze(-1)), -1)


def start() -> Tensor:
    """[p, v, q] of a team in the world."""
    x = torch.randn(UAVS, 10, generator=torch.Generator().manual_seed(5)).double()
    return torch.cat((x[:, :6], torch.nn.functional.normalize(x[:, 6:], dim=-1)), -1)


def relative(x: Tensor) -> Tensor:
    """The states of ``galilean`` of [p, v, q] in the world."""
    pose = torch.cat((x[..., :3], x[..., 6:]), -1)
    first, apart = pose[:1].expand_as(pose), x[..., 3:6] - x[:1, 3:6]
    return torch.cat((Se3.between(first, pose), unrotate(first[..., 3:], apart)), -1)


def test_increments_compose_as_gtsam_integrates_on() -> None:
    gtsam = pytest.importorskip("gtsam")
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY)
    whole, imu = gtsam.PreintegratedImuMeasurementsManifold(params), imus()[0]
    for sample in imu.numpy():
        whole.integrateMeasurement(sample[:3], sample[3:], DT)
    early, late = increments(imu[:17]), increments(imu[17:])
    found = Galilean.compose(early, late)
    np.testing.assert_allclose(found[:3], whole.deltaPij(), atol=1e-9)
    np.testing.assert_allclose(found[3:6], whole.deltaVij(), atol=1e-9)
    turn = whole.deltaRij().toQuaternion()
    sign = np.sign(turn.w() * float(found[6]))
    expected = sign * np.array((turn.w(), turn.x(), turn.y(), turn.z()))
    np.testing.assert_allclose(found[6:10], expected, atol=1e-9)
    torch.testing.assert_close(Galilean.between(early, found), late, **CLOSE)
    torch.testing.assert_close(found, increments(imu), **CLOSE)


def test_gravity_and_uav_0s_own_velocity_are_not_needed() -> None:
    """States relative to UAV 0 move as those of UAVs that fall in the world."""
    moved, x = increments(imus()), start()
    after = relative(predict(x, moved[:, :10], moved[:, 10]))
    found = propagate(relative(x), moved, moved[0, 10])
    torch.testing.assert_close(
        RelativeStates.minus(found, after), torch.zeros(3, 9).double(), **CLOSE
    )


def test_motion_that_is_heard_late_is_caught_up_with() -> None:
    """UAV 1 is heard in every third step, UAV 2 at the end alone."""
    imu, x, step = imus(), start(), 8
    after = predict(x, increments(imu)[:, :10], torch.full((3,), SAMPLES * DT).double())
    state, heard = relative(x), [0, 0, 0]
    for k in range(step, SAMPLES + 1, step):
        moved = Galilean.identity(x).repeat(3, 1)
        for uav, every in enumerate((step, 3 * step, SAMPLES)):
            if k % every == 0:
                moved[uav] = increments(imu[uav, heard[uav] : k])
                heard[uav] = k
        state = propagate(state, moved, torch.tensor(step * DT).double())
    off = RelativeStates.minus(state, relative(after))
    torch.testing.assert_close(off, torch.zeros_like(off), **CLOSE)


def test_tangents_lead_back() -> None:
    one, other = relative(start()), relative(start().flip(0))
    back = RelativeStates.plus(one, RelativeStates.minus(other, one))
    torch.testing.assert_close(
        RelativeStates.minus(back, other), torch.zeros(3, 9).double(), **CLOSE
    )


# ------------------------------------------------------------------ the window

NOISE = InertialNoise((0.05, 0.03), 0.05, 0.003, 0.0, 0.0, 0.1)


def window_of(
    before: Tensor, moved: Tensor, noise: Tensor, first: int, second: int
) -> InertialWindow:
    """A match of B teams, with ``noise``, after each of K ``moved`` [B, K, N, 11]."""
    b = len(before)
    pose = Se3.plus(Se3.between(before[:, first, :7], before[:, second, :7]), noise)
    one, other = (torch.full((b, 1, 1), i) for i in (first, second))
    new = Matches(one, other, pose[:, None, None], torch.ones(b, 1, 1, dtype=torch.bool))
    window = windows.insert(windows.empty(torch.Size((b, 1)), 1, before), new, NOISE)
    steps, dt = torch.ones(b, 1, UAVS, dtype=torch.int64), torch.full((b, 1), 0.1).double()
    for k in range(moved.shape[1]):
        window = windows.propagate(window, Motion(moved[:, k, None], steps), dt, NOISE)
    return window


def test_what_a_match_says_later_and_how_surely() -> None:
    """The covariance of a match as it is now, against 4000 draws of its noise and the IMUs'."""
    draws, steps = 4000, 8
    g = torch.Generator().manual_seed(1)
    clean = increments(imus().unflatten(1, (steps, -1))[:, :, :5]).transpose(0, 1)
    before = relative(start()).expand(draws, -1, -1)
    after = before
    for k in range(steps):
        after = propagate(after, clean[k].expand(draws, -1, -1), torch.full((draws,), 0.1).double())
    white = torch.randn(draws, steps, UAVS, 6, generator=g).double()
    white = white * white.new_tensor([0.05 * 0.1] * 3 + [0.003 * 0.1] * 3)
    moved = Galilean.perturb(clean, torch.cat((0.05 * white[..., :3], white), -1))
    match = torch.randn(draws, 6, generator=g).double()
    match = match * match.new_tensor([0.05] * 3 + [0.03] * 3)
    window = window_of(before, moved, match, 1, 2)
    ends = [coasted(after[:, uav], window.age[:, 0, 0]) for uav in (1, 2)]
    off = Se3.minus(Se3.between(*ends), window.pose[:, 0, 0])
    whitened = torch.linalg.solve_triangular(
        torch.linalg.cholesky(window.covariance[0, 0, 0]), off.mT, upper=False
    )
    eye = torch.eye(6).double()
    torch.testing.assert_close(whitened @ whitened.mT / draws, eye, rtol=0, atol=0.08)


@pytest.mark.parametrize(("first", "second"), [(1, 2), (0, 1), (2, 0)])
def test_its_derivatives_against_finite_differences(first: int, second: int) -> None:
    moved = increments(imus().unflatten(1, (8, -1))[:, :, :5]).transpose(0, 1)
    before = relative(start())[None]
    after = before
    for k in range(8):
        after = propagate(after, moved[k][None], torch.full((1,), 0.1).double())
    window = window_of(before, moved[None], torch.zeros(1, 6).double(), first, second)
    one = torch.ones(1, 1, dtype=torch.float64)
    target = inertial_target(
        window,
        Scale(0.05 * one, 0.03 * one),
        UAVS,
        match=NOISE.match,
        outliers=0.2,
        volume=1e3,
        velocity_std=1.0,
        uniform=(1.0,) * 6,
        pull=Pull(1.0, True, 0.0),
    )

    def residual(delta: Tensor) -> Tensor:
        moved = torch.cat((after[:, :1], RelativeStates.plus(after[:, 1:], delta)), 1)
        ends = [coasted(moved[:, uav], window.age[:, 0, 0]) for uav in (first, second)]
        return Se3.minus(Se3.between(*ends), window.pose[:, 0, 0])[0]

    numeric = torch.zeros(6, 18).double()
    for column in range(18):
        delta = torch.zeros(1, 18).double()
        delta[0, column] = 1e-5
        up, down = (residual(s * delta.unflatten(-1, (2, 9))) for s in (1, -1))
        numeric[:, column] = (up - down) / 2e-5
    torch.testing.assert_close(target.jacobian[0, 0, 0], numeric, rtol=0, atol=1e-6)
