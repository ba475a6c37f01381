"""Motion models: errors, their transition by finite differences, their noise by sampling."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from filterpy.common import Q_discrete_white_noise
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from agents.models.process import (
    ConstantVelocityProcess,
    DisplacementProcess,
    DriftingProcess,
    InertialProcess,
    InsProcess,
    Process,
    WheeledProcess,
    make_process,
)
from coloc_env.bounds.process import error_model
from coloc_env.motion import Aggressive, Arena, Kinematics, RandomVelocity
from coloc_env.network import Network
from coloc_env.observation import Observation
from coloc_env.scenario import ConstantVelocity, Inertial, InsDriven, Prior, Scenario, Wheeled
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import GRAVITY, Displacement, Height, Imu, Ins, Odometry, Sensor
from coloc_env.world import World

DT = 0.1
IMU, ODOMETRY = Imu(0.3, 0.05), Odometry(0.2, 0.1, 0.15, relative=0.1)
BAROMETER = Height(bias_std=0.5, bias_time=3.0, estimated=True)
WALKING = Inertial(0.1, 0.01, accel_walk=0.2, gyro_walk=0.03)
PROCESSES: dict[str, Callable[[], Process]] = {
    "inertial": lambda: InertialProcess(DT, IMU, Inertial()),
    "biased": lambda: InertialProcess(DT, IMU, Inertial(0.1, 0.01)),
    "walking": lambda: InertialProcess(DT, IMU, WALKING),
    "wheeled": lambda: WheeledProcess(DT, ODOMETRY),
    "ins": lambda: InsProcess(3, DT, Ins(0.3, 0.2), InsDriven(1.5)),
    "ins, plane": lambda: InsProcess(2, DT, Ins(0.3), InsDriven()),
    "displacement": lambda: DisplacementProcess(3, DT, Displacement(0.1, 0.3)),
    "displacement, plane": lambda: DisplacementProcess(2, DT, Displacement(0.2, 0.1)),
    "velocity": lambda: ConstantVelocityProcess(3, DT, ConstantVelocity(0.7)),
    "plane": lambda: ConstantVelocityProcess(2, DT, ConstantVelocity(0.7)),
    "damped": lambda: ConstantVelocityProcess(3, DT, ConstantVelocity(0.7, damping=0.4)),
    "drifting": lambda: DriftingProcess(InertialProcess(DT, IMU, Inertial()), BAROMETER),
    "drifting, biased": lambda: DriftingProcess(
        InertialProcess(DT, IMU, Inertial(0.1, 0.01)), BAROMETER
    ),
    "drifting, velocity": lambda: DriftingProcess(
        ConstantVelocityProcess(3, DT, ConstantVelocity(0.7)), BAROMETER
    ),
    "held": lambda: ConstantVelocityProcess(2, DT, ConstantVelocity(0.7, held=True)),
}
INERTIAL = ("inertial", "biased", "walking")


@pytest.fixture(params=PROCESSES)
def process(request: pytest.FixtureRequest) -> Process:
    return PROCESSES[request.param]()


def normal(*shape: int, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def states(process: Process, count: int = 50, seed: int = 0) -> Tensor:
    """[1, count, S]: places, velocities, any attitude, biases."""
    x = normal(1, count, process.state_size, seed=seed)
    if process.attitude_size == 4:
        x[..., 6:10] = torch.nn.functional.normalize(x[..., 6:10], dim=-1)
    if process.attitude_size == 1:
        x[..., 4] = x[..., 4].clamp(-3, 3)
    return x


def inputs(process: Process, count: int = 50, seed: int = 1) -> Tensor:
    """[1, count, U]: hard manoeuvres, with gravity where it is felt."""
    width = {4: 6, 1: 3, 0: 0}[process.attitude_size]
    if isinstance(process, InsProcess | DisplacementProcess):
        width = process.dim
    u = normal(1, count, width, seed=seed)
    if width == 6:
        u[..., 2] += GRAVITY
    return u


def seconds(like: Tensor, dt: float = DT) -> Tensor:
    return torch.full(like.shape[:2], dt, dtype=like.dtype)


# ---------------------------------------------------------------- errors


def test_plus_and_minus_are_inverse(process: Process) -> None:
    x, delta = states(process), 0.5 * normal(1, 50, process.error_size, seed=2)
    moved = process.boxplus(x, delta)
    torch.testing.assert_close(process.boxminus(moved, x), delta, rtol=0, atol=1e-14)
    back = process.boxplus(moved, process.boxminus(x, moved))
    assert process.boxminus(back, x).abs().max() < 1e-14
    assert process.boxminus(x, x).abs().max() < 1e-15
    torch.testing.assert_close(process.boxplus(x, 0 * delta), x, rtol=0, atol=1e-15)


def test_position_and_velocity_lead_the_error(process: Process) -> None:
    x, delta, d = states(process), normal(1, 50, process.error_size, seed=2), process.dim
    moved = process.boxplus(x, delta)
    torch.testing.assert_close(moved[..., :d] - x[..., :d], delta[..., :d])
    if process.error_size >= 2 * d:
        torch.testing.assert_close(moved[..., d : 2 * d] - x[..., d : 2 * d], delta[..., d : 2 * d])


# ---------------------------------------------------------------- transition


def differences(process: Process, x: Tensor, u: Tensor, dt: Tensor) -> Tensor:
    """∂(propagated error)/∂(error), column by column, by central differences."""
    step, e = 1e-5, process.error_size
    after, columns = process.propagate(x, u, dt), []
    for direction in torch.eye(e, dtype=x.dtype):
        ends = (
            process.boxminus(process.propagate(process.boxplus(x, s * direction), u, dt), after)
            for s in (step, -step)
        )
        forward, backward = ends
        columns.append((forward - backward) / (2 * step))
    return torch.stack(columns, -1)


def test_transition_is_the_derivative(process: Process) -> None:
    x, u = states(process), inputs(process)
    f, _ = process.linearize(x, u, seconds(x))
    expected = differences(process, x, u, seconds(x))
    if process.error_size >= 15:
        # To first order in the turn: −I dt for the right Jacobian's −J dt, which differs by half
        # the turn.
        turn = DT * (u[..., 3:] - x[..., 13:16]).norm(dim=-1)
        apart = torch.linalg.matrix_norm((f - expected)[..., 6:9, 12:15], ord=2)
        assert (apart <= 0.5 * turn * DT + 1e-9).all()
        f, expected = f.clone(), expected.clone()
        f[..., 6:9, 12:15] = expected[..., 6:9, 12:15] = 0
    torch.testing.assert_close(f, expected, rtol=0, atol=1e-9)


def test_no_time_no_change(process: Process) -> None:
    x, u = states(process), inputs(process)
    dt = seconds(x, 0.0)
    f, q = process.linearize(x, u, dt)
    noise = normal(1, 50, process.noise_size, seed=3)
    torch.testing.assert_close(process.propagate(x, u, dt), x, rtol=0, atol=1e-15)
    torch.testing.assert_close(process.propagate(x, u, dt, noise), x, rtol=0, atol=1e-15)
    torch.testing.assert_close(f, torch.eye(process.error_size).double().expand_as(f))
    assert not q.any()


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    seed=st.integers(0, 2**31), size=st.floats(0.1, 30), push=st.floats(0, 5), dt=st.floats(0, 1)
)
def test_retreat_and_motion_undo_each_other(
    process: Process, seed: int, size: float, push: float, dt: float
) -> None:
    """Wherever, however fast, with whatever biases, and however long."""
    x, u = states(process, seed=seed), push * inputs(process, seed=seed + 1)
    x[..., : 2 * process.dim] *= size
    x[..., 10:] *= push
    span = seconds(x, dt)
    back = process.propagate(process.retreat(x, u, span), u, span)
    forth = process.retreat(process.propagate(x, u, span), u, span)
    rounding = 1e-12 * (1 + size + push)
    assert process.boxminus(back, x).abs().max() < rounding
    assert process.boxminus(forth, x).abs().max() < rounding


# ---------------------------------------------------------------- noise


def sampled(process: Process, count: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Covariance of the propagated state's error over many draws, and Q."""
    x, u = (a[:, :1] for a in (states(process), 0.3 * inputs(process)))
    _, q = process.linearize(x, u, seconds(x))
    noise = normal(1, count, process.noise_size, seed=4).to(dtype)
    many, driven = (a.expand(1, count, -1).to(dtype) for a in (x, u))
    dt = seconds(many)
    moved = process.propagate(many, driven, dt, noise).double()
    error = process.boxminus(moved, process.propagate(x, u, seconds(x)).expand_as(moved))[0]
    return error.mT @ error / count, q[0, 0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_noise_is_the_covariance_of_samples(process: Process, dtype: torch.dtype) -> None:
    covariance, q = sampled(process, 40_000, dtype)
    std = q.diagonal().sqrt().clamp_min(1e-5)  # what rounding leaves where there is no noise
    scaled = (covariance - q) / (std.unsqueeze(-1) * std)
    assert scaled.abs().max() < 0.03


def test_noise_is_symmetric_and_not_negative(process: Process) -> None:
    x, u = states(process), inputs(process)
    _, q = process.linearize(x, u, seconds(x))
    torch.testing.assert_close(q, q.mT, rtol=0, atol=1e-16)
    assert torch.linalg.eigvalsh(q).min() > -1e-12


@pytest.mark.parametrize("damping", [0.05, 2.0, 9.0, 11.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_damped_velocity_against_the_matrix_exponential(damping: float, dtype: torch.dtype) -> None:
    """Van Loan's integral; and no cancellation, however weak the damping."""
    process = ConstantVelocityProcess(2, DT, ConstantVelocity(0.7, damping))
    x = states(process, 1).to(dtype)
    f, q = process.linearize(x, inputs(process, 1), seconds(x))
    system = torch.tensor([[0.0, 1.0], [0.0, -1 / damping]], dtype=torch.float64)
    drive = torch.tensor([[0.0, 0.0], [0.0, 0.49]], dtype=torch.float64)
    block = torch.cat((torch.cat((-system, drive), 1), torch.cat((0 * system, system.mT), 1)))
    whole = torch.linalg.matrix_exp(DT * block)
    transition = whole[2:, 2:].mT.contiguous()
    eye = torch.eye(2, dtype=torch.float64)
    tolerance = 1e-8 if dtype == torch.float64 else 1e-5
    expected = torch.kron(transition, eye)
    torch.testing.assert_close(f[0, 0].double(), expected, rtol=tolerance, atol=1e-12)
    expected = torch.kron(transition @ whole[:2, 2:], eye)
    torch.testing.assert_close(q[0, 0].double(), expected, rtol=tolerance, atol=1e-18)
    moved = process.propagate(x, inputs(process, 1), seconds(x), torch.ones_like(x))
    assert moved.isfinite().all()


@pytest.mark.parametrize("dt", [0.1, 0.02, 1.5])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("q", [0.0, 0.0036, 1.0])
def test_held_acceleration_is_filterpys_and_that_of_the_bound(
    q: float, dim: int, dt: float
) -> None:
    """x₊ = F x + G w with G = [T²/2, T], w the acceleration of the whole step."""
    model = ConstantVelocity(q**0.5, held=True)
    process = ConstantVelocityProcess(dim, dt, model)
    x = states(process, 3)
    f, found = process.linearize(x, x[..., :0], seconds(x, dt))
    expected = Q_discrete_white_noise(2, dt, q, block_size=dim, order_by_dim=False)
    transition = torch.kron(torch.tensor([[1.0, dt], [0.0, 1.0]]).double(), torch.eye(dim))
    torch.testing.assert_close(f, transition.expand_as(f))
    torch.testing.assert_close(found, torch.tensor(expected).expand_as(found))
    scenario = make_scenario("wsn-v0", n_uavs=3)
    arena = Arena(dim, 3, dt, (0.0,) * dim, (10.0,) * dim)
    errors = error_model(replace(scenario, arena=arena, process=model))
    truth = Kinematics(x[..., :dim], x[..., dim:], x[..., :0])
    for ours, theirs in zip(
        errors.transition(truth, truth, Observation({})), (f, found), strict=True
    ):
        torch.testing.assert_close(ours, theirs)


def test_held_acceleration_moves_as_it_says() -> None:
    """One draw for each axis: p and v go together."""
    process = ConstantVelocityProcess(2, DT, ConstantVelocity(0.7, held=True))
    assert process.noise_size == 2
    x, w = states(process), normal(1, 50, 2, seed=3)
    moved = process.propagate(x, x[..., :0], seconds(x), w)
    p, v = x.split(2, -1)
    acceleration = 0.7 * w
    torch.testing.assert_close(moved[..., 2:], v + DT * acceleration)
    torch.testing.assert_close(moved[..., :2], p + DT * v + 0.5 * DT**2 * acceleration)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"accel_std": -0.1}, "accel_std=-0.1 is not allowed: a standard deviation ≥ 0"),
        ({"damping": 0.0}, "damping=0.0 is not allowed: a time in s > 0"),
        ({"held": True, "damping": 2.0}, "held=True is not allowed: without damping"),
    ],
)
def test_velocities_that_make_no_sense_are_refused(wrong: dict, words: str) -> None:
    with pytest.raises(ValueError, match=f"ConstantVelocity: {words}"):
        ConstantVelocity(**wrong)


