"""Numbers that no sensor can have measured are as if nothing had been."""

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from coloc_env.observation import Observation
from coloc_env.scenarios import make_scenario
from coloc_env.sensors.base import usable
from tests.sampling import crossed

RANGES = {"range_mask", "anchor_range_mask", "landmark_bearing_mask", "uav_bearing_mask"}
OTHERS = {"landmark_mask", "height_mask", "position_fix_mask", "relative_pose_mask"}
BAD = (math.nan, math.inf, -math.inf, -1.0, 0.0, 1e6)
CASES = [
    ("ekf", "default"),
    ("ekf:robust=huber+gate+ransac+temporal+cross:fusion=ci", "default"),
    ("ekf", "plane"),
    ("ekf", "tags"),
    ("ekf_joint", "default"),
    ("ekf_joint", "plane"),
    ("ekf_trust", "default"),
    ("pf500", "default"),
    ("apf", "plane"),
    ("pfnn", "tags"),
    ("emvf", "tags"),
    ("emvf", "wsn"),
    ("hpff", "wsn"),
    ("nnhpff", "anchors"),
    ("pf_trust", "plane"),
    ("stein_vi", "sight"),
    ("cspf", "stein2d"),
    ("pf_joint", "stein2d"),
    ("pose_graph", "stein3d"),
    ("map", "swarm"),
    ("dwmds_st", "swarm"),
    ("dwmds_st", "campus"),
    ("vmds", "anchors"),
    ("fcmds", "many"),
    ("gn", "tags"),
    ("mds", "tags"),
    ("dwmds", "ranges"),
    ("stdcl", "swarm"),
    ("stgat", "swarm"),
    ("mappo", "default"),
    ("mappo", "plane"),
]


def corrupted(
    observation: Observation, bad: float, share: float, tools: SimpleNamespace
) -> tuple[Observation, Observation]:
    """The observation with the bad value in some numbers, whether there is a measurement or not;
    and with those measurements missing."""
    g = torch.Generator().manual_seed(7)
    spoiled, missing = {}, {}
    impossible = RANGES if math.isfinite(bad) else RANGES | OTHERS
    for mask, leaf in tools.masked_pairs(observation).items():
        if mask not in impossible:
            continue
        seen = observation[mask]
        where = torch.rand(seen.shape, generator=g) < share
        values = observation[leaf].unflatten(-1, (seen.shape[-1], -1)).clone()
        values[..., 0] = values[..., 0].masked_fill(where, bad)  # ranges come first
        spoiled[leaf], missing[mask] = values.flatten(-2), seen.masked_fill(where, 0.0)
    if not spoiled:
        pytest.skip("nothing that is measured here can have this value and be impossible")
    return tools.change(observation, **spoiled), tools.change(observation, **missing)


@pytest.mark.parametrize(("name", "family", "bad"), crossed(CASES, BAD, every=3))
def test_impossible_values_are_not_measured(
    name: str, family: str, bad: float, tools: SimpleNamespace
) -> None:
    scenario = tools.families[family]()
    localizer = tools.build(name, scenario)
    run = tools.play(localizer, scenario, [3, 4], 3)
    pairs = [corrupted(o, bad, 0.4, tools) for o in run.observations]
    spoiled, missing = (tools.replay(localizer, list(part)) for part in zip(*pairs, strict=True))
    for one, other in zip(spoiled.estimates, missing.estimates, strict=True):
        tools.assert_same(one, other)
    assert spoiled.position.isfinite().all()


@pytest.mark.parametrize("name", ["ekf", "ekf:fusion=ci", "pf500"])
def test_a_broken_message_is_not_received(name: str, tools: SimpleNamespace) -> None:
    scenario = tools.families["default"]()
    localizer = tools.build(name, scenario)
    observations = tools.play(localizer, scenario, [0, 1], 4).observations
    broken, silent = [], []
    for o in observations:
        messages = o["messages"].unflatten(-1, (o["message_mask"].shape[-1], -1)).clone()
        messages[..., 2, 4] = math.nan
        mask = o["message_mask"].clone()
        mask[..., 2] = 0.0
        broken.append(tools.change(o, messages=messages.flatten(-2)))
        silent.append(tools.change(o, message_mask=mask))
    runs = [tools.replay(localizer, part) for part in (broken, silent)]
    tools.assert_same(runs[0].estimates[-1], runs[1].estimates[-1])


numbers = st.floats(width=32, allow_nan=True, allow_infinity=True)


@settings(deadline=None)
@given(st.lists(st.tuples(numbers, numbers, st.booleans()), min_size=1, max_size=8), st.booleans())
def test_usable_is_what_is_there_finite_and_positive(rows: list, ranges: bool) -> None:
    z = torch.tensor([[a, b] for a, b, _ in rows])
    found, mask = usable(z, torch.tensor([there for *_, there in rows]), ranges)
    for (a, b, there), value, kept in zip(rows, found.tolist(), mask.tolist(), strict=True):
        possible = math.isfinite(a) and math.isfinite(b) and (not ranges or 0 < a <= 1e4)
        assert kept == (there and possible)
        assert value == ([a, b] if kept else [0.0, 0.0])


ZEROS = {
    "prior": {"prior_std": 0.0},
    "sensors": {"landmark_std": 0.0, "uwb_std": 0.0},
    "everything": dict.fromkeys(
        ("prior_std", "landmark_std", "uwb_std", "accel_std", "gyro_std"), 0.0
    ),
}


@pytest.mark.parametrize("exact", ["accel_bias", "gyro_bias"])
@pytest.mark.parametrize("name", ["ekf", "ekf_joint", "emvf", "pf500", "stein_vi"])
def test_one_of_two_biases_may_be_exact(name: str, exact: str, tools: SimpleNamespace) -> None:
    """Its variance of 0 would leave the prior's covariance without an inverse."""
    scenario = make_scenario("indoor-v0", imu_bias=True, uwb=name != "stein_vi", **{exact: 0.0})
    run = tools.play(tools.build(name, scenario), scenario, [0], 4)
    assert run.position.isfinite().all()


@pytest.mark.parametrize("zero", ZEROS)
@pytest.mark.parametrize("name", ["ekf", "ekf_joint", "ekf_trust", "pf500", "apf", "pf_trust"])
def test_a_world_without_noise_leaves_filters_sound(
    name: str, zero: str, tools: SimpleNamespace
) -> None:
    """Filters assume a floor: nothing divides by zero, and no error is far beyond its std."""
    found = tools.score(name, make_scenario("indoor-v0", **ZEROS[zero]), 3, 12)
    assert found.rmse < 0.1
    assert found.nees.isfinite().all()
    assert found.nees.mean() < 40
