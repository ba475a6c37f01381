"""Options of tasks: rewards, credit, telemetry, control, observations, walls, teams, states."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from agents.tasks import make_task
from agents.tasks.memory import total_sigma
from agents.tasks.prediction import Predictor
from agents.tasks.rules import Policy
from agents.tasks.runner import TaskStep, rollout

SEEDS = torch.arange(20, 26)


def steps(name: str, policy: str | Policy = "random", **options: Any) -> list[TaskStep]:
    task = make_task(name, **options)
    rule = task.policy(policy) if isinstance(policy, str) else policy
    return list(rollout(task, rule, SEEDS))


def test_rewards_of_sigma_are_the_estimators_and_scores_the_truths() -> None:
    for step in steps("track-v0:horizon=5:reward=sigma"):
        sigma = total_sigma(step.memory.joint)[:, 4:].clamp(max=10.0)
        torch.testing.assert_close(step.reward[:, 0], -sigma.mean(-1) / 10)
    task = make_task("track-v0:horizon=5:reward=sigma").with_options(reward="true")
    for step in rollout(task, task.policies["random"], SEEDS):
        torch.testing.assert_close(step.reward[:, 0], -step.error[:, 4:].mean(-1) / 10)


def test_a_soft_gate_is_how_often_a_gaussian_error_is_within() -> None:
    task = make_task("convoy-v0:reward=sigma:horizon=3")
    step = next(iter(rollout(task, task.policies["idle"], SEEDS)))
    memory = step.memory.clone()
    root = torch.linalg.cholesky(torch.eye(2) * 0.7**2)
    memory.joint = torch.zeros_like(memory.joint)
    memory.joint[:, range(4), range(4)] = root @ root.mT
    drawn = torch.randn(100_000, 2, generator=torch.Generator().manual_seed(0)) @ root.mT
    inside = float((drawn.norm(dim=-1) < 1.0).float().mean())
    found = task.known(memory, step.world, 1.0)
    assert float(found[0, 0]) == pytest.approx(inside, abs=0.01)


@pytest.mark.parametrize("name", ["survey-v0", "convoy-v0", "schedule-v0", "beacon-v0"])
def test_the_teams_reward_is_the_mean_of_the_uavs_own(name: str) -> None:
    own = steps(f"{name}:horizon=25:credit=own")
    team = steps(f"{name}:horizon=25:credit=team")
    for a, b in zip(own, team, strict=True):
        torch.testing.assert_close(a.reward.mean(-1), b.reward[:, 0])
        torch.testing.assert_close(b.reward, b.reward[:, :1].expand_as(b.reward))
    assert any(float(step.reward.std(-1).max()) > 0 for step in own)


def test_the_estimator_may_have_options() -> None:
    plain = steps("survey-v0:horizon=10:estimator=ekf_joint@second_order=true@iterations=1")[-1]
    other = steps("survey-v0:horizon=10:estimator=ekf_joint@cooperate=false")[-1]
    assert torch.equal(plain.error, steps("survey-v0:horizon=10")[-1].error)
    assert not torch.equal(plain.error, other.error)
    with pytest.raises(ValueError, match="ekf_joint: unknown option 'second'"):
        make_task("survey-v0:estimator=ekf_joint@second=true")


def test_what_is_nobodys_own_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match="relay-v0: credit='own' is not allowed") as caught:
        make_task("relay-v0:credit=own")
    assert "\n" not in str(caught.value)


def test_messages_tell_of_those_heard_alone_as_they_were_when_sent() -> None:
    calls = torch.zeros(6, 6, dtype=torch.int64)
    calls[:, 2] = 1  # UAV 2 calls UAV 3, at the third step

    def policy(seen: Any) -> Tensor:
        return calls if int(seen.memory.step[0, 0]) == 2 else torch.zeros_like(calls)

    found = steps("schedule-v0:horizon=6:telemetry=messages", policy)
    task = found[0].seen.task
    for k, step in enumerate(found):
        others, eye = task.others(step.memory), torch.eye(6, dtype=torch.bool)
        known = ~others.age.isinf()
        met = torch.zeros(6, 6, 6, dtype=torch.bool)
        if k >= 2:
            met[:, 2, 3] = met[:, 3, 2] = found[2].memory.seen[:, 2, 3]
        assert torch.equal(known & ~eye, met)
        if k >= 2:
            rows = met[:, 2, 3]
            assert rows.any()
            assert (others.age[rows, 2, 3] == 1 + k - 2).all()
            sent = found[2].seen.memory.position[rows, 3]
            torch.testing.assert_close(others.position[rows, 2, 3], sent)


@pytest.mark.parametrize("name", ["survey-v0", "track-v0", "schedule-v0:telemetry=messages"])
def test_a_dict_holds_the_parts_of_the_flat_observation(name: str) -> None:
    flat, parts = make_task(f"{name}:horizon=4"), make_task(f"{name}:horizon=4:obs=dict")
    for step in rollout(flat, flat.policies["random"], SEEDS):
        _, leaves = flat.observe(step.seen.memory, step.world.observation())
        _, apart = parts.observe(step.seen.memory, step.world.observation())
        apart.pop("action_mask", None)
        assert list(apart) == list(parts.widths) == list(parts.describe())
        torch.testing.assert_close(torch.cat(list(apart.values()), -1), leaves["observation"])


def test_accelerations_are_limited_and_rules_still_get_there() -> None:
    task, velocity, total = make_task("convoy-v0:control=acceleration"), [], 0.0
    for step in rollout(task, task.policies["leapfrog"], SEEDS):
        velocity.append(step.world.truth.velocity.clone())
        total += float(step.reward.mean())
    change = torch.stack(velocity).diff(dim=0)
    assert change.norm(dim=-1).max() < 1.5 + 1e-9
    assert total > 15.0


def test_walls_stop_uavs_and_hide_anchors() -> None:
    task = make_task("survey-hard-v0:horizon=60")
    walls = task.scenario.network.walls
    hidden = 0
    for step in rollout(task, task.policies["random"], SEEDS):
        place = step.world.truth.position
        way = torch.linspace(0, 1, 201, dtype=torch.float64)[:, None, None, None, None]
        line = place.unsqueeze(2) + way * (task.anchors.double() - place.unsqueeze(2))
        blocked = torch.zeros(line.shape[1:-1], dtype=torch.bool)
        for low, high in walls:
            bottom, top = torch.tensor(low).double(), torch.tensor(high).double()
            assert not ((place > bottom) & (place < top)).all(-1).any()
            blocked |= ((line > bottom) & (line < top)).all(-1).any(0)
        near = (place.unsqueeze(2) - task.anchors).norm(dim=-1) <= task.radius
        heard = step.memory.seen[:, :, task.n_agents :]
        assert not (heard & blocked).any()
        hidden += int((near & blocked).sum())
        assert ((near & ~heard) & ~blocked).sum() <= 0.02 * near.sum()  # a corner, between samples
    assert hidden > 0


@pytest.mark.parametrize("n", [3, 12])
@pytest.mark.parametrize("name", ["survey-v0", "relay-v0", "schedule-v0", "beacon-v0"])
def test_teams_of_other_sizes(name: str, n: int) -> None:
    step = steps(f"{name}:horizon=2:n_uavs={n}", "random")[-1]
    assert step.reward.shape == (6, n)
    assert step.seen.observation.isfinite().all()


@pytest.mark.parametrize("name", ["survey-v0", "track-hard-v0", "beacon-v0"])
def test_a_critics_state_is_the_truth_within_bounds(name: str) -> None:
    task = make_task(f"{name}:horizon=20")
    low, high = task.state_bounds(task.scenario)
    assert set(low) == {-1.0}
    assert set(high) == {1.0}
    d = task.dim
    for step in rollout(task, task.policies["random"], SEEDS):
        state = task.state(step.memory, step.world)
        assert state.shape == (6, len(low))
        assert state.abs().max() <= 1.0
        each = state[:, : 4 * d * step.error.shape[1]].view(6, step.error.shape[1], 4 * d)
        place = task.low + (each[..., :d] + 1) / 2 * (task.high - task.low)
        torch.testing.assert_close(place, step.world.now.target, rtol=1e-4, atol=1e-3)


def test_predicted_variances_are_those_that_the_filter_gets() -> None:
    """With no motion there is nothing to be wrong about but noise."""
    task = make_task("survey-v0:horizon=8:drift=0")
    found = list(rollout(task, task.policies["idle"], SEEDS))
    first = found[0].memory
    predictor = Predictor(task)
    now = predictor.start(first.position, first.velocity * 0, first.joint)
    for _ in range(5):
        now = predictor.step(now, torch.zeros(6, 4, 2))
    expected = total_sigma(found[5].memory.joint)
    np.testing.assert_allclose(now.sigma.numpy(), expected.numpy(), rtol=0.05)


@pytest.mark.slow
def test_planning_is_worth_more_than_the_best_rule() -> None:
    returns = {
        rule: float(sum(step.reward.mean() for step in steps("track-v0", rule)))
        for rule in ("cem", "pairs")
    }
    assert returns["cem"] > returns["pairs"] + 2.0
