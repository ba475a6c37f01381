"""Nothing but measurements tells a learned policy where it is.

On the paper's fixed circle a position is a function of yaw and time, which a policy can learn by
heart; so policies train and are scored with ``motion=random``, and are lost without landmarks.
"""

import pytest
import torch

from agents import make
from agents.weights import card_of
from coloc_env.scenarios import make_scenario, parse_scenario
from training.evaluation.record import record

POLICIES = ("mappo", "ippo", "sb3-ppo")
_SCENARIO = {"motion": "random", "horizon": 100}


def error(agent: str, seeds: int = 8, **overrides: float) -> float:
    """Mean error (m) from step 20 on."""
    scenario = make_scenario("indoor-v0", **_SCENARIO, **overrides)
    found = record(make(agent, scenario), scenario, torch.arange(seeds))
    return float(found.error[:, 20:].mean())


@pytest.mark.parametrize("name", POLICIES)
def test_shipped_policies_were_trained_where_nothing_leaks(name: str) -> None:
    motion = parse_scenario(card_of(name)["options"]["scenario"]).motion
    assert type(motion).__name__ == "RandomCircles"


def test_without_landmarks_a_policy_that_localizes_alone_is_lost() -> None:
    assert error("ippo") < 0.6
    assert error("ippo", landmark_dropout=1.0) > 3.0


@pytest.mark.parametrize("name", ["mappo", "sb3-ppo"])
def test_without_landmarks_a_correction_is_lost_with_its_base(name: str) -> None:
    assert error(name) < 0.2
    hidden = error(name, landmark_dropout=1.0)
    assert hidden > 0.5
    assert hidden > 0.5 * error("ekf", landmark_dropout=1.0)