def test_the_ins_counts_a_share_of_its_bias_as_noise() -> None:
    process = InsProcess(3, 0.5, Ins(0.4, 0.3), InsDriven(2.5))
    x = states(process, 3)
    u = inputs(process, 3)
    f, q = process.linearize(x, u, seconds(x, 0.5))
    torch.testing.assert_close(f, torch.eye(3).double().expand_as(f))
    variance = 0.25 * (0.16 + 2.5 * 0.09)
    torch.testing.assert_close(q, variance * torch.eye(3).double().expand_as(q))
    moved = process.propagate(x, u, seconds(x, 0.5))
    torch.testing.assert_close(moved, torch.cat((x[..., :3] + 0.5 * u, u), -1))
    with pytest.raises(ValueError, match=r"InsDriven: bias_share=-1\.0 is not allowed"):
        InsDriven(-1.0)


@pytest.mark.parametrize(
    ("model", "dim", "words"),
    [
        (Inertial(), 3, "inertial, but the team has no IMU"),
        (InsDriven(), 3, "driven by an INS, but the team has none"),
        (Wheeled(), 2, "wheeled, but the team has no odometry"),
    ],
)
def test_a_motion_without_its_sensor_is_refused(model: Any, dim: int, words: str) -> None:
    believed = make_scenario("wsn-v0" if dim == 2 else "indoor-v0").believed
    with pytest.raises(ValueError, match=words):
        make_process(replace(believed, process=model, sensors=()))


