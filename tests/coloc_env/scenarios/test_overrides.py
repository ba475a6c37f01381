"""Every override of every simulated family does something, from Python and from a command line."""

from functools import cache
from typing import Any

import pytest
import torch

from coloc_env.commands import SILENT, Commands
from coloc_env.observation import action_width
from coloc_env.scenarios import SCENARIOS, make_scenario, parse_overrides, parse_scenario
from coloc_env.world import World

RANGES: dict[str, Any] = {
    "uwb_std": 0.7,
    "uwb_std_per_metre": 0.05,
    "believed_uwb_std": 0.9,
    "nlos": 0.5,
    "nlos_bias": 40.0,
    "nlos_kind": "constant",
    "nlos_time": 10.0,
    "uwb_tail": 0.5,
    "uwb_tail_std": 90.0,
    "uwb_uniform": 0.5,
    "uwb_impulse": 0.5,
    "uwb_impulse_size": 99.0,
    "uwb_dropout": 0.5,
    "range_bias_std": 0.5,
    "range_bias_time": 3.0,
    "uwb_outage": 0.5,
    "uwb_outage_time": 0.2,
    "uwb_outage_of": "team",
    "uwb_off": (0.0, 0.2),
}
DELAYED = {**RANGES, "uwb_delay": 1}
LANDMARKS: dict[str, Any] = {
    "landmarks": 7,
    "landmark_std": 0.5,
    "landmark_radius": 4.0,
    "false_matches": 0.5,
    "landmark_dropout": 0.5,
    "range_only": (0.0, 1.0),
    "association": "unknown",
    "alias_time": 3.0,
    "landmark_placement": "symmetric",
    "landmark_field": 1.0,
}
INS: dict[str, Any] = {"ins_std": 1.0, "ins_bias": 1.0, "ins_bias_time": 5.0}
PRIOR: dict[str, Any] = {"prior": "uniform", "prior_std": 9.0, "max_speed": 2.0}
NETWORK: dict[str, Any] = {
    "comm_radius": 1.0,
    "link_failure": 0.5,
    "message_loss": 0.5,
    "message_delay": 1,
    "links": "broadcast",
    "interference": 0.5,
}
TEAM: dict[str, Any] = {"n_uavs": 3, "failure_rate": 1.0, "reward": "squared"}
CONTROL: dict[str, Any] = {
    "control": "velocity",
    "a_max": 2.0,
    "j_max": 0.3,
    "keep_apart": 9.0,
}
KIDNAPPING: dict[str, Any] = {"kidnap_at": 0.2, "kidnapped": (0,)}
CARRIED: dict[str, Any] = {
    "tags": 2,
    "tag_arm": 0.3,
    "tdoa_anchors": 5,
    "tdoa_std": 0.5,
    "tdoa_radius": 15.0,
    "tdoa_dropout": 0.5,
    "tdoa_tail": 0.5,
    "tdoa_tail_std": 9.0,
    "angles": True,
    "azimuth_std": 0.2,
    "elevation_std": 0.2,
    "angle_field": 0.2,
    "angle_radius": 5.0,
    "angle_dropout": 0.5,
    "gnss": True,
    "gnss_std": 0.5,
    "gnss_vertical_std": 5.0,
    "gnss_outage": 0.5,
    "gnss_outage_time": 0.2,
    "gnss_off": (0.0, 0.2),
    "gnss_dropout": 0.5,
    "flow": True,
    "flow_std": 0.5,
    "flow_lowest": 3.0,
    "flow_highest": 2.0,
    "flow_dropout": 0.5,
    "barometer": True,
    "barometer_std": 0.5,
    "barometer_drift": 2.0,
    "barometer_time": 5.0,
    "barometer_dropout": 0.5,
    "compass": True,
    "compass_std": 0.5,
    "compass_dropout": 0.5,
    "light": True,
    "lamps": 3,
    "lamp_power": 500.0,
    "light_ambient": 5.0,
    "light_share": 0.2,
    "light_floor": 9.0,
    "light_angle_std": 0.2,
    "light_radius": 5.0,
    "rssi": True,
    "access_points": 3,
    "rssi_uavs": True,
    "rssi_std": 9.0,
    "rssi_power": -30.0,
    "rssi_exponent": 3.0,
    "rssi_wall_loss": 9.0,
    "rssi_dropout": 0.5,
    "ultrasonic": True,
    "ultrasonic_std": 0.5,
    "ultrasonic_reach": 2.0,
    "ultrasonic_dropout": 0.6,
    "magnetic": True,
    "magnetic_std": 2.0,
    "anomaly_std": 9.0,
    "anomaly_length": 3.0,
    "magnetic_map_std": 2.0,
    "magnetic_map_time": 2.0,
    "building": 3,
    "magnetic_dropout": 0.5,
}
IN_THE_WAY = (11.0, 9.0, 0.0, 11.5, 11.0, 5.0)
PILLAR = (14.0, 9.0, 0.0, 16.0, 11.0, 5.0)
STEIN: dict[str, Any] = {
    "horizon": 17,
    "dt": 0.2,
    "size": 12.0,
    "outliers": 0.9,
    "matches_per_step": 2,
    "relative_pose_noise": (0.1, 4.0),
    "odometry_noise": (0.02, 1.0),
    **NETWORK,
    **TEAM,
    "n_uavs": 4,
}
# One value other than the default for every override of a family.
CHANGED: dict[str, dict[str, Any]] = {
    "indoor-v0": {
        "room": (20.0, 15.0, 4.0),
        "dt": 0.05,
        "horizon": 17,
        "motion": "helix",
        "uwb": False,
        "anchors": 3,
        "nlos_anchor": 1,
        "biased_anchors": 2,
        "anchor_bias": 2.0,
        "anchor_bias_rise": 5.0,
        "imu": False,
        "imu_bias": True,
        "accel_std": 0.4,
        "gyro_std": 0.3,
        "accel_bias": 0.9,
        "gyro_bias": 0.9,
        "believed_imu_bias": True,
        "max_neighbours": 2,
        "landmarks_known": False,
        "walls": PILLAR,
        "wall_delay": 2.0,
        "wall_std": 0.9,
        "obstacles": 9,
        "obstacle_radius": 2.0,
        "obstacle_speed": 3.0,
        "gust_std": 0.5,
        "gust_time": 3.0,
        **CARRIED,
        **TEAM,
        **LANDMARKS,
        **DELAYED,
        **NETWORK,
        **KIDNAPPING,
        **CONTROL,
        "v_max": 2.0,
        **PRIOR,
        "prior_attitude_std": 0.4,
        "prior_yaw": "uniform",
        "comm_radius": 3.0,
    },
    "wsn-v0": {
        "case": 3,
        "horizon": 17,
        "anchors": 5,
        "q": 0.5,
        "nlos_anchor": 2,
        "biased_anchors": 2,
        "anchor_bias": 2.0,
        "anchor_bias_rise": 5.0,
        "max_speed": 2.0,
        **TEAM,
        **RANGES,
        **KIDNAPPING,
    },
    "swarm-v0": {
        "size": (9e3, 8e3, 4e3),
        "layout": "o",
        "motion": "weave",
        "v_max": 100.0,
        "dt": 0.5,
        "horizon": 17,
        "anchor_share": 0.6,
        "anchor_std": 2.0,
        **TEAM,
        **DELAYED,
        **INS,
        **NETWORK,
        **CONTROL,
        **PRIOR,
        "n_uavs": 7,
        "nlos_kind": "exponential",
        "comm_radius": 2e3,
        "keep_apart": 5e3,
    },
    "campus-v0": {
        "flight": "s1",
        "dt": 0.05,
        "horizon": 17,
        "anchor_share": 0.6,
        "anchor_std": 2.0,
        "wall_loss": 0.0,
        "wall_excess": 0.5,
        "clock_offset": 0.9,
        "clock_skew": 0.9,
        "gps_cep": 1.5,
        **TEAM,
        **DELAYED,
        **INS,
        **NETWORK,
        **PRIOR,
        "n_uavs": 7,
        "comm_radius": 10.0,
    },
    "stein2d-v0": {**STEIN, "motion": "circle"},
    "stein3d-v0": {
        **STEIN,
        "motion": "random",
        "imu": True,
        "top_speed": 5.0,
        "accel_std": 0.4,
        "gyro_std": 0.3,
    },
}
# Overrides that show only together with another.
RANGES_WITH: dict[str, dict[str, Any]] = {
    "nlos_bias": {"nlos": 0.5},
    "nlos_kind": {"nlos": 0.5},
    "range_bias_time": {"range_bias_std": 1.0},
    "nlos_time": {"nlos": 0.5},
    "uwb_tail_std": {"uwb_tail": 0.5},
    "uwb_impulse_size": {"uwb_impulse": 0.5},
    "uwb_outage_time": {"uwb_outage": 0.5},
    "uwb_outage_of": {"uwb_outage": 0.5},
}
FAILING: dict[str, dict[str, Any]] = {"failure_rate": {"horizon": 4}}
STEERED: dict[str, dict[str, Any]] = {
    "a_max": {"control": "acceleration"},
    "j_max": {"control": "velocity"},
    "keep_apart": {"control": "velocity"},
}
CALLED: dict[str, dict[str, Any]] = {"interference": {"links": "chosen", "n_uavs": 4}}
UNIFORM: dict[str, dict[str, Any]] = {"max_speed": {"prior": "uniform"}}
WITH: dict[str, dict[str, dict[str, Any]]] = {
    "indoor-v0": {
        **RANGES_WITH,
        **FAILING,
        **CALLED,
        **UNIFORM,
        **STEERED,
        "v_max": {"control": "velocity"},
        "wall_delay": {"walls": PILLAR},
        "wall_std": {"walls": PILLAR},
        "obstacle_radius": {"obstacles": 9},
        "obstacle_speed": {"obstacles": 9},
        "gust_time": {"gust_std": 0.5},
        "nlos_anchor": {"anchors": 2},
        "biased_anchors": {"anchors": 2},
        "anchor_bias": {"anchors": 2, "biased_anchors": 1},
        "anchor_bias_rise": {"anchors": 2, "biased_anchors": 1},
        "alias_time": {"false_matches": 0.5},
        "kidnapped": {"kidnap_at": 0.2},
        "accel_bias": {"imu_bias": True},
        "gyro_bias": {"imu_bias": True},
        **{n: {"tdoa_anchors": 8} for n in CARRIED if n.startswith("tdoa_") and n[5:] != "anchors"},
        "tdoa_tail_std": {"tdoa_anchors": 8, "tdoa_tail": 0.5},
        **{name: {"angles": True} for name in CARRIED if name.startswith(("angle_", "azi", "ele"))},
        **{name: {"gnss": True} for name in CARRIED if name.startswith("gnss_")},
        **{name: {"flow": True} for name in CARRIED if name.startswith("flow_")},
        **{name: {"barometer": True} for name in CARRIED if name.startswith("barometer_")},
        **{name: {"compass": True} for name in CARRIED if name.startswith("compass_")},
        **{n: {"light": True} for n in CARRIED if n.startswith(("light_", "lamp"))},
        **{n: {"rssi": True} for n in CARRIED if n.startswith(("rssi_", "access"))},
        "rssi_uavs": {},
        "rssi_wall_loss": {"rssi": True, "walls": IN_THE_WAY},
        **{name: {"ultrasonic": True} for name in CARRIED if name.startswith("ultrasonic_")},
        **{
            n: {"magnetic": True}
            for n in CARRIED
            if n.startswith(("magnetic_", "anomaly_", "build"))
        },
        "gnss_outage_time": {"gnss": True, "gnss_outage": 0.5},
    },
    "wsn-v0": {
        **RANGES_WITH,
        **FAILING,
        "anchor_bias": {"biased_anchors": 1},
        "anchor_bias_rise": {"biased_anchors": 1},
        "kidnapped": {"kidnap_at": 0.2, "n_uavs": 2},
    },
    "swarm-v0": {
        **RANGES_WITH,
        **FAILING,
        **UNIFORM,
        **STEERED,
        "interference": CALLED["interference"] | {"comm_radius": 2e4},
    },
    "campus-v0": {
        **RANGES_WITH,
        **FAILING,
        **CALLED,
        **UNIFORM,
        "wall_loss": {"flight": "s3"},
        "wall_excess": {"flight": "s3", "wall_loss": 0.0},
    },
    "stein2d-v0": FAILING | CALLED,
    "stein3d-v0": {
        **FAILING,
        **CALLED,
        **{name: {"imu": True} for name in ("top_speed", "accel_std", "gyro_std")},
    },
}
SMALL: dict[str, dict[str, Any]] = {"swarm-v0": {"n_uavs": 6, "anchor_share": 0.3, "nlos": 0.4}}
EACH = [(family, name) for family, changed in CHANGED.items() for name in changed]


