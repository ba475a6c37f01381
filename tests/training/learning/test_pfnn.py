"""Training of the paper's corrector: its loss, its samples, and that it learns."""

import csv
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from agents import make
from agents.particle.corrector import WeightCorrector
from agents.policies.adapters import LocalizerPolicy
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import make_scenario
from training.evaluation.record import record
from training.learning import pfnn_online
from training.learning import run as runs
from training.learning.collectors import episode_collector, world_seed
from training.learning.pfnn import CorrectorLoss, InTurn, Samples, samples_of
from training.learning.pfnn_online import OnlineLearning, PerWorld, learn_online

SCENARIO = "indoor-v0:n_uavs=2:horizon=20"


def quiet(what: str, done: int, total: int) -> None:
    pass


def rows(*shape: int) -> TensorDict:
    torch.manual_seed(3)
    entries = {
        "features": torch.randn(*shape, 6, dtype=torch.float64),
        "target": torch.rand(*shape, dtype=torch.float64),
        "mask": torch.rand(shape) < 0.8,
    }
    return TensorDict(entries, shape)


def test_gradient_is_that_of_finite_differences() -> None:
    loss, data = CorrectorLoss(WeightCorrector().double()), rows(30)
    loss(data)["loss_corrector"].backward()
    for parameter in loss.parameters():
        flat = parameter.data.view(-1)
        for i in range(len(flat)):
            values = []
            for step in (1e-6, -1e-6):
                before = flat[i].item()
                flat[i] = before + step
                values.append(float(loss(data)["loss_corrector"].detach()))
                flat[i] = before
            slope = (values[0] - values[1]) / 2e-6
            assert slope == pytest.approx(parameter.grad.view(-1)[i].item(), rel=1e-6, abs=1e-9)


def test_loss_is_equation_16() -> None:
    corrector, data = WeightCorrector().double(), rows(30)
    y, t, mask = corrector(data["features"]), data["target"], data["mask"]
    expected = ((y - t)[mask] ** 2).mean()
    torch.testing.assert_close(CorrectorLoss(corrector)(data)["loss_corrector"], expected)


def test_networks_of_their_own_learn_apart() -> None:
    """One network for each world: every one gets the gradient that it would get alone."""
    networks = [WeightCorrector().double() for _ in range(3)]
    together, data = CorrectorLoss(PerWorld(list(networks))), rows(3, 30)
    together(data)["loss_corrector"].backward()
    found = dict(zip(together.corrector.names, together.corrector.weights, strict=True))
    for b, network in enumerate(networks):
        alone = CorrectorLoss(network)
        torch.testing.assert_close(together.error(data)[b], alone.error(data[b]))
        alone(data[b])["loss_corrector"].backward()
        for name, parameter in network.named_parameters():
            torch.testing.assert_close(found[name].grad[b], parameter.grad)


def test_samples() -> None:
    """Live particles, without repetition, of what they are said to be."""
    scenario = make_scenario("indoor-v0", n_uavs=2, horizon=20)
    localizer = make("pfnn", scenario, weights="none")
    seen = []

    class Watched(Samples):
        def __call__(self, before, after, tensordict):  # type: ignore[no-untyped-def]
            seen.append((before, after))
            return super().__call__(before, after, tensordict)

    policy = LocalizerPolicy(localizer, scenario, record=Watched(scenario))
    (batch,) = episode_collector(CoLocEnv(scenario, 3, seed=5), policy, 20, compact_obs=True)
    steps = seen[-20:]
    train = batch["train"]
    assert train["features"].shape == (3, 20, 2, 50, 6)
    assert train["mask"].all()
    truth = batch["state"].unflatten(-1, (2, -1))[..., :3]
    error = (batch["uav", "action"][..., :3] - truth).norm(dim=-1)
    torch.testing.assert_close(train["error"], error)
    for k, (before, after) in enumerate(steps):
        for b in range(3):
            for i in range(2):
                live = after.particles[b, i, : after.count[b, i], :6]
                chosen = train["features"][b, k, i] + before.last[b, i]
                apart = torch.cdist(chosen.double(), live.double())
                assert (apart.min(-1).values < 1e-4).all()
                distance = (chosen[:, :3] - truth[b, k, i]).norm(dim=-1)
                torch.testing.assert_close(
                    train["target"][b, k, i], torch.exp(-distance), atol=1e-5, rtol=0
                )
    every = samples_of(batch)
    assert every.shape == (3, 2, 100)
    torch.testing.assert_close(every["target"][1, 1, 50:], train["target"][1, 19, 1])
    in_turn = InTurn(2)
    assert all(torch.equal(in_turn(batch)["target"], every["target"][:, i % 2]) for i in range(4))