# ---------------------------------------------------------------- against the world


@pytest.mark.parametrize("kind", ["inertial", "wheeled", "ins"])
def test_without_noise_the_model_follows_the_world(kind: str) -> None:
    exact: dict[str, tuple[int, Sensor, Any]] = {
        "inertial": (3, Imu(0.0, 0.0), Inertial()),
        "wheeled": (2, Odometry(0.0, 0.0, 0.0), Wheeled()),
        "ins": (3, Ins(0.0), InsDriven()),
    }
    dim, sensor, model = exact[kind]
    scenario = Scenario(
        name="exact",
        arena=Arena(dim, 4, DT, (0.0,) * dim, (20.0, 16.0, 8.0)[:dim]),
        horizon=60,
        motion=Aggressive() if dim == 3 else RandomVelocity(v_max=2.0),
        sensors=(sensor,),
        network=Network(),
        prior=Prior(0.0, 0.0, 0.0),
        process=model,
        believed_sensors=(sensor,),
    )
    process, world = make_process(scenario.believed), World(scenario, 2)
    x, _ = process.initial(world.reset(0)["prior"].double())
    size = process.state_size
    idle = torch.zeros(2, 4, 3 * dim)
    truth = world.truth
    for _ in range(40):
        start = torch.cat((truth.position, truth.velocity, truth.attitude), -1)[..., :size]
        world.advance(idle)
        truth = world.truth
        u = process.inputs(world.observation())
        moved = process.propagate(start, u, seconds(start))
        now = torch.cat((truth.position, truth.velocity, truth.attitude), -1)[..., :size]
        error = process.boxminus(moved, now).abs()
        place = (
            2e-3 if kind == "inertial" else 3e-5
        )  # the mean force of a step leaves jerk · dt³ / 12
        assert error[..., :dim].max() < place
        assert kind == "ins" or error[..., dim:].max() < 3e-5  # float32 leaves
    assert x.shape == now.shape


