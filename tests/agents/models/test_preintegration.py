"""Pre-integrated IMU against GTSAM, the paper's recursion, strapdown steps and derivatives."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from agents.models.preintegration import Preintegrated, perturb, predict, preintegrate
from agents.models.process import InertialProcess
from coloc_env.datasets import DataError, dataset_folder, load_euroc
from coloc_env.geometry import quaternion_matrix, rotation_between, so3
from coloc_env.scenario import Inertial
from coloc_env.sensors import GRAVITY, Imu

DT = 0.005
ACCEL, GYRO = 2.0e-3 / DT**0.5, 1.6968e-4 / DT**0.5  # of a sample, as EuRoC's sensor.yaml has it
BIAS = torch.tensor([0.02, 0.1, 0.05, -0.002, 0.02, 0.07], dtype=torch.float64)


def euroc(count: int, length: int) -> Tensor:
    """Windows of V1_03_difficult, evenly over the flight."""
    try:
        table = load_euroc(dataset_folder("euroc") / "V1_03_difficult").streams["imu"][0]
    except DataError as error:
        pytest.skip(str(error))
    imu = torch.from_numpy(table.values[:, [3, 4, 5, 0, 1, 2]])
    starts = torch.linspace(0, len(imu) - length, count).long()
    return torch.stack([imu[start : start + length] for start in starts.tolist()])


def tumbling(count: int, length: int) -> Tensor:
    """A specific force of some g and a rate of several rad/s, both changing smoothly."""
    g = torch.Generator().manual_seed(count)
    walk = torch.randn(count, length, 6, generator=g, dtype=torch.float64).cumsum(1)
    level = torch.tensor([0.0, 0.0, GRAVITY, 0.0, 0.0, 3.0], dtype=torch.float64)
    return level + 0.3 * walk


def integrate(imu: Tensor, bias: Tensor = BIAS) -> Preintegrated:
    dt = torch.full(imu.shape[:-1], DT, dtype=torch.float64)
    return preintegrate(imu, dt, bias.expand(*imu.shape[:-2], 6), ACCEL, GYRO)


def error(found: Tensor, expected: Tensor) -> Tensor:
    """``found ⊟ expected``: [δp, δv, δφ]."""
    turn = rotation_between(expected[..., 6:], found[..., 6:])
    return torch.cat((found[..., :6] - expected[..., :6], turn), -1)


def same_covariance(found: Tensor, expected: np.ndarray, tolerance: float) -> None:
    """Equal entry by entry, each in units of its two standard deviations."""
    std = np.sqrt(np.diag(expected))
    difference = (found.numpy() - expected) / np.outer(std, std)
    assert np.abs(difference).max() < tolerance


# ---------------------------------------------------------------- against GTSAM and the paper


@pytest.mark.parametrize("flight", [euroc, tumbling])
@pytest.mark.parametrize("length", [1, 37, 200])
def test_gtsam(flight: Callable[[int, int], Tensor], length: int) -> None:
    """GTSAM's manifold type, the paper's; its errors of p and v are in the end's axes."""
    gtsam = pytest.importorskip("gtsam", reason="the `oracles` extra has gtsam")
    settings = gtsam.PreintegrationParams.MakeSharedU(GRAVITY)
    settings.setAccelerometerCovariance(np.eye(3) * ACCEL**2 * DT)
    settings.setGyroscopeCovariance(np.eye(3) * GYRO**2 * DT)
    settings.setIntegrationCovariance(np.zeros((3, 3)))
    imu = flight(5, length)
    found = integrate(imu)
    start = torch.tensor([1.0, -2.0, 3.0, 0.5, 0.6, -0.7, 0.5, 0.5, -0.5, 0.5]).double()
    other = BIAS + torch.tensor([0.02, -0.01, 0.03, 0.004, 0.002, -0.003])
    ours = predict(start, found.corrected(other), found.duration)
    hat, new = (gtsam.imuBias.ConstantBias(b[:3].numpy(), b[3:].numpy()) for b in (BIAS, other))
    state = gtsam.NavState(gtsam.Rot3.Quaternion(*start[6:].tolist()), start[:3], start[3:6])
    for i, samples in enumerate(imu.numpy()):
        theirs = gtsam.PreintegratedImuMeasurementsManifold(settings, hat)
        for sample in samples:
            theirs.integrateMeasurement(sample[:3], sample[3:], DT)
        increments = found.increments[i]
        np.testing.assert_allclose(increments[:3], theirs.deltaPij(), atol=1e-11)
        np.testing.assert_allclose(increments[3:6], theirs.deltaVij(), atol=1e-11)
        turn = theirs.deltaRij().matrix()
        np.testing.assert_allclose(quaternion_matrix(increments[6:]), turn, atol=1e-11)
        axes = np.zeros((9, 9))  # from their [φ, p, v] to our [p, v, φ]
        axes[:3, 3:6], axes[3:6, 6:], axes[6:, :3] = turn, turn, np.eye(3)
        same_covariance(found.covariance[i], axes @ theirs.preintMeasCov() @ axes.T, 1e-8)
        reached = theirs.predict(state, new)
        np.testing.assert_allclose(ours[i, :3], reached.position(), atol=1e-11)
        np.testing.assert_allclose(ours[i, 3:6], reached.velocity(), atol=1e-11)
        matrix = reached.attitude().matrix()
        np.testing.assert_allclose(quaternion_matrix(ours[i, 6:]), matrix, atol=1e-11)


