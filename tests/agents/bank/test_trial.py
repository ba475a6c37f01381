"""Restarts on trial: nothing changes until one has predicted better, and then it does."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from agents import make
from agents.bank import Trial
from agents.bank.kalman_fallback import KalmanFallback
from coloc_env.observation import Observation
from tests.agents.particle.test_hybrid import errors, wsn

ALWAYS = "hpff:quantile=1e-12"  # alarms at every step
MAIN = "pf@particles=200"


def series(localizer: Any, run: Any, name: str) -> Tensor:
    """[K, B, N]"""
    return torch.stack([localizer.diagnostics(belief)[name] for belief in run.beliefs[1:]])


@pytest.mark.parametrize("main", [MAIN, "ekf"])
def test_until_a_restart_is_better_it_is_the_main_filter_with_hubers_weights(
    main: str, tools: SimpleNamespace
) -> None:
    """Also beneath the Kalman filter that particles fall back to."""
    scenario = wsn()
    one: Any = make(f"{ALWAYS}:main={main}", scenario)
    if main == MAIN:
        assert isinstance(one.main, KalmanFallback)
        one.main = one.main.candidate
    alone = make(f"{main}@robust=huber".replace("@", ":"), scenario)
    ours, theirs = (tools.play(localizer, scenario, [0, 1], 40) for localizer in (one, alone))
    assert series(one, ours, "trials_per_run").sum() > 5
    first = series(one, ours, "resets_per_run").cumsum(0) > 0
    assert not first.all()
    for k, (a, b) in enumerate(zip(ours.estimates, theirs.estimates, strict=True)):
        kept = ~first[k]
        torch.testing.assert_close(a.position[kept], b.position[kept], rtol=0, atol=1e-5)


def test_a_restart_that_predicts_better_takes_the_place(tools: SimpleNamespace) -> None:
    """A main filter that is put 3 m off returns once it has been restarted, some steps later."""
    scenario = wsn(n_uavs=1)
    one: Any = make("hpff:main=ekf", scenario)
    assert isinstance(one.main, Trial)
    run = tools.play(one, scenario, [0, 1, 2], 60)
    belief = run.beliefs[30]
    away = torch.tensor([3.0, -2.0], dtype=torch.float64).expand(3, 1, 2)
    main = belief.main.replace(
        fallback=belief.main.fallback.shifted(away), candidate=belief.main.candidate.shifted(away)
    )
    belief, said = belief.replace(main=main), []
    for seen in run.observations[30:45]:
        belief, estimate = one.step(belief, seen)
        said.append(estimate.position)
    apart = (torch.stack(said) - run.position[30:45]).norm(dim=-1)
    assert (apart[-1] < 0.5).all()


def test_a_kidnapped_robot_is_found_again() -> None:
    """A few steps later than without a trial, and not by the main filter alone; and a few steps
    more until what its particles predict has outweighed what they did before."""
    hybrids, alone = (
        errors(name, wsn(n_uavs=1, kidnap_at=3.0))
        for name in ("hpff:main=pf@particles=500", "pf:particles=500:robust=huber")
    )
    assert hybrids[5:30].max() < 0.6
    assert hybrids[45:].max() < 0.6
    assert alone[32:42].min() > 1.5


def gross(observation: Observation, size: float) -> Observation:
    """Ranges to the first anchor too short by ``size`` m."""
    ranges = observation["anchor_ranges"].clone()
    ranges[..., 0] = (ranges[..., 0] - size).clamp_min(0.1)
    return Observation({**observation.leaves, "anchor_ranges": ranges})


def test_gross_ranges_never_move_the_team(tools: SimpleNamespace) -> None:
    """One anchor's ranges are 4 m too short in every fifth step: FIR restarts follow them."""
    scenario = wsn(n_uavs=1)
    seen = tools.play(make("ekf", scenario), scenario, range(4), 100).observations
    dirty = [gross(o, 4.0) if k % 5 == 4 else o for k, o in enumerate(seen)]
    clean = tools.replay(make("ekf:robust=huber", scenario), seen).position
    ours, theirs = (
        (tools.replay(make(name, scenario), dirty).position - clean).norm(dim=-1)[20:]
        for name in ("hpff:main=ekf", "hpff:bank=false:main=ekf")
    )
    assert ours.max() < 0.5
    assert theirs.max() > 1.5


@pytest.mark.parametrize("main", [MAIN, "ekf"])
def test_a_row_of_a_batch_is_its_own_run(main: str, tools: SimpleNamespace) -> None:
    scenario = wsn(uwb_dropout=0.2, case=2)
    localizer = make(f"hpff:quantile=0.8:main={main}", scenario)
    many = tools.play(localizer, scenario, range(5), 25)
    trials = series(localizer, many, "trials_per_run")
    assert 0 < trials.mean() < 1
    for seed in (0, 4):
        alone = tools.play(localizer, scenario, [seed], 25)
        for one, whole in zip(alone.estimates, many.estimates, strict=True):
            tools.assert_same(one, whole[seed : seed + 1])
