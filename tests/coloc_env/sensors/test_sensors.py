"""Sensors against their definitions: geometry without noise, statistics with it."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from coloc_env import noise
from coloc_env.geometry import rotate, rotate_by, rotation_matrix
from coloc_env.motion import MOTIONS, Arena, Kinematics, RandomVelocity
from coloc_env.network import Network
from coloc_env.scenario import ConstantVelocity, Prior, Scenario, Wheeled
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import (
    GRAVITY,
    AnchorRanging,
    Height,
    Imu,
    Ins,
    LandmarkBearings,
    Landmarks,
    Odometry,
    PositionFix,
    RangeNoise,
    Ranging,
    Sensor,
    UavBearings,
)
from coloc_env.sensors.base import Layout
from coloc_env.sensors.ranging import tag_positions
from coloc_env.world import World

MANY = 200_000
NO_NOISE: dict[str, Any] = {"accel_std": 0.0, "gyro_std": 0.0, "landmark_std": 0.0, "uwb_std": 0.0}


def indoor(**overrides: Any) -> World:
    world = World(make_scenario("indoor-v0", **overrides), 4)
    world.reset(0)
    return world


def planar(*sensors: Sensor, n_uavs: int = 4, **more: Any) -> World:
    """A world of robots in the plane with the given sensors."""
    arena = Arena(2, n_uavs, 0.1, (0.0, 0.0), (20.0, 12.0))
    scenario = Scenario(
        name="planar",
        arena=arena,
        horizon=50,
        motion=RandomVelocity(interval=2.0, lag=0.5),
        sensors=sensors,
        network=more.pop("network", Network()),
        prior=Prior(),
        process=Wheeled(),
        believed_sensors=sensors,
        **more,
    )
    world = World(scenario, 3)
    world.reset(0)
    return world


def skip(world: World, steps: int = 1) -> None:
    n, width = world.scenario.arena.n_uavs, 3 * world.scenario.arena.dim
    for _ in range(steps):
        world.advance(torch.zeros(world.batch_size, n, width))


def near(value: float, expected: float, spread: float) -> bool:
    """Within five standard deviations of an estimate's own."""
    return abs(value - expected) < 5 * spread


# ------------------------------------------------------------------------------- range noise


def errors(model: RangeNoise) -> tuple[Tensor, Tensor | None]:
    keys = noise.fold(torch.zeros(MANY, dtype=torch.int64), torch.arange(MANY))
    ranges, lost = model.sample(torch.full((MANY,), 7.0), keys, "ranging")
    return ranges.double() - 7.0, lost


def test_gaussian_range_noise() -> None:
    error, lost = errors(RangeNoise(std=0.2))
    assert lost is None
    assert near(float(error.mean()), 0.0, 0.2 / math.sqrt(MANY))
    assert near(float(error.std()), 0.2, 0.2 / math.sqrt(2 * MANY))


def test_heavy_tails_are_a_mixture() -> None:
    error, _ = errors(RangeNoise(std=0.1, tail=0.25, tail_std=2.0))
    variance, fourth = 0.75 * 0.01 + 0.25 * 4.0, 3 * (0.75 * 1e-4 + 0.25 * 16.0)
    assert near(float((error**2).mean()), variance, math.sqrt((fourth - variance**2) / MANY))
    beyond = 0.25 * math.erfc(1.0 / (2.0 * math.sqrt(2)))  # the narrow part never reaches 1 m
    rate = float((error.abs() > 1.0).double().mean())
    assert near(rate, beyond, math.sqrt(beyond / MANY))


def test_uniform_range_noise() -> None:
    error, _ = errors(RangeNoise(std=0.0, uniform=0.3))
    assert float(error.abs().max()) <= 0.3 + 1e-6
    assert near(float(error.mean()), 0.0, 0.3 / math.sqrt(3 * MANY))
    assert near(float((error**2).mean()), 0.03, 0.3**2 / math.sqrt(MANY))


@pytest.mark.parametrize("kind", ["exponential", "constant"])
def test_nlos_bias(kind: str) -> None:
    error, _ = errors(RangeNoise(std=0.0, nlos=0.2, nlos_bias=1.5, nlos_kind=kind))
    assert float(error.min()) >= -1e-6
    biased = error[error > 1e-6]
    assert near(len(biased) / MANY, 0.2, math.sqrt(0.16 / MANY))
    if kind == "constant":
        torch.testing.assert_close(biased, torch.full_like(biased, 1.5), rtol=0, atol=1e-6)
    else:
        assert near(float(biased.mean()), 1.5, 1.5 / math.sqrt(len(biased)))
        assert near(float(biased.std()), 1.5, 1.5 * math.sqrt(2 / len(biased)))
        median = float((biased < 1.5 * math.log(2)).double().mean())
        assert near(median, 0.5, 0.5 / math.sqrt(len(biased)))