@pytest.mark.parametrize("length", [1, 2, 31, 64])
def test_recursions_of_the_paper(length: int) -> None:
    """Eqs. 35 and 63 and appendix B, a sample at a time, rotations by scipy."""
    imu = tumbling(1, length)[0]
    found = integrate(imu)
    p, v, r = np.zeros(3), np.zeros(3), np.eye(3)
    covariance, by_bias = np.zeros((9, 9)), np.zeros((9, 6))
    q = np.diag([ACCEL**2] * 3 + [GYRO**2] * 3)
    for sample in (imu - BIAS).numpy():
        turn = sample[3:] * DT
        step = Rotation.from_rotvec(turn).as_matrix()
        skew = np.cross(np.eye(3), sample[:3])
        a, b = np.eye(9), np.zeros((9, 6))
        a[:3, 3:6], a[:3, 6:] = DT * np.eye(3), -0.5 * r @ skew * DT**2
        a[3:6, 6:], a[6:, 6:] = -r @ skew * DT, step.T
        b[:3, :3], b[3:6, :3] = 0.5 * r * DT**2, r * DT
        b[6:, 3:] = so3.right_jacobian(torch.from_numpy(turn)).numpy() * DT
        covariance, by_bias = a @ covariance @ a.T + b @ q @ b.T, a @ by_bias - b
        p = p + v * DT + 0.5 * r @ sample[:3] * DT**2
        v = v + r @ sample[:3] * DT
        r = r @ step
    np.testing.assert_allclose(found.increments[:3], p, atol=1e-13)
    np.testing.assert_allclose(found.increments[3:6], v, atol=1e-13)
    np.testing.assert_allclose(quaternion_matrix(found.increments[6:]), r, atol=1e-13)
    same_covariance(found.covariance, covariance, 1e-11)
    np.testing.assert_allclose(found.bias_jacobian, by_bias, atol=1e-13)


def test_prediction_is_strapdown_integration() -> None:
    """The steps of ``InertialProcess``, gravity and a start in motion included."""
    imu = tumbling(3, 50)
    process = InertialProcess(DT, Imu(accel_std=ACCEL, gyro_std=GYRO), Inertial())
    start = torch.tensor([1.0, -2.0, 3.0, 0.5, 0.6, -0.7, 0.5, 0.5, -0.5, 0.5]).double()
    x = start.expand(3, 10)
    for sample in imu.unbind(1):
        x = process.propagate(x, sample, torch.full((3,), DT, dtype=torch.float64))
    found = integrate(imu, torch.zeros(6, dtype=torch.float64))
    reached = predict(start, found.increments, found.duration)
    torch.testing.assert_close(reached, x, rtol=0, atol=1e-12)


# ---------------------------------------------------------------- derivatives


def test_covariance_is_that_of_every_samples_noise() -> None:
    imu = tumbling(1, 6)[0]
    at = integrate(imu).increments
    jacobian = torch.autograd.functional.jacobian(lambda u: error(integrate(u).increments, at), imu)
    std = torch.tensor([ACCEL] * 3 + [GYRO] * 3, dtype=torch.float64)
    noise = (jacobian * std).flatten(1)
    same_covariance(integrate(imu).covariance, (noise @ noise.mT).numpy(), 1e-12)


