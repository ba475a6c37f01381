"""Links that actions decide upon, as overrides of scenarios: who calls exchanges, on every face."""

from typing import Any

import numpy as np
import pytest
import torch

import coloc_env
from coloc_env.envs.torchrl import CoLocEnv

SHORT: dict[str, Any] = {"n_uavs": 3, "horizon": 6, "links": "chosen"}


@pytest.mark.parametrize("scenario", ["indoor-v0", "swarm-v0"])
def test_who_calls_ranges_and_who_does_not_hears_nothing(scenario: str) -> None:
    steered = {"control": "velocity"} if scenario == "indoor-v0" else {}
    env = coloc_env.parallel_env(scenario, **SHORT, **steered)
    env.reset(seed=1)
    space = env.action_space("uav_0")
    assert space.shape == (9 + 3 * bool(steered) + 1,)
    assert (space.low[-1], space.high[-1]) == (-1.0, 2.0)
    silent = np.zeros(space.shape, np.float32)
    silent[-1] = -1.0
    calls = silent.copy()
    calls[-1] = 2.0
    seen, *_ = env.step({"uav_0": calls, "uav_1": silent, "uav_2": silent})
    assert seen["uav_0"]["range_mask"].tolist() == [0.0, 0.0, 1.0]
    assert seen["uav_2"]["range_mask"].tolist() == [1.0, 0.0, 0.0]
    assert not seen["uav_1"]["message_mask"].any()
    seen, *_ = env.step({"uav_0": calls, "uav_1": calls, "uav_2": silent})  # both call one
    assert not any(each["range_mask"].any() for each in seen.values())
    assert env.world.messages_sent[0].tolist() == [2, 1, 0]


def test_who_speaks_is_heard_by_all_and_the_batched_face_agrees() -> None:
    chosen = {**SHORT, "links": "broadcast"}
    env = coloc_env.parallel_env("indoor-v0", **chosen)
    many = CoLocEnv("indoor-v0", 2, seed=4, **chosen)
    td = many.reset()
    env.reset(seed=5)
    action = torch.zeros(2, 3, 10)
    action[..., -1] = torch.tensor([-1.0, 0.0, -1.0])
    td["uav", "action"] = action
    td = many.step(td)["next"]
    rows = dict(zip(env.agents, action[1].numpy(), strict=True))
    seen, *_ = env.step(rows)
    for i, agent in enumerate(seen):
        for name in ("ranges", "range_mask", "messages"):
            found = td["uav", "observation", name][1, i].numpy()
            np.testing.assert_array_equal(found, seen[agent][name])
    assert [bool(each["range_mask"].any()) for each in seen.values()] == [True, False, True]
