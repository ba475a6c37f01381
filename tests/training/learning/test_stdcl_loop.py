"""Training of ST-DCL's graph network in its loop: its gradient, exactness, augmentations, card."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from agents import make
from agents.policies.adapters import LocalizerPolicy, restored
from agents.stdcl import loop as loops
from agents.stdcl.network import StGnn
from agents.weights import untrained
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.observation import Observation, all_leaves
from coloc_env.scenarios import make_scenario
from tests.sampling import first_fast
from training.learning import run as runs
from training.learning import stdcl_loop as training
from training.learning.augmentation import (
    EDGE_DROPOUT,
    POSITION_STD,
    VELOCITY_STD,
    SwarmAugmentation,
)
from training.learning.collectors import episode_collector
from training.learning.registry import TRAININGS
from training.learning.stdcl_loop import StDclLoss
from training.learning.through_time import far_off, with_belief

SMALL: dict[str, Any] = {
    "scenario": "swarm-v0:n_uavs=12:anchor_share=0.4:horizon=10:comm_radius=9000",
    "variants": "/nlos=0.3:n_uavs=10",
    "worlds": 1,
    "epochs": 2,
    "steps": 5,
    "score_runs": 0,
}
LOOP = "stdcl:variant=calibrated"
BATCHES = 2 * 10 // 5  # an epoch's


def quiet(what: str, done: int, total: int) -> None:
    pass


# ---------------------------------------------------------------- the loss


@pytest.fixture(scope="module")
def recorded() -> SimpleNamespace:
    """Four steps of two worlds as a training meets them, in the second batch of an episode."""
    torch.set_num_threads(1)
    scenario = make_scenario("swarm-v0", n_uavs=12, anchor_share=0.4, horizon=8, nlos=0.4)
    network = untrained(StGnn, 0).double()
    generator = torch.Generator().manual_seed(0)
    for weight in network.parameters():
        weight.data += 0.03 * torch.randn(weight.shape, generator=generator, dtype=torch.float64)
    loop: Any = make("stdcl:variant=calibrated:weights=none", scenario)
    loop.learn(network)
    policy = LocalizerPolicy(loop, scenario, record=partial(with_belief, 0))
    batches = list(episode_collector(CoLocEnv(scenario, 2, seed=5), policy, 4, compact_obs=True))
    loss = StDclLoss(network, [loop], [scenario], [5.0])
    return SimpleNamespace(
        scenario=scenario, network=network, loop=loop, loss=loss, batch=batches[1].clone()
    )


def total(losses: Any) -> float:
    return float(sum(losses.values()))


def test_the_loop_is_run_again(recorded: SimpleNamespace) -> None:
    """The loss is that of the estimates that were made."""
    found = recorded.loss(recorded.batch)["loss_position"]
    state = recorded.batch["state"].unflatten(-1, (12, -1)).double()
    action = recorded.batch["uav", "action"][..., :3].double()
    free = slice(recorded.scenario.anchor_uavs, None)
    squared = (action - state[..., :3])[:, :, free].square().sum(-1)
    assert float(found.detach()) == pytest.approx(float(far_off(squared, 5.0).mean()), rel=1e-3)


def test_gradient_of_one_step_is_that_of_finite_differences(recorded: SimpleNamespace) -> None:
    """Nothing is fed back to an episode's first step, so that its gradient is exact."""
    batch, loss = recorded.batch[:, :1], recorded.loss
    loss.zero_grad()
    sum(loss(batch).values()).backward()
    g = torch.Generator().manual_seed(1)
    moved = 0
    for name, parameter in recorded.network.named_parameters():
        if parameter.grad is None or "edge" in name:  # links matter from the next step on
            continue
        flat, slope = parameter.data.view(-1), parameter.grad.view(-1)
        for i in torch.randint(len(flat), (2,), generator=g).tolist():
            before, values = flat[i].item(), []
            for step in (1e-5, -1e-5):
                flat[i] = before + step
                values.append(total(loss(batch)))
            flat[i] = before
            expected = (values[0] - values[1]) / 2e-5
            assert slope[i].item() == pytest.approx(expected, rel=1e-3, abs=1e-8), name
            moved += abs(expected) > 1e-7
    assert moved >= 20