def column(folder: Path, name: str) -> list[float]:
    with (folder / f"metrics/scalars/{name}.csv").open() as file:
        return [float(value) for _, value in csv.reader(file)]


@pytest.mark.slow
def test_offline_learns(tmp_path: Path) -> None:
    options = {"scenario": SCENARIO, "worlds": 2, "epochs": 5, "minibatch": 32, "score_runs": 0}
    runs.start("pfnn", options, tmp_path / "run", quiet)
    held_out = column(tmp_path / "run", "held_out_loss")
    assert len(held_out) == 5
    assert held_out[-1] < 0.1 * held_out[0]
    steps = [line.split(",")[0] for line in (tmp_path / "run/metrics/scalars/rmse.csv").open()]
    assert steps == [str(40 * (epoch + 1)) for epoch in range(5)]


def test_online_learns(tmp_path: Path) -> None:
    options = {"mode": "online", "scenario": SCENARIO, "worlds": 1, "epochs": 6, "score_runs": 0}
    options["learning_rate"] = 0.1
    runs.start("pfnn", options, tmp_path / "run", quiet)
    loss = column(tmp_path / "run", "loss_corrector")
    assert len(loss) == 6 * 2
    assert sum(loss[-4:]) < 0.6 * sum(loss[:4])


def test_the_filter_flies_with_the_newest_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learning online changes what is estimated, after the first training and not before."""
    scenario = make_scenario("indoor-v0", n_uavs=2, horizon=30)

    def learn() -> OnlineLearning:
        return learn_online(scenario, 2, 0, quiet, correction=(0.05, 1.0))

    found, again = learn(), learn()
    monkeypatch.setattr(pfnn_online, "LEARNING_RATE", 0.0)
    untrained = learn()
    assert found.error.shape == found.count.shape == (2, 30, 2)
    assert found.loss.shape == (2, 3)
    assert torch.equal(again.error, found.error)
    assert torch.equal(again.loss, found.loss)
    assert torch.equal(untrained.error[:, :10], found.error[:, :10])
    assert not torch.allclose(untrained.error[:, 10:], found.error[:, 10:], atol=1e-4)


def test_learning_online_meets_the_worlds_of_evaluation() -> None:
    scenario = make_scenario("indoor-v0", n_uavs=2, horizon=10)
    found = learn_online(scenario, 2, 4, quiet, correction=(1.0, 1.0))
    alone = record(make("apf", scenario), scenario, torch.tensor([4, 5]))
    torch.testing.assert_close(found.error, torch.from_numpy(alone.error), atol=1e-5, rtol=0)


def test_worlds_of_different_epochs_and_seeds_differ() -> None:
    steps = [
        world_seed(seed, epoch, 8) + row
        for seed in range(3)
        for epoch in range(4)
        for row in range(8)
    ]
    assert len(set(steps)) == len(steps)
    assert min(steps) > 10**9


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"worlds": 0}, "worlds=0 is not allowed: a whole number"),
        ({"learning_rate": 0.0}, "learning_rate=0.0"),
        ({"seed": -1}, "seed=-1"),
        ({"mode": "supervised"}, "one of offline, online"),
        ({"scenario": "indor-v0"}, "did you mean 'indoor-v0'"),
        ({"scenario": "indoor-v0:nloss=1"}, "did you mean 'nlos'"),
        ({"scenario": "indoor-v0:horizon=5"}, "too short"),
        ({"epoch": 3}, "did you mean 'epochs'"),
    ],
)
def test_one_clear_line(options: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words) as error:
        runs.start("pfnn", options, tmp_path / "run", quiet)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()
