"""Steered motion: kinematics, limits, walls, and the world's contract with commands."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import coloc_env
from coloc_env import noise
from coloc_env.commands import Commands
from coloc_env.motion import Arena, Groups, Kinematics, RandomWalk, Roam, Steered
from coloc_env.scenarios import make_scenario
from coloc_env.world import World

DT = 0.5
MIDDLE = ((10.0, 10.0), (30.0, 20.0))


def steer(motion: Any, arena: Arena, commands: Tensor, seed: int = 1) -> Kinematics:
    """Truth [1, K, N, d] of a team whose command of step k is ``commands[k]``."""
    carry, parts = motion.start(noise.row_keys(torch.tensor([seed])), arena), []
    for k in range(len(commands)):
        part, carry = motion.advance(carry, torch.tensor([[k]]), arena)
        carry = {**carry, "command": commands[k].expand_as(carry["command"])}
        parts.append(part)
    names = ("position", "velocity", "attitude")
    return Kinematics(*(torch.cat([getattr(p, n) for p in parts], 1) for n in names))


def room(dim: int, n: int = 3) -> Arena:
    return Arena(dim, n, DT, (0.0,) * dim, (40.0, 30.0, 20.0)[:dim])


def random_commands(dim: int, steps: int = 200, size: float = 6.0) -> Tensor:
    g = torch.Generator().manual_seed(dim)
    wanted = torch.randn(steps // 10, 3, dim, generator=g, dtype=torch.float64)
    return size * wanted.repeat_interleave(10, 0)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("control", ["velocity", "acceleration"])
def test_limits_walls_and_constant_acceleration(dim: int, control: Any) -> None:
    arena = room(dim)
    truth = steer(Steered(control, 4.0, 2.0), arena, random_commands(dim))
    p, v = truth.position[0], truth.velocity[0]
    assert v.norm(dim=-1).max() < 4.0 + 1e-12
    high = torch.tensor(arena.high, dtype=torch.float64)
    assert bool((p >= 0).all() & (p <= high).all())
    inner = ((p > 0) & (p < high))[1:] & ((p > 0) & (p < high))[:-1]
    trapezoid = p[:-1] + 0.5 * DT * (v[:-1] + v[1:])
    torch.testing.assert_close(p[1:][inner], trapezoid[inner], rtol=0, atol=1e-12)
    free = inner.all(-1)
    assert v.diff(dim=0).norm(dim=-1)[free].max() < 2.0 * DT + 1e-12
    walls = (p == 0) | (p == high)
    assert walls.any()
    assert not v[walls].any()
    assert v.norm(dim=-1).max() > 3.9


def test_a_velocity_that_is_commanded_is_reached_and_kept() -> None:
    command = torch.tensor([1.2, -0.5], dtype=torch.float64).expand(8, 3, 2)
    truth = steer(Steered("velocity", 3.0, 1.5, MIDDLE), room(2), command)
    torch.testing.assert_close(truth.velocity[0, 3:], command[3:])


def test_acceleration_is_what_is_commanded() -> None:
    command = torch.tensor([0.3, -0.2], dtype=torch.float64).expand(5, 3, 2)
    truth = steer(Steered("acceleration", 30.0, 1.5, MIDDLE), room(2), command)
    torch.testing.assert_close(truth.velocity.diff(dim=1)[0], DT * command[1:])


def test_without_a_command_uavs_stay_and_others_move_on() -> None:
    motion = Groups(((Steered(), 2), (Roam(2.0), 1)))
    truth = steer(motion, room(2), torch.zeros(40, 3, 2, dtype=torch.float64))
    assert not truth.velocity[0, :, :2].any()
    steps = truth.position[0, :, 2].diff(dim=0).norm(dim=-1)
    assert steps.max() < 1.0 + 1e-12
    assert (steps > 0.999).double().mean() > 0.85


def test_a_random_walk_has_the_variance_that_it_says() -> None:
    arena = Arena(2, 200, DT, (-500.0, -500.0), (500.0, 500.0))
    walk = RandomWalk(2.0, ((-1.0, -1.0), (1.0, 1.0)))
    carry = walk.start(noise.row_keys(torch.tensor([3])), arena)
    truth, _ = walk.advance(carry, torch.arange(100).unsqueeze(0), arena)
    leaps = truth.position[0].diff(dim=0)
    assert leaps.var() == pytest.approx(4.0 * DT, rel=0.02)
    last = truth.position[0, -1] - truth.position[0, 0]
    assert last.var() == pytest.approx(4.0 * DT * 99, rel=0.2)


# ---------------------------------------------------------------- the world's contract


def steered_world(rows: int, **more: Any) -> World:
    chosen: dict[str, Any] = {"control": "velocity", "horizon": 30, "landmarks": 3, "anchors": 2}
    return World(make_scenario("indoor-v0", **(chosen | more)), rows)


def command_of(seeds: Tensor, k: Tensor, n: int) -> Tensor:
    """A row's commands, from its seed and own step alone."""
    keys = noise.fold(noise.row_keys(seeds), k)
    return 3 * noise.normal(keys, "commands", 3 * n).unflatten(-1, (n, 3))


def seen(world: World) -> dict[str, Tensor]:
    truth = world.truth
    record = {"position": truth.position, "attitude": truth.attitude, "state": world.state()}
    return record | dict(world.observation().leaves) | {"sent": world.messages_sent}