def test_what_is_fed_back_is_followed_to_the_next_step(recorded: SimpleNamespace) -> None:
    """Position and confidence of a step move the position found in the next one, nearly as the
    first order says that the training follows."""
    loop, batch = recorded.loop, recorded.batch
    leaves = all_leaves(recorded.scenario)

    def next_place(shift: float, doubt: float, gradients: bool) -> tuple[Any, Any]:
        seen = batch["uav", "observation"][:, 1]
        observation = Observation({name: seen[name] for name in leaves})
        with torch.no_grad():
            belief = restored(
                loop.reset(observation),
                batch["train"].exclude("variant")[:, 1],
                observation.batch_size,
            )
        state = belief.base.state.clone()
        state[..., 0] += shift
        confidence = belief.confidence * (1 - doubt)
        if gradients:
            state.requires_grad_()
            confidence.requires_grad_()
        belief = belief.replace(base=belief.base.replace(state=state), confidence=confidence)
        with torch.set_grad_enabled(gradients):
            inputs = loop.base.predict(belief.base, observation)
            weighted = loops.replace(inputs, confidence=confidence)
            solution = loop.base.solve(belief.base, weighted)
            weights = partial(loop.base.weights_at, inputs=inputs.listed)
            limit = loop._max_offset(inputs, solution)
            graph, _ = loops.graph_inputs(
                inputs, solution, weights, loop.base.std, belief.means, limit
            )
            carrier = loops._gradient_carrier(belief, graph)
        return solution.position.detach() + carrier, state

    free = slice(recorded.scenario.anchor_uavs, None)
    plain, _ = next_place(0.0, 0.0, False)
    there, state = next_place(0.0, 0.0, True)
    assert torch.equal(there.detach(), plain)
    there[:, free, 0].sum().backward()
    slope = state.grad[:, free, 0]
    real = (next_place(0.5, 0.0, False)[0] - next_place(-0.5, 0.0, False)[0])[:, free, 0]
    assert (slope > 0).all()
    assert 0.3 < float(slope.mean() / real.mean()) < 1.5


def test_failed_uavs_do_not_count(recorded: SimpleNamespace) -> None:
    def of(scored: float, away: float) -> float:
        batch = recorded.batch.clone()
        state = batch["state"].unflatten(-1, (12, -1)).clone()
        state[:, :, 7, -1] = scored
        state[:, :, 7, :3] += away
        batch["state"] = state.flatten(-2)
        return float(recorded.loss(batch)["loss_position"].detach())

    assert of(0.0, 0.0) == of(0.0, 1e3)
    assert of(1.0, 1e3) > of(1.0, 0.0) + 1


def test_smoothness_is_of_the_second_stage_and_forgives_manoeuvres(
    recorded: SimpleNamespace,
) -> None:
    assert float(recorded.loss(recorded.batch)["loss_smooth"]) == 0.0
    recorded.loss.smooth = 1.0
    bent = float(recorded.loss(recorded.batch)["loss_smooth"])
    recorded.loss.smooth = 0.0
    assert 0 < bent < 50  # accelerations are up to 16 m/s², (16 m)² a step: 10 in these units


# ---------------------------------------------------------------- augmentations


def test_augmentations_are_what_they_say_and_alike_at_both_ends() -> None:
    scenario = make_scenario("swarm-v0", n_uavs=30, horizon=40, comm_radius=None)
    plain = CoLocEnv(scenario, 2, seed=3)
    changed = TransformedEnv(CoLocEnv(scenario, 2, seed=3), SwarmAugmentation(10.0, 7))
    again = TransformedEnv(CoLocEnv(scenario, 2, seed=3), SwarmAugmentation(10.0, 7))
    action = plain.action_spec.zero()

    def rollout(env: Any) -> TensorDict:
        seen, found = env.reset(), []
        for _ in range(30):
            found.append(seen["uav", "observation"].clone())
            seen = env.step(seen.update(action))["next"]
        return torch.stack(found)

    one, other, same = rollout(plain), rollout(changed), rollout(again)
    assert all(torch.equal(other[k], same[k]) for k in ("ranges", "range_mask", "ins"))
    kept = other["range_mask"][one["range_mask"] > 0].mean()
    assert float(kept) == pytest.approx(1 - EDGE_DROPOUT, abs=0.01)
    assert torch.equal(other["range_mask"], other["range_mask"].mT)
    there = other["range_mask"] > 0
    added = (other["ranges"] - one["ranges"])[there]
    assert 1.5 < float(added.std()) < 8.0
    assert abs(float(added.mean())) < 0.3
    both = there & there.mT
    difference = other["ranges"] - one["ranges"]
    assert torch.allclose(difference[both], difference.mT[both], atol=2e-3)
    assert float((other["ins"] - one["ins"]).std()) == pytest.approx(VELOCITY_STD, rel=0.05)
    fixes = one["position_fix_mask"][..., 0] > 0
    shifted = (other["position_fix"] - one["position_fix"])[fixes]
    assert float(shifted.std()) == pytest.approx(POSITION_STD, rel=0.1)
    assert torch.equal(other["position_fix"][~fixes], one["position_fix"][~fixes])
    assert torch.equal(other["prior"], one["prior"])