def test_impulses() -> None:
    error, _ = errors(RangeNoise(std=0.0, impulse=0.1, impulse_size=4.0))
    hit = error[error.abs() > 1e-5]
    assert near(len(hit) / MANY, 0.1, math.sqrt(0.09 / MANY))
    assert float(hit.abs().max()) <= 4.0
    assert near(float(hit.mean()), 0.0, 4.0 / math.sqrt(3 * len(hit)))
    assert near(float((hit**2).mean()), 16 / 3, 16 / math.sqrt(len(hit)))


def test_dropouts_and_independence_of_events() -> None:
    model = RangeNoise(std=0.0, nlos=0.3, nlos_kind="constant", impulse=0.3, dropout=0.4)
    error, lost = errors(model)
    assert lost is not None
    assert near(float(lost.double().mean()), 0.4, math.sqrt(0.24 / MANY))
    clean = (error.abs() < 1e-6).double()  # neither biased nor hit
    assert near(float(clean.mean()), 0.49, 0.5 / math.sqrt(MANY))
    assert near(float((clean * lost).mean()), 0.49 * 0.4, 0.5 / math.sqrt(MANY))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"nlos": 1.5}, "nlos=1.5 is not allowed: a probability"),
        ({"std": -1.0}, "std=-1.0 is not allowed: a size in m"),
        ({"nlos_kind": "odd"}, "nlos_kind='odd' is not allowed: one of exponential, constant"),
        ({"nlos_time": 0.0}, "nlos_time=0.0 is not allowed: a time in s > 0"),
        ({"nlos_time": math.inf}, "nlos_time=inf is not allowed: a time in s > 0"),
    ],
)
def test_range_noise_settings_are_checked(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        RangeNoise(**wrong)


# ------------------------------------------------------------------------------------ ranging


def test_both_ends_read_the_same_range() -> None:
    world = indoor(nlos=0.3, uwb_tail=0.3, uwb_dropout=0.2, uwb_impulse=0.2, message_loss=0.5)
    for _ in range(5):
        observation = world.observation()
        for name in ("ranges", "range_mask"):
            assert torch.equal(observation[name], observation[name].transpose(1, 2)), name
        assert observation["range_mask"].mean() > 0.5
        skip(world)


def test_both_ends_read_the_same_range_among_many() -> None:
    world = indoor(n_uavs=40, comm_radius=6.0, uwb_dropout=0.2)
    skip(world, 3)
    observation = world.observation()
    table: dict[tuple[int, int, int], float] = {}
    twice = 0
    for b in range(4):
        for i in range(40):
            heard = observation["range_mask"][b, i] > 0
            others = observation["neighbours"][b, i][heard].int().tolist()
            for j, value in zip(others, observation["ranges"][b, i][heard].tolist(), strict=True):
                pair = (b, min(i, j), max(i, j))
                twice += pair in table
                assert table.setdefault(pair, value) == value
    assert twice > 100


def test_ranges_without_noise_are_distances() -> None:
    for overrides in ({}, {"n_uavs": 40}):
        world = indoor(**NO_NOISE, **overrides)
        skip(world, 7)
        observation, position = world.observation(), world.truth.position
        distance = torch.linalg.vector_norm(position.unsqueeze(1) - position.unsqueeze(2), dim=-1)
        if overrides:
            distance = distance.gather(2, observation["neighbours"].long())
        expected = distance.float() * observation["range_mask"]
        torch.testing.assert_close(observation["ranges"], expected, rtol=1e-6, atol=1e-6)


def test_delayed_ranges_are_those_of_the_step_before() -> None:
    now, late = indoor(), indoor(uwb_delay=3)
    undelayed = []
    for k in range(8):
        undelayed.append(now.observation()["ranges"])
        delivered = late.observation()
        if k < 3:
            assert (delivered["range_mask"] == 0).all()
            assert (delivered["ranges"] == 0).all()
        else:
            assert torch.equal(delivered["ranges"], undelayed[k - 3])
        skip(now)
        skip(late)


def test_lever_arms_and_two_tags() -> None:
    tags = (((0.2, 0.0, 0.1), (-0.2, 0.1, 0.0)),) * 6
    scenario = make_scenario("indoor-v0", **NO_NOISE, motion="aggressive")
    quiet = RangeNoise(std=0.0)
    sensors = (Ranging(quiet, tags), AnchorRanging(((0.0, 0.0, 0.0), (9.0, 1.0, 2.0)), quiet, tags))
    world = World(replace(scenario, sensors=sensors), 2)
    world.reset(0)
    skip(world, 4)
    truth, seen = world.truth, world.observation()
    where = tag_positions(truth, tags)  # [B, N, T, d]
    arms = where.new_tensor(tags[0])
    expected = truth.position.unsqueeze(2) + rotate(truth.attitude.unsqueeze(2), arms)
    torch.testing.assert_close(where, expected)
    for i in range(6):
        for j in range(6):
            for a in range(2):
                for b in range(2):
                    apart = torch.linalg.vector_norm(where[:, i, a] - where[:, j, b], dim=-1)
                    got = seen["ranges"][:, i, (j * 2 + a) * 2 + b]
                    torch.testing.assert_close(got, (apart * (i != j)).float())
    anchors = seen["anchor_map"].unflatten(-1, (2, 3)).double()
    for a in range(2):
        for m in range(2):
            apart = torch.linalg.vector_norm(where[:, :, a] - anchors[:, :, m], dim=-1)
            torch.testing.assert_close(seen["anchor_ranges"][..., a * 2 + m], apart.float())


def test_anchor_radius_hides_far_anchors() -> None:
    world = indoor(**NO_NOISE)
    places = ((15.0, 10.0, 0.0), (0.0, 0.0, 0.0))
    sensor = AnchorRanging(places, RangeNoise(std=0.0), radius=6.0)
    near_and_far = World(replace(world.scenario, sensors=(sensor,)), 2)
    seen = near_and_far.reset(0)
    assert (seen["anchor_range_mask"] == torch.tensor([1.0, 0.0])).all()
    assert (seen["anchor_ranges"][..., 1] == 0).all()


# ---------------------------------------------------------------------------------------- imu


def imu_step(world: World) -> tuple[Kinematics, Kinematics, Tensor]:
    """Truth before and after one step and the sample of that step, as float64."""
    before = world.truth
    skip(world)
    return before, world.truth, world.observation()["imu"].double()


@pytest.mark.parametrize("motion", MOTIONS)
def test_strapdown_integration_of_the_clean_imu_reproduces_the_truth(motion: str) -> None:
    dt = 0.1
    world = indoor(**NO_NOISE, motion=motion)
    gravity = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
    for _ in range(30):
        before, after, sample = imu_step(world)
        attitude = rotate_by(before.attitude, sample[..., 3:] * dt)
        velocity = before.velocity + (rotate(before.attitude, sample[..., :3]) + gravity) * dt
        aligned = (attitude * after.attitude).sum(-1).abs()
        assert float((1 - aligned).abs().max()) < 1e-12  # 1 − cos(δ/2) at δ < 3e-6 rad
        assert float((velocity - after.velocity).abs().max()) < 1e-6


def test_position_by_strapdown_integration_errs_by_the_third_power_of_the_step() -> None:
    worst = []
    for dt in (0.2, 0.1, 0.05):
        world = indoor(**NO_NOISE, motion="aggressive", dt=dt)
        gravity = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
        error = 0.0
        for _ in range(round(12.0 / dt)):
            before, after, sample = imu_step(world)
            thrust = rotate(before.attitude, sample[..., :3]) + gravity
            position = before.position + before.velocity * dt + 0.5 * thrust * dt**2
            error = max(error, float((position - after.position).abs().max()))
        worst.append(error)
    assert worst[0] / worst[1] > 6.0
    assert worst[1] / worst[2] > 6.0


def test_the_first_sample_is_that_of_a_uav_at_rest() -> None:
    world = indoor(**NO_NOISE, motion="aggressive")
    sample, truth = world.observation()["imu"], world.truth
    up = torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64).expand_as(truth.position)
    force = rotate(truth.attitude, sample[..., :3].double())
    torch.testing.assert_close(force, up, rtol=0, atol=1e-5)
    assert float(sample[..., 3:].abs().max()) < 1e-12


