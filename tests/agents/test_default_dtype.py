"""torch's default dtype changes nothing, to the last bit: worlds, estimates, networks, bounds."""

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import make
from agents.trust.network import TrustNetwork
from agents.weights import untrained
from coloc_env.bounds import posterior_bound
from coloc_env.envs.pettingzoo import parallel_env
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.motion import MOTIONS
from coloc_env.scenarios import make_scenario
from coloc_env.world import World
from tests.sampling import crossed

SCENARIOS: dict[str, dict[str, Any]] = {
    "indoor-v0": {
        "n_uavs": 3,
        "anchors": 4,
        "nlos": 0.3,
        "uwb_tail": 0.2,
        "uwb_uniform": 0.1,
        "uwb_impulse": 0.1,
        "imu_bias": True,
        "false_matches": 0.1,
        "message_loss": 0.2,
        "failure_rate": 0.3,
    },
    "campus-v0": {},
    "swarm-v0": {"n_uavs": 20},
    "stein2d-v0": {},
    "stein3d-v0": {},
    "wsn-v0": {},
}
CASES = [
    *(("indoor-v0", x) for x in ("ekf", "ekf_joint", "emvf", "pf500", "apf", "hpff", "nnhpff")),
    *(("indoor-v0", x) for x in ("pfnn", "ekf_trust", "pf_trust", "mappo", "ippo", "sb3-ppo")),
    *(("indoor-v0", x) for x in ("ekf:robust=huber+gate+ransac+temporal+cross", "pf800")),
    *(("campus-v0", x) for x in ("ekf", "map", "stdcl")),
    *(("swarm-v0", x) for x in ("dwmds_st", "dwmds", "map", "gn", "mds", "fcmds", "vmds")),
    *(("swarm-v0", x) for x in ("stdcl", "stdcl:variant=calibrated", "stgat")),
    *(("stein2d-v0", x) for x in ("cspf", "pf_joint")),
    *(("stein3d-v0", x) for x in ("cspf", "pf_joint")),
    ("wsn-v0", "nnhpff"),
]


DTYPES = [torch.float64, torch.float16]


@pytest.fixture(params=DTYPES, ids=str)
def other(request: pytest.FixtureRequest) -> Iterator[torch.dtype]:
    yield request.param
    torch.set_default_dtype(torch.float32)


def assert_same(ours: list[dict[str, Tensor]], theirs: list[dict[str, Tensor]]) -> None:
    for one, two in zip(ours, theirs, strict=True):
        assert one.keys() == two.keys()
        for name in one:
            assert one[name].dtype == two[name].dtype, name
            assert torch.equal(one[name].nan_to_num(-7.0), two[name].nan_to_num(-7.0)), name


def steps(scenario: str, agent: str | None, settings: dict[str, Any]) -> list[dict[str, Tensor]]:
    """Everything that a world and an agent give in four steps."""
    built = make_scenario(scenario, horizon=6, **settings)
    world = World(built, 2, window=5)
    now, found = world.reset(3), []
    localizer: Any = make(agent, built) if agent else None
    belief = localizer.reset(now) if agent else None
    action = torch.zeros(2, built.arena.n_uavs, 3 * built.arena.dim, dtype=torch.float32)
    for _ in range(4):
        found.append(dict(now.leaves))
        if agent:
            belief, estimate = localizer.step(belief, now)
            action = estimate.action()
            found.append({k: getattr(estimate, k) for k in ("position", "velocity", "covariance")})
        step = world.step(action)
        found.append({"reward": step.reward, "error": step.error, "state": world.state()})
        now = world.observation()
    return found


@pytest.mark.parametrize(
    ("scenario", "agent", "other"), crossed(CASES, DTYPES, every=2), indirect=["other"]
)
def test_estimates_are_the_same(scenario: str, agent: str, other: torch.dtype) -> None:
    settings = SCENARIOS[scenario]
    expected = steps(scenario, agent, settings)
    torch.set_default_dtype(other)
    assert_same(steps(scenario, agent, settings), expected)


@pytest.mark.parametrize("motion", MOTIONS)
def test_worlds_are_the_same(motion: str, other: torch.dtype) -> None:
    for reward in ("error", "team", "log_score"):
        settings = {"motion": motion, "reward": reward, "n_uavs": 3}
        expected = steps("indoor-v0", None, settings)
        torch.set_default_dtype(other)
        assert_same(steps("indoor-v0", None, settings), expected)
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("mode", ["estimate", "displacement"])
def test_faces_are_the_same(mode: str, other: torch.dtype) -> None:
    def entries() -> list[dict[str, Tensor]]:
        made = CoLocEnv("indoor-v0", 2, seed=3, action=mode, n_uavs=2)
        assert made.full_action_spec["uav", "action"].dtype == torch.float32
        now, found = made.reset(), []
        for _ in range(3):
            zeros = torch.zeros(2, 2, made.mode.width, dtype=torch.float32)
            now["uav", "action"] = zeros
            now = made.step(now)["next"]
            assert made.observation_spec.is_in(now.select(*made.observation_spec.keys(True, True)))
            found.append({str(key): now[key].clone() for key in now.keys(True, True)})
        return found

    expected = entries()
    torch.set_default_dtype(other)
    assert_same(entries(), expected)
    single = parallel_env(n_uavs=2, action=mode)
    observations, _ = single.reset(seed=0)
    assert single.observation_space("uav_0").contains(observations["uav_0"])
    assert single.state_space.contains(single.state())


def test_networks_are_float32(other: torch.dtype) -> None:
    expected = untrained(TrustNetwork, 0).state_dict()
    torch.set_default_dtype(other)
    found = untrained(TrustNetwork, 0).state_dict()
    assert torch.get_default_dtype() == other
    assert_same([found], [expected])


def test_the_bound_is_the_same(other: torch.dtype) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2, horizon=5, anchors=2, nlos=0.2)
    expected = posterior_bound(scenario, runs=2).mse
    torch.set_default_dtype(other)
    assert torch.equal(posterior_bound(scenario, runs=2).mse, expected)