def test_initial_error_is_what_the_prior_says() -> None:
    prior = torch.tensor(
        [[[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1.0, 0.0, 0.0, 0.0, 0.7, 0.8, 0.9, 0.2, 0.05]]]
    ).double()
    expected = [0.7, 0.8, 0.9, 0.2, 0.2, 0.2, 0.05, 0.05, 0.05, 0.1, 0.1, 0.1, 0.01, 0.01, 0.01]
    x, covariance = PROCESSES["biased"]().initial(prior)
    assert x[0, 0].tolist() == [*prior[0, 0, :10].tolist(), *[0.0] * 6]
    torch.testing.assert_close(
        covariance[0, 0], torch.diag(torch.tensor(expected).double() ** 2), rtol=1e-6, atol=0
    )
    x, covariance = PROCESSES["velocity"]().initial(prior)
    assert x[0, 0].tolist() == prior[0, 0, :6].tolist()
    torch.testing.assert_close(
        covariance[0, 0].diagonal().sqrt()[3:], torch.full((3,), 0.2).double()
    )
    flat = torch.tensor([[[1.0, 2.0, 3.0, 4.0, 0.5, 0.7, 0.8, 0.2, 0.05]]]).double()
    x, covariance = PROCESSES["wheeled"]().initial(flat)
    assert x[0, 0].tolist() == flat[0, 0, :5].tolist()
    torch.testing.assert_close(
        covariance[0, 0].diagonal().sqrt(), torch.tensor([0.7, 0.8, 0.05]).double()
    )
    x, covariance = PROCESSES["ins"]().initial(prior)
    assert x[0, 0].tolist() == prior[0, 0, :6].tolist()
    torch.testing.assert_close(
        covariance[0, 0].diagonal().sqrt(), torch.tensor([0.7, 0.8, 0.9]).double()
    )


def test_a_drift_that_filters_estimate_is_a_state() -> None:
    """And one that they only consider is none."""
    believed = make_scenario("indoor-v0", barometer=True, landmarks=0, uwb=False).believed
    drifting = make_process(believed)
    assert isinstance(drifting, DriftingProcess)
    assert (drifting.std, drifting.time) == (0.5, 300.0)
    height = replace(believed.sensors[-1], estimated=False)
    considered = make_process(replace(believed, sensors=(*believed.sensors[:-1], height)))
    assert isinstance(considered, InertialProcess)