def test_imu_noise_and_biases() -> None:
    clean, noisy = indoor(**NO_NOISE), indoor(accel_std=0.05, gyro_std=0.01)
    errors_ = []
    for _ in range(400):
        errors_.append(noisy.observation()["imu"] - clean.observation()["imu"])
        skip(clean)
        skip(noisy)
    error = torch.stack(errors_).double().flatten(0, 2)  # [400 · 4 · 6, 6]
    std = torch.tensor([0.05] * 3 + [0.01] * 3, dtype=torch.float64)
    assert ((error.mean(0) / std).abs() < 5 / math.sqrt(len(error))).all()
    assert ((error.std(0) / std - 1).abs() < 5 / math.sqrt(2 * len(error))).all()

    quiet = {**NO_NOISE, "imu_bias": True, "accel_bias": 0.2, "gyro_bias": 0.03}
    scenario = make_scenario("indoor-v0", **quiet)
    biased, plain = World(scenario, 500), World(make_scenario("indoor-v0", **NO_NOISE), 500)
    bias = biased.reset(0)["imu"] - plain.reset(0)["imu"]
    std = torch.tensor([0.2] * 3 + [0.03] * 3)
    assert ((bias.flatten(0, 1).std(0) / std - 1).abs() < 5 / math.sqrt(2 * 3000)).all()
    skip(biased)
    skip(plain)
    later = biased.observation()["imu"] - plain.observation()["imu"]
    torch.testing.assert_close(later, bias, rtol=0, atol=2e-6)  # constant over the episode


