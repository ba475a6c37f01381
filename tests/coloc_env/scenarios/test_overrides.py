"""Every override of every simulated family does something, from Python and from a command line."""

from typing import Any

import pytest
import torch

from coloc_env.observation import action_width
from coloc_env.scenarios import SCENARIOS, make_scenario, parse_override
from coloc_env.world import World

# One value other than the default for every override of a family.
CHANGED: dict[str, dict[str, Any]] = {
    "indoor-v0": {
        "n_uavs": 3,
        "room": (20.0, 15.0, 4.0),
        "dt": 0.05,
        "horizon": 17,
        "motion": "helix",
        "landmarks": 7,
        "landmark_std": 0.5,
        "landmark_radius": 4.0,
        "false_matches": 0.5,
        "landmark_dropout": 0.5,
        "landmarks_off": (0.0, 1.0),
        "uwb": False,
        "uwb_std": 0.7,
        "nlos": 0.5,
        "nlos_bias": 2.0,
        "nlos_kind": "constant",
        "uwb_tail": 0.5,
        "uwb_tail_std": 3.0,
        "uwb_uniform": 0.5,
        "uwb_impulse": 0.5,
        "uwb_dropout": 0.5,
        "uwb_delay": 1,
        "anchors": 3,
        "nlos_anchor": 1,
        "accel_std": 0.4,
        "gyro_std": 0.3,
        "imu": False,
        "imu_bias": True,
        "accel_bias": 0.9,
        "gyro_bias": 0.9,
        "comm_radius": 3.0,
        "max_neighbours": 2,
        "message_loss": 0.5,
        "message_delay": 1,
        "walls": (14.0, 9.0, 0.0, 16.0, 11.0, 5.0),
        "kidnap_at": 0.2,
        "kidnapped": (0, 4),
        "prior": "uniform",
        "prior_std": 9.0,
        "failure_rate": 1.0,
        "reward": "squared",
        "believed_uwb_std": 0.9,
        "believed_imu_bias": True,
    },
    "wsn-v0": {
        "case": 3,
        "n_uavs": 2,
        "horizon": 17,
        "anchors": 5,
        "r_true": 0.5,
        "r_believed": 0.5,
        "q": 0.5,
        "nlos": 0.5,
        "nlos_anchor": 2,
        "nlos_bias": 2.0,
        "nlos_kind": "constant",
        "dropout": 0.5,
        "kidnap_at": 0.2,
        "max_speed": 2.0,
        "reward": "squared",
    },
    "swarm-v0": {
        "n_uavs": 7,
        "size": (9e3, 8e3, 4e3),
        "layout": "o",
        "motion": "weave",
        "v_max": 100.0,
        "dt": 0.5,
        "horizon": 17,
        "anchor_share": 0.6,
        "anchor_std": 2.0,
        "uwb_std": 5.0,
        "nlos": 0.5,
        "nlos_bias": 40.0,
        "nlos_kind": "exponential",
        "nlos_time": 10.0,
        "uwb_tail": 0.5,
        "uwb_tail_std": 90.0,
        "uwb_dropout": 0.5,
        "ins_std": 1.0,
        "ins_bias": 1.0,
        "ins_bias_time": 5.0,
        "comm_radius": 2e3,
        "link_failure": 0.5,
        "message_loss": 0.5,
        "message_delay": 1,
        "prior_std": 9.0,
        "failure_rate": 1.0,
        "reward": "squared",
    },
    "campus-v0": {
        "flight": "s1",
        "n_uavs": 7,
        "dt": 0.05,
        "horizon": 17,
        "anchor_share": 0.6,
        "anchor_std": 2.0,
        "uwb_std": 5.0,
        "believed_uwb_std": 0.5,
        "wall_loss": 0.0,
        "wall_excess": 0.5,
        "nlos": 0.5,
        "nlos_bias": 40.0,
        "nlos_kind": "constant",
        "uwb_dropout": 0.5,
        "clock_offset": 0.9,
        "clock_skew": 0.9,
        "ins_std": 1.0,
        "ins_bias": 1.0,
        "ins_bias_time": 5.0,
        "comm_radius": 10.0,
        "link_failure": 0.5,
        "message_loss": 0.5,
        "message_delay": 1,
        "prior_std": 9.0,
        "failure_rate": 1.0,
        "gps_cep": 1.5,
        "reward": "squared",
    },
    "stein2d-v0": {
        "n_uavs": 4,
        "horizon": 17,
        "dt": 0.2,
        "size": 12.0,
        "motion": "circle",
        "outliers": 0.9,
        "matches_per_step": 2,
        "relative_pose_noise": (0.1, 4.0),
        "odometry_noise": (0.02, 1.0),
        "comm_radius": 1.0,
        "message_loss": 0.5,
        "failure_rate": 1.0,
        "reward": "squared",
    },
    "stein3d-v0": {
        "n_uavs": 4,
        "horizon": 17,
        "dt": 0.2,
        "size": 12.0,
        "motion": "random",
        "outliers": 0.9,
        "matches_per_step": 2,
        "relative_pose_noise": (0.1, 4.0),
        "odometry_noise": (0.02, 1.0),
        "comm_radius": 1.0,
        "message_loss": 0.5,
        "failure_rate": 1.0,
        "reward": "squared",
    },
}
# Overrides that show only together with another.
WITH: dict[str, dict[str, dict[str, Any]]] = {
    "indoor-v0": {
        "nlos_bias": {"nlos": 0.5},
        "nlos_kind": {"nlos": 0.5},
        "uwb_tail_std": {"uwb_tail": 0.5},
        "nlos_anchor": {"anchors": 2},
        "kidnapped": {"kidnap_at": 0.2},
        "accel_bias": {"imu_bias": True},
        "gyro_bias": {"imu_bias": True},
        "failure_rate": {"horizon": 4},
    },
    "wsn-v0": {"nlos_bias": {"nlos": 0.5}, "nlos_kind": {"nlos": 0.5}},
    "swarm-v0": {
        "uwb_tail_std": {"uwb_tail": 0.5},
        "failure_rate": {"horizon": 4},
    },
    "campus-v0": {
        "nlos_bias": {"nlos": 0.5},
        "nlos_kind": {"nlos": 0.5},
        "wall_loss": {"flight": "s3"},
        "wall_excess": {"flight": "s3", "wall_loss": 0.0},
        "failure_rate": {"horizon": 4},
    },
    "stein2d-v0": {"failure_rate": {"horizon": 4}},
    "stein3d-v0": {"failure_rate": {"horizon": 4}},
}
SMALL: dict[str, dict[str, Any]] = {"swarm-v0": {"n_uavs": 6, "anchor_share": 0.3, "nlos": 0.4}}
EACH = [(family, name) for family, changed in CHANGED.items() for name in changed]