@pytest.mark.parametrize("control", ["velocity", "acceleration"])
def test_rows_are_the_worlds_of_their_seeds_partial_resets_included(control: str) -> None:
    seeds = torch.tensor([5, 8, 9])
    world, now = steered_world(3, control=control), seeds.clone()
    world.reset(now)
    records = []
    for k in range(12):
        if k == 5:
            rows = torch.tensor([False, True, False])
            now = torch.where(rows, 77, now)
            world.reset(now, rows)
        records.append(seen(world))
        world.step(torch.zeros(3, 6, 9), Commands(command_of(now, world.step_index, 6)))
    for row, seed, first in ((0, 5, 0), (1, 77, 5), (2, 9, 0)):
        alone = steered_world(1, control=control)
        alone.reset([seed])
        for k in range(first, 12):
            for name, value in seen(alone).items():
                assert torch.equal(records[k][name][row], value[0]), (name, k, row)
            command = command_of(torch.tensor([seed]), alone.step_index, 6)
            alone.step(torch.zeros(1, 6, 9), Commands(command))


def test_sensors_measure_the_motion_that_results() -> None:
    """Displacements by an exact INS add up to the path, walls included; commands do not."""
    scenario = make_scenario("swarm-v0", control="velocity", n_uavs=4, size=(90.0, 80.0, 50.0))
    world = World(scenario, 2)
    world.reset(3)
    start, total = world.truth.position, 0.0
    for _ in range(60):
        world.step(torch.zeros(2, 4, 9), Commands(torch.full((2, 4, 3), 20.0)))
        total = total + world.observation()["ins"].double()
    apart = (start + total - world.truth.position).abs()
    assert apart.max() < 5 * (0.5**2 * 60 + (0.3 * 60) ** 2) ** 0.5
    assert (total - 60 * 20.0).abs().min() > 1000


def test_wrong_commands_are_one_line_at_every_face() -> None:
    overrides: dict[str, Any] = {"control": "velocity", "n_uavs": 2, "horizon": 5}
    env = coloc_env.parallel_env("indoor-v0", **overrides)
    env.reset(seed=1)
    width = env.action_space("uav_0").shape
    assert width == (12,)
    good = np.zeros(12, np.float32)
    bad = good.copy()
    bad[-1] = np.nan
    with pytest.raises(ValueError, match="the action of uav_1 holds NaN or infinity") as caught:
        env.step({"uav_0": good, "uav_1": bad})
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"has shape \(9,\)"):
        env.step({"uav_0": good, "uav_1": good[:9]})
    before = env.world.truth.position.clone()
    good[9] = 3.0
    for _ in range(3):
        env.step({"uav_0": good, "uav_1": good * 0})
    moved = (env.world.truth.position - before)[0]
    assert moved[0, 0] > 0.01
    assert not moved[1].any()
    many = coloc_env.CoLocEnv("indoor-v0", 2, seed=1, **overrides)
    td = many.reset()
    td["uav", "action"] = torch.full((2, 2, 12), float("nan"))
    with pytest.raises(ValueError, match="holds NaN or infinity"):
        many.step(td)
    world = World(make_scenario("indoor-v0", horizon=5))
    world.reset(1)
    with pytest.raises(ValueError, match="its motion is not steered"):
        world.step(torch.zeros(1, 6, 9), Commands(torch.zeros(1, 6, 3)))


WALLS = (((18.0, 5.0), (20.0, 25.0)), ((5.0, 12.0), (12.0, 14.0)))


def test_walls_are_never_entered_nor_crossed() -> None:
    start = ((1.0, 1.0), (4.0, 29.0))
    motion = Steered("velocity", 12.0, 6.0, start, WALLS)
    p = steer(motion, room(2, 3), random_commands(2, size=12.0)).position[0]
    way = torch.linspace(0, 1, 101, dtype=torch.float64)[1:-1, None, None, None]
    between = p[:-1] + way * p.diff(dim=0)
    touched = torch.zeros((), dtype=torch.bool)
    for low, high in WALLS:
        bottom, top = torch.tensor(low).double(), torch.tensor(high).double()
        for place in (p, between):
            assert not ((place > bottom + 1e-9) & (place < top - 1e-9)).all(-1).any()
        on = (p >= bottom) & (p <= top)
        touched |= on.all(-1).any()
    assert touched


def test_jerk_is_limited_between_edges() -> None:
    truth = steer(
        Steered("acceleration", 30.0, 2.0, MIDDLE, j_max=0.8), room(2), random_commands(2, 20, 3.0)
    )
    p, v = truth.position[0], truth.velocity[0]
    free = ((p > 0) & (p < torch.tensor(room(2).high))).all(-1)
    free = (free[1:] & free[:-1])[1:] & (free[1:] & free[:-1])[:-1]
    change = v.diff(dim=0).diff(dim=0).norm(dim=-1)[free]
    assert change.max() < 0.8 * DT**2 + 1e-9
    assert change.max() > 0.7 * DT**2
    faster = v.norm(dim=-1).diff(dim=0)
    assert faster.max() < 2.0 * DT + 1e-9  # walls slow down, and throw nobody back
    assert (p == 0).any()


def test_uavs_sent_at_each_other_keep_apart() -> None:
    arena, size = Arena(2, 2, DT, (0.0, 0.0), (200.0, 30.0)), 2.5

    def closest(motion: Steered, seed: int) -> float:
        carry = motion.start(noise.row_keys(torch.tensor([seed])), arena)
        least = 1e9
        for k in range(150):
            truth, carry = motion.advance(carry, torch.tensor([[k]]), arena)
            p = truth.position[0, 0]
            least = min(least, float((p[0] - p[1]).norm()))
            carry = {**carry, "command": 8.0 * (p.flip(0) - p).unsqueeze(0)}
        return least

    for seed in range(5):
        motion = Steered("velocity", 6.0, 2.0, keep_apart=size)
        assert closest(motion, seed) > size - 1e-6
        assert closest(motion, seed) < size + 2.0  # as near as they may
    assert closest(Steered("velocity", 6.0, 2.0), 0) < size
