"""What becomes of a claim is decided by the rule alone."""

from dataclasses import replace

import numpy as np
import pytest

from training.evaluation.metrics import Difference
from training.reproduce.verdicts import (
    CONTRADICTED,
    MET,
    MISSED,
    NOT,
    REPRODUCED,
    UNKNOWN,
    Claim,
    Goal,
    counts,
    decide,
    gain,
    interval,
    judge,
    judge_goals,
    least,
    share,
)

BETTER = Claim("A is better than B", "by 9 %", "%", "above", 0.0, 9.0)
FAST = Claim("a step takes less than 100 ms", "63 ms", "ms", "below", 100.0)
VALUE = Claim("the RMSE", "0.437 m", "m", None, 0.437)


@pytest.mark.parametrize(
    ("claim", "low", "high", "verdict", "reason"),
    [
        (BETTER, 5.0, 12.0, REPRODUCED, "claimed side"),
        (BETTER, 20.0, 30.0, REPRODUCED, "claimed side"),  # even better than claimed
        (BETTER, 2.0, 6.0, NOT, "smaller"),
        (BETTER, -1.0, 12.0, NOT, "no detectable effect"),
        (BETTER, 0.0, 0.0, NOT, "no detectable effect"),
        (BETTER, -12.0, -5.0, CONTRADICTED, "opposite"),
        (BETTER, -np.inf, np.inf, NOT, "no detectable effect"),  # a single run
        (FAST, 40.0, 60.0, REPRODUCED, "claimed side"),
        (FAST, 90.0, 110.0, NOT, "undecided"),
        (FAST, 101.0, 110.0, CONTRADICTED, "opposite"),
        (VALUE, 0.4, 0.5, REPRODUCED, "within"),
        (VALUE, 0.03, 0.04, NOT, "lower"),
        (VALUE, 0.5, 0.6, NOT, "higher"),
    ],
)
def test_rule(claim: Claim, low: float, high: float, verdict: str, reason: str) -> None:
    found = decide(claim, Difference(0.5 * (low + high) if np.isfinite(low) else 1.0, low, high))
    assert found.verdict == verdict
    assert reason in found.reason


def test_sizes_below_a_limit() -> None:
    fewer = Claim("fewer than 800", "720", "", "below", 800.0, 720.0)
    assert decide(fewer, Difference(700, 690, 710)).verdict == REPRODUCED
    assert decide(fewer, Difference(710, 700, 730)).verdict == REPRODUCED
    assert decide(fewer, Difference(780, 770, 790)).verdict == NOT
    assert decide(fewer, Difference(800, 800, 800)).verdict == NOT


def test_what_was_not_measured_says_why() -> None:
    found = decide(BETTER, "dfgo was not run")
    assert (found.verdict, found.ours, found.reason) == (UNKNOWN, None, "dfgo was not run")
    nothing = interval(np.array([np.nan]))
    assert decide(BETTER, nothing).verdict == UNKNOWN


def test_gain_is_paired() -> None:
    rng = np.random.default_rng(0)
    worlds = rng.uniform(0.1, 1.0, 20)  # worlds differ tenfold, the gain in them is always 10 %
    found = gain(0.9 * worlds, worlds)
    assert found.mean == pytest.approx(10.0)
    assert 5.0 < found.low < 10.0 < found.high < 15.0
    assert gain(worlds, 0.9 * worlds).high < 0


def test_least_is_the_closest_rival_with_a_wider_interval() -> None:
    rng = np.random.default_rng(1)
    ours = rng.uniform(0.9, 1.1, 20)
    close, far = ours + rng.normal(0.01, 0.02, 20), ours + 1.0
    found, alone = least([(ours, far), (ours, close)]), gain(ours, close)
    assert found.mean == pytest.approx(alone.mean)
    assert found.low < alone.low < alone.high < found.high


def test_share_is_exact() -> None:
    found = share(np.zeros(4, bool))
    assert (found.mean, found.low) == (0.0, 0.0)
    assert found.high == pytest.approx(100 * (1 - 0.025**0.25))
    assert share(np.ones(30, bool)).low > 85


class Nothing:
    def get(self, name: str, agent: str = "", kind: object = None) -> object:
        return {"a": 1.0, "b": 2.0}.get(agent)


def goal(limit: float, above: bool, by: str, agent: str = "a") -> Goal:
    """A figure of 1.0 with an interval from 0.5 to 1.5."""
    needs = (("somewhere", agent),)
    return Goal("g", "m", limit, above, needs, lambda x: Difference(x, x - 0.5, x + 0.5), by)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("limit", "above", "by", "verdict"),
    [
        (1.2, False, "mean", MET),
        (0.9, False, "mean", MISSED),
        (1.0, False, "mean", MET),
        (0.9, True, "mean", MET),
        (1.2, False, "interval", MISSED),
        (1.6, False, "interval", MET),
        (0.4, True, "interval", MET),
        (0.6, False, "not worse", MET),
        (0.4, False, "not worse", MISSED),
        (0.9, True, "mean and sign", MET),
    ],
)
def test_goals(limit: float, above: bool, by: str, verdict: str) -> None:
    (found,) = judge_goals([goal(limit, above, by)], Nothing())
    assert found.verdict == verdict


def test_goals_and_claims_that_lack_something_say_what() -> None:
    (found,) = judge_goals([goal(1.0, True, "mean", "c")], Nothing())
    assert (found.verdict, found.reason) == (UNKNOWN, "not run: c in somewhere")
    claim = replace(BETTER, needs=(("here", "a"), ("here", "c"), ("there", "d")))
    (found,) = judge([claim], Nothing())
    assert found.reason == "not run: c, d in here and others"
    assert "Not measured: not run: c, d in here and others." in counts([found], "claims", [UNKNOWN])