def world_of(family: str, **overrides: Any) -> tuple[Any, ...]:
    """All that one world does in four steps, and what its team believes. UAVs that are steered are
    all sent one way; where they choose whom to call, UAV 0 calls 1, and 2 calls 3."""
    scenario = make_scenario(family, **SMALL.get(family, {}) | overrides)
    world, n = World(scenario, window=5), scenario.arena.n_uavs
    way = -torch.ones(1, n, scenario.arena.dim) if scenario.motion.steered else None
    calls = torch.full((1, n), SILENT)
    calls[0, :4:2] = torch.arange(1, n + 1)[: len(calls[0, :4:2]) * 2 : 2]
    called = None if scenario.network.links == "all" else calls
    seen, brought = world.reset(0), []
    for _ in range(4):
        estimates = torch.ones(1, n, action_width(scenario))
        step = world.step(estimates, Commands(way, called))
        brought.append(
            {k: v.tolist() for k, v in seen.leaves.items()} | {"r": step.reward.tolist()}
        )
        seen = world.observation()
    return brought, scenario.horizon, scenario.believed, scenario.reference


@cache
def unchanged(family: str, others: tuple[tuple[str, Any], ...]) -> tuple[Any, ...]:
    return world_of(family, **dict(others))


def test_an_override_given_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="indoor-v0: nlos is given twice"):
        parse_overrides("indoor-v0", ["nlos=0.1", "horizon=9", "nlos=0.1"])
    with pytest.raises(ValueError, match="indoor-v0: nlos is given twice"):
        parse_scenario("indoor-v0:nlos=0.1:nlos=0.2")


def test_a_variants_overrides_go_first() -> None:
    scenario = parse_scenario("indoor-v0:nlos=0.1:horizon=9", "nlos=0.2")
    assert scenario.overrides == {"nlos": 0.2, "horizon": 9}


@pytest.mark.parametrize("family", CHANGED)
def test_every_override_is_tried(family: str) -> None:
    assert set(CHANGED[family]) == set(SCENARIOS.options_of(family))


@pytest.mark.parametrize(("family", "name"), EACH)
def test_every_override_changes_something(family: str, name: str) -> None:
    others = WITH[family].get(name, {})
    changed = world_of(family, **others, **{name: CHANGED[family][name]})
    assert unchanged(family, tuple(others.items())) != changed


@pytest.mark.parametrize(("family", "name"), EACH)
def test_every_override_is_read_from_the_command_line(family: str, name: str) -> None:
    value = CHANGED[family][name]
    text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
    assert parse_overrides(family, [f"{name}={text}"]) == {name: value}