# ---------------------------------------------------------------------------------- landmarks


def test_landmarks_are_body_frame_vectors_within_the_radius() -> None:
    world = indoor(**NO_NOISE, motion="aggressive", landmark_radius=8.0)
    skip(world, 9)
    seen, truth = world.observation(), world.truth
    points = seen["landmark_map"].unflatten(-1, (20, 3)).double()
    apart = points - truth.position.unsqueeze(2)
    expected = rotation_matrix(truth.attitude).transpose(-1, -2).unsqueeze(2) @ apart.unsqueeze(-1)
    within = torch.linalg.vector_norm(apart, dim=-1) <= 8.0
    assert torch.equal(seen["landmark_mask"], within.float())
    assert 0.1 < within.double().mean() < 0.9
    z = seen["landmarks"].unflatten(-1, (20, 3))
    expected = (expected.squeeze(-1) * within.unsqueeze(-1)).float()
    torch.testing.assert_close(z, expected, rtol=0, atol=1e-5)


def test_landmarks_lie_in_the_arena_and_differ_between_worlds() -> None:
    world = World(make_scenario("indoor-v0"), 200)
    points = world.reset(0)["landmark_map"].unflatten(-1, (20, 3))[:, 0].double()
    room = torch.tensor([30.0, 20.0, 5.0], dtype=torch.float64)
    share = (points / room).flatten(0, 1)
    assert float(share.min()) >= 0.0
    assert float(share.max()) <= 1.0
    assert ((share.mean(0) - 0.5).abs() < 5 / math.sqrt(12 * len(share))).all()
    assert len(points[:, 0].unique(dim=0)) == 200


