"""The picture: shape, content, determinism, and that drawing disturbs nothing else."""

import pickle

import matplotlib
import numpy as np
import pytest
import torch
from PIL import Image

from coloc_env import make_scenario, parallel_env
from coloc_env.render import Renderer, frame_to_png, save_animation
from coloc_env.render.snapshot import take
from coloc_env.world import World


def simulated(steps, **overrides):
    """A renderer that recorded ``steps`` steps of plausible estimates, and its world."""
    scenario = make_scenario("indoor-v0", **overrides)
    world = World(scenario)
    world.reset(3)
    renderer = Renderer(scenario)
    for step in range(steps):
        truth = world.truth
        spread = 0.05 + 0.5 / (1 + step)
        shape = truth.position.shape
        error = torch.full(shape, spread) * (-1) ** step
        log_std = torch.full(shape, spread).log()
        estimate = torch.cat((truth.position + error, truth.velocity, log_std), -1).float()
        renderer.record(world, estimate)
        world.step(estimate)
    return renderer, world


@pytest.mark.parametrize(
    ("overrides", "steps"),
    [
        ({}, 0),
        ({}, 25),
        ({"n_uavs": 1}, 25),
        ({"n_uavs": 40, "max_neighbours": 8}, 3),
        ({"walls": (10.0, 5.0, 0.0, 12.0, 15.0, 5.0), "obstacles": 2}, 3),
        ({"anchors": 4}, 3),
        ({"failure_rate": 1.0, "horizon": 30}, 25),
        ({"landmarks": 0}, 0),
    ],
)
def test_every_kind_of_scene_is_drawn(overrides, steps):
    renderer, world = simulated(steps, **overrides)
    frame = renderer.render(world, "rgb_array")
    assert frame.dtype == np.uint8
    assert frame.ndim == 3
    assert frame.shape[2] == 3
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 20  # something is on it


def test_anchors_are_drawn_where_they_are_and_count_for_nothing():
    world = World(make_scenario("swarm-v0", n_uavs=8, anchor_share=0.4))
    world.reset(0)
    snapshot = take(world, torch.zeros(1, 8, 9))
    assert np.array_equal(snapshot.position, world.truth.position[0].numpy())
    assert np.isnan(snapshot.error[:3]).all()
    assert np.isfinite(snapshot.error[3:]).all()
    renderer = Renderer(world.scenario)
    renderer.record(world, torch.zeros(1, 8, 9))
    world.step(torch.zeros(1, 8, 9))
    assert renderer.render(world, "rgb_array").dtype == np.uint8


def test_same_history_same_picture_and_another_one_differs():
    first, world = simulated(12)
    second, other = simulated(12)
    frame = first.render(world, "rgb_array")
    assert np.array_equal(frame, second.render(other, "rgb_array"))
    third, later = simulated(13)
    assert not np.array_equal(frame, third.render(later, "rgb_array"))


def test_drawing_leaves_pyplot_and_its_settings_alone():
    before = dict(matplotlib.rcParams)
    renderer, world = simulated(2)
    renderer.render(world, "rgb_array")
    assert dict(matplotlib.rcParams) == before


def test_an_env_renders_before_its_first_step_and_pickles():
    env = parallel_env("indoor-v0", render_mode="rgb_array")
    env.reset(seed=1)
    frame = env.render()
    again = pickle.loads(pickle.dumps(env))
    assert np.array_equal(again.render(), frame)
    env.close()


def test_files_of_frames(tmp_path):
    renderer, world = simulated(3)
    frame = renderer.render(world, "rgb_array")
    frame_to_png(frame, tmp_path / "scene.png")
    save_animation([frame, 255 - frame], tmp_path / "flight.gif", 10)
    with Image.open(tmp_path / "scene.png") as png:
        assert png.size == frame.shape[1::-1]
    with Image.open(tmp_path / "flight.gif") as gif:
        assert gif.n_frames == 2