def told(family: str, **overrides: Any) -> tuple[Any, ...]:
    """All that one world does in four steps, and what its team believes."""
    scenario = make_scenario(family, **SMALL.get(family, {}) | overrides)
    world = World(scenario)
    seen, brought = world.reset(0), []
    for _ in range(4):
        step = world.step(torch.ones(1, scenario.arena.n_uavs, action_width(scenario)))
        brought.append(
            {k: v.tolist() for k, v in seen.leaves.items()} | {"r": step.reward.tolist()}
        )
        seen = world.observation()
    return brought, scenario.horizon, scenario.believed, scenario.reference


@pytest.mark.parametrize("family", CHANGED)
def test_every_override_is_tried(family: str) -> None:
    assert set(CHANGED[family]) == set(SCENARIOS.options_of(family))


@pytest.mark.parametrize(("family", "name"), EACH)
def test_every_override_changes_something(family: str, name: str) -> None:
    others = WITH[family].get(name, {})
    assert told(family, **others) != told(family, **others, **{name: CHANGED[family][name]})


@pytest.mark.parametrize(("family", "name"), EACH)
def test_every_override_is_read_from_the_command_line(family: str, name: str) -> None:
    value = CHANGED[family][name]
    text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
    assert parse_override(family, f"{name}={text}") == (name, value)