def test_covariance_of_drawn_noise() -> None:
    imu = tumbling(1, 40)
    g = torch.Generator().manual_seed(7)
    std = torch.tensor([ACCEL] * 3 + [GYRO] * 3, dtype=torch.float64)
    drawn = imu + std * torch.randn(2000, 40, 6, generator=g, dtype=torch.float64)
    errors = error(integrate(drawn).increments, integrate(imu).increments)
    same_covariance(integrate(imu).covariance[0], np.cov(errors.numpy().T), 0.09)  # 4 / √2000


@pytest.mark.parametrize("flight", [euroc, tumbling])
def test_bias_jacobian_is_the_derivative(flight: Callable[[int, int], Tensor]) -> None:
    imu = flight(4, 100)
    found, step = integrate(imu), 1e-5
    columns = []
    for shift in step * torch.eye(6, dtype=torch.float64):
        up, down = (integrate(imu, BIAS + s * shift).increments for s in (1, -1))
        columns.append(error(up, found.increments) - error(down, found.increments))
    numeric = torch.stack(columns, -1) / (2 * step)
    torch.testing.assert_close(found.bias_jacobian, numeric, rtol=0, atol=1e-8)


@pytest.mark.parametrize("flight", [euroc, tumbling])
def test_correction_for_bias_is_integration_anew_to_first_order(
    flight: Callable[[int, int], Tensor],
) -> None:
    """What is left shrinks with the square of the change of bias."""
    imu = flight(4, 100)
    found = integrate(imu)
    shift = torch.tensor([0.05, -0.04, 0.03, 0.01, 0.008, -0.012], dtype=torch.float64)
    left = []
    for size in (1.0, 0.5):
        again = integrate(imu, BIAS + size * shift).increments
        left.append(float(error(found.corrected(BIAS + size * shift), again).norm(dim=-1).max()))
        moved = float(error(found.increments, again).norm(dim=-1).max())
        assert left[-1] < 0.02 * moved
    assert left[1] == pytest.approx(0.25 * left[0], rel=0.05)


def test_gradients_at_rest() -> None:
    imu = torch.zeros(2, 7, 6, dtype=torch.float64, requires_grad=True)
    found = integrate(imu, torch.zeros(6, dtype=torch.float64))
    (found.increments.sum() + found.covariance.sum() + found.bias_jacobian.sum()).backward()
    assert imu.grad is not None
    assert imu.grad.isfinite().all()


# ---------------------------------------------------------------- batches


def test_padding_changes_nothing() -> None:
    imu = tumbling(2, 30)
    dt = torch.full((2, 30), DT, dtype=torch.float64)
    dt[0, 20:] = 0
    bias = BIAS.expand(2, 6)
    padded = preintegrate(imu, dt, bias, ACCEL, GYRO)
    short = integrate(imu[:1, :20])
    for name in ("increments", "duration", "covariance", "bias_jacobian"):
        found, expected = getattr(padded, name)[0], getattr(short, name)[0]
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-14, msg=name)


def test_rows_of_a_batch_are_runs_alone() -> None:
    imu = tumbling(12, 33).unflatten(0, (3, 4))
    together = integrate(imu)
    alone = integrate(imu[1:2])
    for name in ("increments", "duration", "covariance", "bias_jacobian"):
        assert torch.equal(getattr(together, name)[1:2], getattr(alone, name)), name


def test_one_window_serves_a_cloud_of_biases_and_noises() -> None:
    found = integrate(tumbling(1, 20)[0])
    g = torch.Generator().manual_seed(0)
    biases = BIAS + 0.01 * torch.randn(5, 6, generator=g, dtype=torch.float64)
    noise = 0.01 * torch.randn(5, 9, generator=g, dtype=torch.float64)
    cloud = perturb(found.corrected(biases), noise)
    assert cloud.shape == (5, 10)
    one = perturb(found.corrected(biases[3]), noise[3])
    torch.testing.assert_close(cloud[3], one, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("imu", "dt", "bias"),
    [
        ((2, 9, 6), (2, 8), (2, 6)),
        ((2, 9, 6), (2, 9), (6,)),
        ((9, 5), (9,), (6,)),
        ((0, 6), (0,), (6,)),
    ],
)
def test_shapes_that_do_not_agree(imu: tuple, dt: tuple, bias: tuple) -> None:
    with pytest.raises(ValueError, match=r"must be \[\*s, n, 6\]"):
        preintegrate(torch.zeros(imu), torch.zeros(dt), torch.zeros(bias), ACCEL, GYRO)