def landmark_samples(**overrides: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Leaves, masks and noiseless leaves [40 · 50 · 6, 20(, 3)] of many steps."""
    overrides = {"landmark_radius": 1000.0, **overrides}
    world = World(make_scenario("indoor-v0", **overrides), 50)
    clean = World(make_scenario("indoor-v0", **NO_NOISE, landmark_radius=1000.0), 50)
    world.reset(0)
    clean.reset(0)
    z, mask, ideal = [], [], []
    for _ in range(40):
        seen = world.observation()
        z.append(seen["landmarks"].unflatten(-1, (20, 3)))
        mask.append(seen["landmark_mask"])
        ideal.append(clean.observation()["landmarks"].unflatten(-1, (20, 3)))
        skip(world)
        skip(clean)
    return tuple(torch.stack(x).flatten(0, 2) for x in (z, mask, ideal))  # type: ignore[return-value]


def test_landmark_noise_and_dropout() -> None:
    z, mask, ideal = landmark_samples(landmark_std=0.15, landmark_dropout=0.3)
    n = mask.numel()
    assert near(float(mask.double().mean()), 0.7, math.sqrt(0.21 / n))
    assert (z[mask == 0] == 0).all()
    error = (z - ideal)[mask > 0].double()
    assert near(float(error.mean()), 0.0, 0.15 / math.sqrt(error.numel()))
    assert near(float(error.std()), 0.15, 0.15 / math.sqrt(2 * error.numel()))
    across = torch.corrcoef(error.T)
    assert float((across - torch.eye(3)).abs().max()) < 5 / math.sqrt(len(error))


def test_false_matches_show_another_landmark() -> None:
    z, mask, ideal = landmark_samples(landmark_std=0.0, false_matches=0.2)
    assert (mask == 1).all()
    wrong = (z - ideal).abs().amax(-1) > 1e-4
    assert near(float(wrong.double().mean()), 0.2, math.sqrt(0.16 / wrong.numel()))
    item, slot = wrong.nonzero()[:500].unbind(-1)
    other = (z[item, slot].unsqueeze(1) - ideal[item]).abs().amax(-1)  # [500, 20]
    assert float(other.amin(-1).max()) < 1e-4
    matched = other.argmin(-1)
    assert (matched != slot).all()
    assert len(((matched - slot) % 20).unique()) == 19  # any of the others


def test_landmarks_can_be_off() -> None:
    world = indoor(range_only=(0.3, 0.6))
    visible = []
    for _ in range(9):
        visible.append(bool(world.observation()["landmark_mask"].any()))
        skip(world)
    assert visible == [True] * 3 + [False] * 3 + [True] * 3


def test_given_landmarks() -> None:
    places = ((1.0, 2.0, 3.0), (4.0, 5.0, 1.0))
    scenario = replace(make_scenario("indoor-v0"), sensors=(Landmarks(2, positions=places),))
    seen = World(scenario, 2).reset(0)
    assert torch.equal(seen["landmark_map"], torch.tensor([1.0, 2, 3, 4, 5, 1]).expand(2, 6, 6))
    with pytest.raises(ValueError, match="2 positions of 3 numbers"):
        Landmarks(2, positions=places[:1]).place(torch.zeros(1, dtype=torch.int64), scenario.layout)


# ------------------------------------------------------------------------- plane and the rest


def test_range_and_bearing_to_landmarks_and_robots() -> None:
    world = planar(
        LandmarkBearings(6, 0.0, 0.0, radius=9.0),
        UavBearings(0.0, 0.0),
        network=Network(radius=8.0),
    )
    skip(world, 11)
    seen, truth = world.observation(), world.truth
    heading = truth.attitude
    points = seen["landmark_map"].unflatten(-1, (6, 2)).double()
    for name, there, count in (
        ("landmark_bearing", points, 6),
        ("uav_bearing", truth.position.unsqueeze(1).expand(-1, 4, -1, -1), 4),
    ):
        mask = seen[f"{name}_mask"] > 0
        measured = seen[f"{name}s"].unflatten(-1, (count, 2)).double()
        angle = heading + measured[..., 1]
        step = torch.stack((angle.cos(), angle.sin()), -1) * measured[..., :1]
        reached = truth.position.unsqueeze(2) + step
        torch.testing.assert_close(reached[mask], there[mask], rtol=0, atol=1e-5)
        assert (measured[~mask] == 0).all()
        assert mask.any()
        assert float(measured[..., 1].abs().max()) <= math.pi + 1e-6


def test_bearing_noise_and_share() -> None:
    noisy = planar(LandmarkBearings(6, 0.15, 0.02, 100.0, share=0.6, depth=2), n_uavs=6)
    clean = planar(LandmarkBearings(6, 0.0, 0.0, 100.0, depth=2), n_uavs=6)
    error, rate = [], []
    for _ in range(50):
        a, b = noisy.observation(), clean.observation()
        mask = a["landmark_bearing_mask"] > 0
        rate.append(mask.double())
        apart = (a["landmark_bearings"] - b["landmark_bearings"]).unflatten(-1, (12, 2))[mask]
        error.append(apart.double())
        skip(noisy)
        skip(clean)
    together = torch.cat(error)
    together[:, 1] = torch.remainder(together[:, 1] + math.pi, 2 * math.pi) - math.pi
    n = len(together)
    share = torch.stack(rate)
    assert near(float(share.mean()), 0.6, math.sqrt(0.24 / share.numel()))
    for column, std in ((0, 0.15), (1, 0.02)):
        assert near(float(together[:, column].mean()), 0.0, std / math.sqrt(n))
        assert near(float(together[:, column].std()), std, std / math.sqrt(2 * n))


def test_odometry_leads_from_one_true_pose_to_the_next() -> None:
    world = planar(Odometry(0.0, 0.0, 0.0))
    for _ in range(20):
        before = world.truth
        skip(world)
        after, sample = world.truth, world.observation()["odometry"].double()
        position = before.position + rotate(before.attitude, sample[..., :2] * 0.1)
        turned = before.attitude + sample[..., 2:] * 0.1
        torch.testing.assert_close(position, after.position, rtol=0, atol=1e-6)
        off = torch.remainder(turned - after.attitude + math.pi, 2 * math.pi) - math.pi
        assert float(off.abs().max()) < 1e-6


def test_odometry_noise_grows_with_what_it_measures() -> None:
    sensor = Odometry(0.02, 0.01, 0.03, relative=0.1)
    sample = torch.tensor([[2.0, 0.0, -0.5]])
    torch.testing.assert_close(sensor.std(sample), torch.tensor([[0.22, 0.21, 0.08]]))
    noisy, clean = planar(sensor, n_uavs=50), planar(Odometry(0.0, 0.0, 0.0), n_uavs=50)
    scaled = []
    for _ in range(30):
        ideal = clean.observation()["odometry"]
        scaled.append((noisy.observation()["odometry"] - ideal) / sensor.std(ideal))
        skip(noisy)
        skip(clean)
    score = torch.stack(scaled).double().flatten(0, 2)
    assert ((score.std(0) - 1).abs() < 5 / math.sqrt(2 * len(score))).all()
    assert (score.mean(0).abs() < 5 / math.sqrt(len(score))).all()


def test_height() -> None:
    scenario = make_scenario("indoor-v0")
    noisy = World(replace(scenario, sensors=(Height(0.1, dropout=0.25),)), 100)
    noisy.reset(0)
    error, rate = [], []
    for _ in range(30):
        seen = noisy.observation()
        mask = seen["height_mask"][..., 0] > 0
        error.append((seen["height"][..., 0] - noisy.truth.position[..., 2])[mask])
        rate.append(mask.double())
        assert (seen["height"][..., 0][~mask] == 0).all()
        skip(noisy)
    together = torch.cat(error).double()
    n = len(together)
    assert near(float(torch.stack(rate).mean()), 0.75, math.sqrt(0.19 / (30 * 600)))
    assert near(float(together.std()), 0.1, 0.1 / math.sqrt(2 * n))
    assert near(float(together.mean()), 0.0, 0.1 / math.sqrt(n))


@pytest.mark.parametrize("dim", [2, 3])
def test_position_fixes(dim: int) -> None:
    sensor = PositionFix(0.4, count=2)
    world = planar(sensor)
    if dim == 3:
        world = World(replace(make_scenario("indoor-v0"), sensors=(sensor,)), 3)
        world.reset(0)
    error = []
    for _ in range(200):
        seen, truth = world.observation(), world.truth.position
        others = torch.arange(truth.shape[1]) >= 2
        assert (seen["position_fix_mask"][:, ~others] == 1).all()
        assert not seen["position_fix_mask"][:, others].any()
        assert not seen["position_fix"][:, others].any()
        error.append((seen["position_fix"] - truth)[:, :2])
        skip(world)
    together = torch.stack(error).double().flatten(0, 2)
    n = len(together)
    assert ((together.std(0) / 0.4 - 1).abs() < 5 / math.sqrt(2 * n)).all()
    assert (together.mean(0).abs() < 5 * 0.4 / math.sqrt(n)).all()
    across = torch.corrcoef(together.T) - torch.eye(dim)
    assert float(across.abs().max()) < 5 / math.sqrt(n)


@pytest.mark.parametrize(
    ("kind", "wrong", "words"),
    [
        (PositionFix, {"std": -1.0}, "std=-1.0 is not allowed: a standard deviation in m ≥ 0"),
        (PositionFix, {"count": 0}, "count=0 is not allowed: at least one UAV"),
        (Ins, {"std": -1.0}, "std=-1.0 is not allowed: a standard deviation in m/s ≥ 0"),
        (Ins, {"bias": -1.0}, "bias=-1.0 is not allowed: a standard deviation in m/s ≥ 0"),
        (Ins, {"bias_time": 0.0}, "bias_time=0.0 is not allowed: a time in s > 0"),
    ],
)
def test_settings_of_fixes_and_ins_are_checked(kind: Any, wrong: dict, words: str) -> None:
    with pytest.raises(ValueError, match=f"{kind.__name__}: {words}"):
        kind(**wrong)


# ---------------------------------------------------------------------------------------- ins


def biases(sensor: Ins, rows: int, steps: int, window: int | None = None) -> Tensor:
    """What a noiseless INS says too much, [B, K, N · d], from step 1 on."""
    world = planar(replace(sensor, std=0.0), n_uavs=6)
    clean = World(replace(world.scenario, sensors=(Ins(0.0),)), rows)
    world = World(world.scenario, rows, window=window)
    world.reset(0)
    clean.reset(0)
    found = []
    for _ in range(steps):
        skip(world)
        skip(clean)
        found.append((world.observation()["ins"] - clean.observation()["ins"]).flatten(1))
    return torch.stack(found, 1)


def test_without_noise_the_ins_adds_up_to_the_path() -> None:
    world = planar(Ins(0.0))
    place = world.truth.position
    assert not world.observation()["ins"].any()  # no step has passed
    for _ in range(100):
        skip(world)
        place = place + 0.1 * world.observation()["ins"]
    torch.testing.assert_close(place, world.truth.position, rtol=0, atol=1e-5)


def test_white_noise_of_the_ins() -> None:
    noisy, clean = planar(Ins(0.5), n_uavs=50), planar(Ins(0.0), n_uavs=50)
    found = []
    for _ in range(60):
        skip(noisy)
        skip(clean)
        found.append(noisy.observation()["ins"] - clean.observation()["ins"])
    error = torch.stack(found).double().flatten(1)  # [60, …]
    assert near(float(error.mean()), 0.0, 0.5 / math.sqrt(error.numel()))
    assert near(float(error.std()), 0.5, 0.5 / math.sqrt(2 * error.numel()))
    lagged = (error[1:] * error[:-1]).mean()
    assert near(float(lagged), 0.0, 0.25 / math.sqrt(error.numel()))


@pytest.mark.parametrize("time", [0.05, 2.0, 60.0])
def test_the_bias_is_a_stationary_gauss_markov_process(time: float) -> None:
    """Variance, correlation exp(−t / τ) and kurtosis over many rows, whatever the step."""
    rows, steps = 1000, 45
    x = biases(Ins(0.0, 0.3, time), rows, steps).double().movedim(1, 0).flatten(1) / 0.3
    n = x.shape[1]  # independent paths of one UAV and axis each
    for k in (0, 20, steps - 1):
        assert near(float(x[k].mean()), 0.0, 1 / math.sqrt(n))
        assert near(float(x[k].square().mean()), 1.0, math.sqrt(2 / n))
        kurtosis = float((x[k] ** 4).mean())
        assert abs(kurtosis - (3 - 1.5 / 32)) < 5 * math.sqrt(96 / n)
    for lag in (1, 5, 20):
        expected = math.exp(-lag * 0.1 / time)
        for k in (0, 24):
            found = float((x[k] * x[k + lag]).mean())
            assert near(found, expected, math.sqrt(2 / n))
    across = torch.corrcoef(x[0].view(rows, -1).T) - torch.eye(12)
    assert float(across.abs().max()) < 5 / math.sqrt(rows)


def test_the_bias_does_not_depend_on_rows_and_windows() -> None:
    sensor = Ins(0.0, 0.3, 2.0)
    together = biases(sensor, 7, 45)
    for window in (1, 7, 50):
        assert torch.equal(biases(sensor, 7, 45, window), together)
    assert torch.equal(biases(sensor, 1, 45), together[:1])


# ------------------------------------------------------------------------------- lasting NLOS


def lasting(rows: int, steps: int, window: int | None = None, **more: Any) -> Tensor:
    """Whether each of 15 links is NLOS, [K, B, 15]."""
    noise_ = RangeNoise(0.0, nlos=0.3, nlos_kind="constant", nlos_bias=100.0, nlos_time=0.5)
    world = planar(Ranging(noise_, **more), n_uavs=6)
    world = World(replace(world.scenario, horizon=500), rows, window=window)
    world.reset(0)
    found, (i, j) = [], torch.triu_indices(6, 6, 1)
    for _ in range(steps):
        ranges = world.observation()["ranges"]
        assert torch.equal(ranges, ranges.mT)
        found.append(ranges[:, i, j] > 50.0)
        skip(world)
    return torch.stack(found)


def test_nlos_lasts_as_a_two_state_markov_chain() -> None:
    """Share π, correlation exp(−t / τ), and nothing but the last state matters."""
    x = lasting(400, 120).double()
    links = x[0].numel()
    for k in (0, 1, 30, 70, 119):  # also beyond what is looked back, 50 steps
        assert near(float(x[k].mean()), 0.3, math.sqrt(0.21 / links))
    for k in (0, 60, 100):
        for lag in (1, 3, 10):
            found = float(((x[k] - 0.3) * (x[k + lag] - 0.3)).mean()) / 0.21
            assert near(found, math.exp(-lag * 0.1 / 0.5), 1.5 / math.sqrt(links))
    before, now, after = x[:-2].bool(), x[1:-1].bool(), x[2:]
    stay = 1 - 0.7 * (1 - math.exp(-0.2))
    for past in (before, ~before):
        kept = after[past & now]
        spread = math.sqrt(stay * (1 - stay) / len(kept))
        assert near(float(kept.mean()), stay, 2 * spread)
    apart = torch.corrcoef(x[60].T) - torch.eye(15)
    assert float(apart.abs().max()) < 5 / math.sqrt(400)


def test_lasting_nlos_does_not_depend_on_rows_and_windows() -> None:
    together = lasting(5, 130)
    for window in (1, 7, 64):
        assert torch.equal(lasting(5, 130, window), together)
    assert torch.equal(lasting(1, 130), together[:, :1])


def test_a_delayed_range_is_nlos_as_it_was() -> None:
    now, late = lasting(5, 80), lasting(5, 80, latency=3)
    assert torch.equal(late[3:], now[:-3])


def test_neighbour_slots_tell_the_same_of_a_link() -> None:
    noise_ = RangeNoise(0.0, nlos=0.3, nlos_kind="constant", nlos_bias=100.0, nlos_time=0.5)
    dense, slots = (
        planar(Ranging(noise_), n_uavs=6, network=Network(max_neighbours=m)) for m in (6, 4)
    )
    for _ in range(20):
        everyone, few = dense.observation(), slots.observation()
        expected = everyone["ranges"].gather(2, few["neighbours"].long())
        assert torch.equal(few["ranges"], expected * few["range_mask"])
        skip(dense)
        skip(slots)


def test_anchors_are_nlos_for_a_while_too() -> None:
    noise_ = RangeNoise(0.0, nlos=0.3, nlos_kind="constant", nlos_bias=100.0, nlos_time=0.5)
    corners = ((0.0, 0.0), (20.0, 0.0), (0.0, 12.0))
    world, found = planar(AnchorRanging(corners, noise_, blocked=(2,)), n_uavs=200), []
    for _ in range(40):
        found.append(world.observation()["anchor_ranges"] > 50.0)
        skip(world)
    late = torch.stack(found).double()
    assert (late[..., 2] == 1).all()
    x = late[..., :2].flatten(1)
    assert near(float(x[30].mean()), 0.3, math.sqrt(0.21 / x.shape[1]))
    kept = float((x[30] * x[33]).mean())
    expected = 0.09 + 0.21 * math.exp(-0.6)
    assert near(kept, expected, 0.5 / math.sqrt(x.shape[1]))


@pytest.mark.parametrize("sensor", [LandmarkBearings(), UavBearings()])
def test_planar_sensors_need_the_plane(sensor: Sensor) -> None:
    with pytest.raises(ValueError, match=r"need.* a 2-D scenario"):
        sensor.leaves(make_scenario("indoor-v0").layout)


@pytest.mark.parametrize("sensor", [Imu(), Height()])
def test_sensors_of_space_need_three_dimensions(sensor: Sensor) -> None:
    with pytest.raises(ValueError, match="needs a 3-D scenario"):
        sensor.leaves(Layout(Arena(2, 3, 0.1, (0.0, 0.0), (1.0, 1.0)), 3))


def test_the_team_finds_its_sensor_models_by_type() -> None:
    believed = make_scenario("indoor-v0", nlos=0.3, believed_uwb_std=0.5, anchors=2).believed
    ranging = believed.sensor(Ranging)
    assert ranging is not None
    assert ranging.noise == RangeNoise(std=0.5)
    assert believed.sensor(Height) is None
    assert isinstance(make_scenario("indoor-v0", imu=False).believed.process, ConstantVelocity)