# ---------------------------------------------------------------- runs


def outcome(folder: Path) -> dict[str, bytes]:
    """Weights and metrics of a finished run."""
    files = [folder / "stdcl_loop.safetensors", *sorted((folder / "metrics/scalars").glob("*.csv"))]
    return {file.name: file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    runs.start("stdcl_loop", SMALL, folder, quiet)
    return outcome(folder)


@pytest.mark.slow
def test_same_seed_same_weights(unbroken: dict[str, bytes], tmp_path: Path) -> None:
    runs.start("stdcl_loop", SMALL, tmp_path / "same", quiet)
    assert outcome(tmp_path / "same") == unbroken
    runs.start("stdcl_loop", {**SMALL, "seed": 1}, tmp_path / "other", quiet)
    assert (
        outcome(tmp_path / "other")["stdcl_loop.safetensors"] != unbroken["stdcl_loop.safetensors"]
    )


@pytest.mark.parametrize("losses", first_fast(BATCHES + 1, 1, 2 * BATCHES))
def test_interrupted_in_training(
    unbroken: dict[str, bytes], losses: int, tmp_path: Path, interrupted: Callable[..., Any]
) -> None:
    """In the first epoch, just after its save point, and at the last batch."""
    with interrupted(StDclLoss, "forward", losses):
        runs.start("stdcl_loop", SMALL, tmp_path / "run", quiet)
    assert (tmp_path / "run/state.safetensors").exists() == (losses > BATCHES)
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run") == unbroken


def test_the_two_stages_and_the_cosine() -> None:
    made = TRAININGS["stdcl_loop"](**{**SMALL, "epochs": 11, "smooth_from": 0.5})
    loss: Any = made.trainer.loss_module
    for epoch, share, smooth in ((0, 1.0, False), (5, 0.5, False), (6, 0.345, True), (10, 0, True)):
        made.collector.make(epoch).shutdown()
        (rate,) = {group["lr"] for group in made.trainer.optimizer.param_groups}
        assert rate == pytest.approx(1e-5 + (5e-4 - 1e-5) * share, rel=0.01)
        assert (loss.smooth > 0) == smooth


@pytest.mark.parametrize(
    ("agent", "levels"),
    [
        ("stgat", 3),
        *first_fast((f"{LOOP}:feedback=none", 3), (LOOP, 0), ("stdcl:variant=paper", 2)),
    ],
)
def test_card_and_weights(
    agent: str, levels: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "SCORED", ("n_uavs=12:horizon=5",))
    options = {**SMALL, "epochs": 1, "score_runs": 1, "agent": agent, "levels": levels}
    weights = runs.start("stdcl_loop", options, tmp_path / "run", quiet)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["kind"] == "stgnn"
    assert card["features"] == list(StGnn.features)
    assert card["architecture"]["kinematic"] == (agent != "stgat")
    assert card["architecture"]["levels"] == levels
    assert card["metrics"]["optim_steps"] == BATCHES
    (found,) = card["scores"]["rmse"].values()
    assert found.keys() == {"trained_rmse", "optimizer_rmse"}
    name = "stgat" if agent == "stgat" else LOOP
    localizer: Any = make(name, make_scenario("swarm-v0", n_uavs=12), weights=str(weights))
    assert all(weight.isfinite().all() for weight in localizer.network.state_dict().values())
    assert len(localizer.network.times) == levels


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"worlds": 0}, "worlds=0 is not allowed"),
        ({"steps": 0}, "steps=0 is not allowed"),
        ({"learning_rate": 0.0}, "learning_rate=0.0"),
        ({"smooth_from": 2.0}, "smooth_from=2.0"),
        ({"agent": "dwmds_st"}, "variant=paper or stgat"),
        ({"scenario": "swam-v0"}, "did you mean 'swarm-v0'"),
        ({"start": "stdlc"}, "unknown checkpoint"),
    ],
)
def test_one_clear_line(options: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words) as error:
        runs.start("stdcl_loop", {**SMALL, **options}, tmp_path / "run", quiet)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()
