"""Training of the failure detector: its samples, its loss, its worlds, and exact continuation."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agents import make
from agents.particle.failure import FailureDetector
from agents.policies.adapters import LocalizerPolicy
from agents.weights import untrained
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario, parse_scenario
from tests.sampling import first_fast
from training.evaluation.record import record
from training.learning import nnhpff as training
from training.learning import run as runs
from training.learning.collectors import episode_collector, world_seed
from training.learning.nnhpff import FAILED, MAINS, VARIANTS, DetectorLoss, Samples, samples_of
from training.learning.registry import TRAININGS

# Beliefs that a filter with few particles sometimes survives.
SMALL: dict[str, Any] = {
    "scenario": "wsn-v0:horizon=40",
    "variants": "case=1/q=0.0036:believed_uwb_std=0.04",
    "mains": "pf:particles=60",
    "worlds": 1,
    "epochs": 2,
    "passes": 2,
    "minibatch": 30,
    "score_runs": 0,
}
LOSSES = 1 + 2 * 3  # an epoch's: before it is trained on, and three minibatches a pass


def quiet(what: str, done: int, total: int) -> None:
    pass


def rows(count: int) -> TensorDict:
    g = torch.Generator().manual_seed(3)
    entries = {
        "features": torch.randn(count, 5, generator=g, dtype=torch.float64),
        "failed": torch.rand(count, generator=g) < 0.3,
    }
    return TensorDict(entries, [count])


# ---------------------------------------------------------------- the loss


def test_loss_is_the_cross_entropy() -> None:
    """− log of the softmax of what is so."""
    detector, data = untrained(FailureDetector, 0).double(), rows(40)
    found = float(DetectorLoss(detector)(data)["loss_detector"].detach())
    logits = detector(data["features"]).detach()
    expected = torch.nn.functional.cross_entropy(logits, data["failed"].long())
    assert found == pytest.approx(float(expected))
    sound, failed = np.exp(logits.numpy()).T
    probability = np.where(data["failed"].numpy(), failed, sound) / (sound + failed)
    assert found == pytest.approx(-np.log(probability).mean())


def test_gradient_is_that_of_finite_differences() -> None:
    loss, data = DetectorLoss(untrained(FailureDetector, 0).double()), rows(40)
    loss(data)["loss_detector"].backward()
    for parameter in loss.parameters():
        flat = parameter.data.view(-1)
        for i in range(len(flat)):
            before, values = flat[i].item(), []
            for step in (1e-6, -1e-6):
                flat[i] = before + step
                values.append(float(loss(data)["loss_detector"].detach()))
            flat[i] = before
            slope = (values[0] - values[1]) / 2e-6
            assert slope == pytest.approx(parameter.grad.view(-1)[i].item(), rel=1e-5, abs=1e-9)


# ---------------------------------------------------------------- samples


def recorded(scenario: Scenario, main: str, worlds: int = 3, steps: int = 40) -> Any:
    """An episode of a filter as trainings record it."""
    localizer = make(main, scenario)
    policy = LocalizerPolicy(localizer, scenario, record=Samples(scenario))
    (batch,) = episode_collector(
        CoLocEnv(scenario, worlds, seed=5), policy, steps, compact_obs=True
    )
    return batch


@pytest.fixture(scope="module")
def episode() -> SimpleNamespace:
    """Of two robots, one of which fails at step 30, and which lose ranges: four at once, too."""
    torch.set_num_threads(1)
    overrides: dict[str, Any] = {"case": 3, "n_uavs": 2, "horizon": 40, "uwb_dropout": 0.4}
    scenario = replace(make_scenario("wsn-v0", **overrides), failures=((1, 30),))
    return SimpleNamespace(scenario=scenario, batch=recorded(scenario, "pf:particles=100"))


def test_features_are_those_of_the_estimate_and_the_label_is_the_truths(
    episode: SimpleNamespace,
) -> None:
    batch, train = episode.batch, episode.batch["train"]
    seen = {name: leaf.double().numpy() for name, leaf in batch["uav", "observation"].items()}
    position = batch["uav", "action"][..., :2].double().numpy()
    state = batch["state"].unflatten(-1, (2, -1)).double().numpy()
    error = np.linalg.norm(position - state[..., :2], axis=-1)
    np.testing.assert_allclose(train["error"].numpy(), error, atol=1e-5)
    assert FAILED == 0.5
    np.testing.assert_array_equal(train["failed"].numpy(), train["error"].numpy() > 0.5)
    assert 0.02 < train["failed"].double().mean() < 0.98
    places = seen["anchor_map"].reshape(3, 40, 2, 4, 2)
    distance = np.linalg.norm(position[..., None, :] - places, axis=-1)
    mask = seen["anchor_range_mask"]
    r = np.abs(seen["anchor_ranges"] - distance) * mask
    d = (r**2).sum(-1) / 0.36 * 4 / np.maximum(mask.sum(-1), 1)
    np.testing.assert_allclose(train["features"][..., 0].numpy(), np.log1p(d), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(train["features"][..., 1:].numpy(), r, atol=1e-5)


def test_only_what_is_measured_and_scored_becomes_a_sample(episode: SimpleNamespace) -> None:
    train = episode.batch["train"]
    measured = episode.batch["uav", "observation", "anchor_range_mask"].sum(-1) > 0
    alive = torch.ones(3, 40, 2, dtype=torch.bool)
    alive[:, 30:, 1] = False
    assert torch.equal(train["scored"], measured & alive)
    assert not measured[alive].all()
    found = samples_of(episode.batch)
    assert found.shape == (int((measured & alive).sum()),)
    for name in ("features", "failed", "error"):
        assert torch.equal(found[name], train[name][measured & alive])


def test_samples_are_what_the_detector_sees_online(episode: SimpleNamespace) -> None:
    """The same worlds by a hybrid filter that never resets."""
    one = make("nnhpff:bank=false:weights=none:threshold=1:main=pf@particles=100", episode.scenario)
    seen: list[Tensor] = []

    def watch(before: Any, after: Any, tensordict: Any) -> dict[str, Tensor]:
        seen.append(after.distance)
        return {}

    policy = LocalizerPolicy(one, episode.scenario, record=watch)
    (batch,) = episode_collector(
        CoLocEnv(episode.scenario, 3, seed=5), policy, 40, compact_obs=True
    )
    assert torch.equal(batch["uav", "action"], episode.batch["uav", "action"])
    count = episode.batch["uav", "observation", "anchor_range_mask"].sum(-1)
    d = torch.stack(seen[-40:], 1) * 4 / count.clamp_min(1)
    torch.testing.assert_close(episode.batch["train", "features"][..., 0], d.log1p())


# ---------------------------------------------------------------- worlds


def test_an_epoch_flies_every_filter_in_every_variant_in_worlds_of_its_own() -> None:
    """Row by row: variants, in each the filters, of each the worlds."""
    mains = ["pf:particles=60", "ekf"]
    made = TRAININGS["nnhpff"](**SMALL | {"worlds": 2, "mains": "/".join(mains)})
    scenarios = [parse_scenario(f"wsn-v0:horizon=40:{one}") for one in SMALL["variants"].split("/")]
    for epoch in (0, 3):
        episode = made.collector.make(epoch)
        (batch,) = list(episode)
        episode.shutdown()
        assert batch.shape == (8, 40)
        seeds = world_seed(0, epoch, 8) + torch.arange(8).view(-1, 2)
        pairs = [(one, main) for one in scenarios for main in mains]
        for i, (one, main) in enumerate(pairs):
            recorded = record(make(main, one), one, seeds[i])
            found = batch["train", "error"][2 * i : 2 * i + 2]
            torch.testing.assert_close(found, torch.from_numpy(recorded.error), rtol=0, atol=1e-5)
    g = batch["train", "features"][..., 0, :].double()
    believed = g[..., 1:].square().sum(-1) / g[..., 0].expm1()
    expected = torch.tensor([0.04] * 4 + [0.0016] * 4).double().unsqueeze(-1)
    torch.testing.assert_close(believed, expected.expand_as(believed), rtol=1e-3, atol=0)


def test_the_defaults_are_the_papers_27_scenarios() -> None:
    variants, mains = VARIANTS.split("/"), MAINS.split("/")
    assert len(set(variants)) == 9
    assert mains == ["pf:particles=500", "pf:particles=2000", "pf:particles=5000"]
    believed = set()
    for variant in variants:
        scenario = parse_scenario(f"wsn-v0:{variant}")
        process: Any = scenario.believed.process
        sensor: Any = scenario.believed.sensors[0]
        believed.add((round(process.accel_std**2, 6), round(sensor.noise.std**2, 6)))
    for case in (1, 2, 3):
        scenario = make_scenario("wsn-v0", case=case)
        process, sensor = scenario.believed.process, scenario.believed.sensors[0]
        assert (round(process.accel_std**2, 6), round(sensor.noise.std**2, 6)) in believed
    assert len(believed) == 9


# ---------------------------------------------------------------- runs


def outcome(folder: Path) -> dict[str, bytes]:
    """Weights and metrics of a finished run."""
    files = [folder / "nnhpff.safetensors", *sorted((folder / "metrics/scalars").glob("*.csv"))]
    return {file.name: file.read_bytes() for file in files}


def column(folder: Path, name: str) -> list[float]:
    with (folder / f"metrics/scalars/{name}.csv").open() as file:
        return [float(value) for _, value in csv.reader(file)]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    runs.start("nnhpff", SMALL, folder, quiet)
    assert not (folder / "state.safetensors").exists()
    return folder


@pytest.mark.slow
def test_same_seed_same_weights(unbroken: Path, tmp_path: Path) -> None:
    runs.start("nnhpff", SMALL, tmp_path / "same", quiet)
    assert outcome(tmp_path / "same") == outcome(unbroken)
    runs.start("nnhpff", SMALL | {"seed": 1}, tmp_path / "other", quiet)
    weights = "nnhpff.safetensors"
    assert outcome(tmp_path / "other")[weights] != outcome(unbroken)[weights]


@pytest.mark.parametrize("losses", first_fast(LOSSES + 2, 2, 2 * LOSSES))
def test_interrupted_in_training(
    unbroken: Path, losses: int, tmp_path: Path, interrupted: Callable[..., Any]
) -> None:
    """At the first step, at the first after a save point, and at the last."""
    with interrupted(DetectorLoss, "forward", losses):
        runs.start("nnhpff", SMALL, tmp_path / "run", quiet)
    assert (tmp_path / "run/state.safetensors").exists() == (losses > LOSSES)
    assert not (tmp_path / "run/nnhpff.safetensors").exists()
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run") == outcome(unbroken)


def test_figures_of_an_epoch_are_said_of_worlds_not_yet_trained_on(unbroken: Path) -> None:
    made = TRAININGS["nnhpff"](**SMALL)
    episode = made.collector.make(0)
    (batch,) = list(episode)
    episode.shutdown()
    data = samples_of(batch)
    logits = made.module(data["features"]).detach()
    failed = data["failed"]
    share = float(failed.double().mean())
    assert 0.05 < share < 0.95
    expected = {
        "held_out_loss": float(torch.nn.functional.cross_entropy(logits, failed.long())),
        "constant_loss": -share * np.log(share) - (1 - share) * np.log(1 - share),
        "failed_share": share,
        "accuracy": float((logits.argmax(-1) == failed).double().mean()),
    }
    for name, value in expected.items():
        assert column(unbroken, name)[0] == pytest.approx(value, rel=1e-5)
        assert len(column(unbroken, name)) == 2


def test_it_learns(tmp_path: Path) -> None:
    """To find failures in worlds that it has not met, better than their share does."""
    options = SMALL | {"epochs": 5, "passes": 10, "worlds": 4}
    runs.start("nnhpff", options, tmp_path / "run", quiet)
    held_out, constant = (
        column(tmp_path / "run", name)[-1] for name in ("held_out_loss", "constant_loss")
    )
    assert held_out < 0.7 * constant
    assert column(tmp_path / "run", "accuracy")[-1] > 0.85


def test_card_and_weights(unbroken: Path) -> None:
    weights = unbroken / "nnhpff.safetensors"
    card = json.loads(weights.with_suffix(".json").read_text())
    assert (card["kind"], card["training"]) == ("nnhpff", "nnhpff")
    assert card["features"] == list(FailureDetector.features)
    assert card["command"].startswith("coloc train nnhpff --set scenario=wsn-v0:horizon=40")
    assert card["options"] == {"learning_rate": 0.01, "seed": 0, **SMALL}
    assert (card["epochs"], card["frames"]) == (2, 2 * 2 * 40)
    assert card["metrics"].keys() >= {"loss_detector", "held_out_loss", "accuracy", "failed_share"}
    localizer: Any = make("nnhpff", make_scenario("wsn-v0"), weights=str(weights))
    fresh = TRAININGS["nnhpff"](**SMALL).module.state_dict()
    trained = localizer.detector.network.state_dict()
    assert any(not torch.equal(trained[name].float(), fresh[name]) for name in fresh)
    assert all(value.isfinite().all() for value in trained.values())


def test_scores_are_those_of_the_three_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        training, "parse_scenario", lambda text, more: parse_scenario(text, f"{more}:horizon=4")
    )
    reported: list[int] = []
    detector = untrained(FailureDetector, 0)
    with torch.no_grad():
        detector.out.bias += torch.tensor([-9.0, 9.0])  # always failed
    found = training.score(detector, "wsn-v0", 2, lambda what, done, total: reported.append(done))
    assert reported == [1, 2, 3]
    assert (found["runs"], found["seeds"]) == (2, [0, 1])
    for case in (1, 2, 3):
        names = {"pf_mean", "hpff_mean", "hpff_resets", "nnhpff_mean", "nnhpff_resets"}
        assert found[f"case {case}"].keys() == names
        assert found[f"case {case}"]["nnhpff_resets"] == 4
    assert found["case 2"]["hpff_resets"] > 1
    assert training.score(detector, "wsn-v0", 0, quiet) == {}
    assert training.score(detector, "indoor-v0:anchors=4", 2, quiet) == {}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"worlds": 0}, "worlds=0 is not allowed"),
        ({"epochs": 0}, "epochs=0 is not allowed"),
        ({"passes": 0}, "passes=0 is not allowed"),
        ({"minibatch": 0}, "minibatch=0 is not allowed"),
        ({"score_runs": -1}, "score_runs=-1 is not allowed"),
        ({"learning_rate": 0.0}, "learning_rate=0.0 is not allowed"),
        ({"seed": -1}, "seed=-1 is not allowed"),
        ({"scenario": "wsn"}, "unknown scenario 'wsn'"),
        ({"variants": "case=1/cas=2"}, "unknown option 'cas'.*did you mean 'case'"),
        ({"mains": "pf:particles=60/pff"}, "unknown agent 'pff'"),
        ({"mains": "pf:particle=60"}, "unknown option 'particle'"),
        ({"epoch": 3}, "did you mean 'epochs'"),
        ({"scenario": "indoor-v0", "variants": ""}, "indoor-v0 has no anchors"),
        ({"variants": "horizon=10/horizon=20"}, "variants='horizon=10/horizon=20' must have one"),
        ({"variants": "n_uavs=1/n_uavs=2"}, "variants='n_uavs=1/n_uavs=2' must have one"),
        ({"variants": "anchors=4/anchors=6"}, "variants='anchors=4/anchors=6' must have"),
    ],
)
def test_one_clear_line(options: dict[str, Any], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words) as error:
        runs.start("nnhpff", SMALL | options, tmp_path / "run", quiet)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


def test_ranges_with_lever_arms_are_no_samples() -> None:
    scenario = make_scenario("wsn-v0")
    sensor = replace(scenario.believed_sensors[0], tags=(((0.1, 0.0),),))  # type: ignore[call-arg]
    armed = replace(scenario, believed_sensors=(sensor,))
    with pytest.raises(ValueError, match="wsn-v0 has no anchors, or lever arms to them"):
        Samples(armed)
