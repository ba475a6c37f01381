"""Training of the trust networks: its gradient, its exactness when interrupted, and its card."""

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from agents import make
from agents.policies.adapters import LocalizerPolicy
from agents.robust import Capped
from agents.trust import TrustNetwork, TrustScreen
from agents.trust import screen as trust_screen
from agents.weights import load
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import make_scenario
from tests.sampling import first_fast
from training.learning import run as runs
from training.learning import trust as training
from training.learning.collectors import episode_collector
from training.learning.registry import TRAININGS
from training.learning.through_time import negative_log_likelihood
from training.learning.trust import TrustLoss

SMALL = {
    "scenario": "indoor-v0:n_uavs=3:horizon=10",
    "worlds": 1,
    "epochs": 2,
    "steps": 5,
    "score_runs": 0,
}
VARIANTS = ("", "nlos=0.3")
DEFAULTS = {"labels": "truth", "variants": None}
BATCHES = len(VARIANTS) * 10 // 5  # an epoch's


def quiet(what: str, done: int, total: int) -> None:
    pass


# ---------------------------------------------------------------- the loss


def test_likelihood_of_a_position_is_that_of_torch() -> None:
    """Up to a constant, and as long as a UAV is not lost."""
    g = torch.Generator().manual_seed(0)
    root = torch.randn(50, 3, 3, generator=g, dtype=torch.float64)
    covariance = root @ root.mT + 0.1 * torch.eye(3)
    factor = torch.linalg.cholesky(covariance)
    unit = nn.functional.normalize(torch.randn(50, 3, generator=g, dtype=torch.float64), dim=-1)

    def at(sigmas: float) -> Tensor:
        offset = (factor @ (sigmas * unit).unsqueeze(-1))[..., 0]
        return negative_log_likelihood(offset, covariance)

    for sigmas in (0.0, 1.0, 4.4):
        offset = (factor @ (sigmas * unit).unsqueeze(-1))[..., 0]
        normal = torch.distributions.MultivariateNormal(torch.zeros(3).double(), covariance)
        constant = 1.5 * math.log(2 * math.pi)
        torch.testing.assert_close(at(sigmas), -normal.log_prob(offset) - constant)
    apart = [float((at(s) - at(0.0))[0]) for s in (20**0.5, 100.0, 1e4, 1e6)]
    assert apart[0] == pytest.approx(10)
    assert apart == sorted(apart)
    assert apart[-1] < 300  # 5e11 if it grew as it begins


class Exact(TrustNetwork):
    """Float64 inside, so that differences of losses are more than rounding."""

    def trust_vectors(self, features: Tensor) -> Tensor:
        return super().trust_vectors(features.double())

    def trust_ranges(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return super().trust_ranges(features.double())


@pytest.fixture(scope="module")
def recorded() -> SimpleNamespace:
    """Three steps of two worlds as a training meets them, with weights that discern outliers."""
    torch.set_num_threads(1)
    scenario = make_scenario("indoor-v0", n_uavs=3, horizon=9, nlos=0.5, false_matches=0.3)
    network = Exact()
    load("trust", network)
    network.double()
    ekf: Any = make("ekf_trust:bank=false", scenario, weights="none")
    ekf.learn(network)
    policy = LocalizerPolicy(ekf, scenario, record=partial(training._record, 0))
    batches = list(episode_collector(CoLocEnv(scenario, 2, seed=5), policy, 3, compact_obs=True))
    return SimpleNamespace(scenario=scenario, network=network, ekf=ekf, batch=batches[1].clone())


def test_the_filter_is_run_again(recorded: SimpleNamespace) -> None:
    """The loss is that of the estimates that were made."""
    loss = TrustLoss(recorded.network, [recorded.ekf], [recorded.scenario])
    found = float(loss(recorded.batch)["loss_trust"].detach())
    truth = recorded.batch["state"].unflatten(-1, (3, -1)).double()
    losses, belief = [], training._belief(recorded.batch["train"][:, 0])
    for t in range(3):
        entries = recorded.batch["train"][:, t]
        for name in ("state", "covariance", "memory", "step"):
            torch.testing.assert_close(belief.get(name), entries[name], rtol=0, atol=1e-6)
        seen = recorded.batch["uav", "observation"][:, t]
        observation = training.Observation(dict(seen.items()))
        belief, estimate = recorded.ekf.step(belief, observation)
        offset = estimate.position - truth[:, t, :, :3]
        losses.append(negative_log_likelihood(offset, estimate.covariance))
        action = recorded.batch["uav", "action"][:, t, :, :3].double()
        torch.testing.assert_close(estimate.position.detach(), action, rtol=0, atol=1e-5)
    assert found == pytest.approx(float(torch.stack(losses).mean().detach()), rel=1e-9)


def test_gradient_is_that_of_finite_differences(
    recorded: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through all three steps. What the networks see counts as given: it is detached, so that it
    has to be held where it was while the weights are moved."""
    loss = TrustLoss(recorded.network, [recorded.ekf], [recorded.scenario])
    kept: list[Tensor] = []
    plain = trust_screen.features

    def keep(*given: Any) -> Tensor:
        kept.append(plain(*given).detach())
        return kept[-1]

    monkeypatch.setattr(trust_screen, "features", keep)
    loss.zero_grad()
    loss(recorded.batch)["loss_trust"].backward()
    assert len(kept) == 3 * 2

    def held() -> float:
        again = iter(kept)
        monkeypatch.setattr(trust_screen, "features", lambda *given: next(again))
        return float(loss(recorded.batch)["loss_trust"].detach())

    g = torch.Generator().manual_seed(0)
    moved = 0
    for name, parameter in recorded.network.named_parameters():
        flat, slope = parameter.data.view(-1), parameter.grad.view(-1)
        for i in torch.randint(len(flat), (2,), generator=g).tolist():
            before, values = flat[i].item(), []
            for step in (1e-4, -1e-4):
                flat[i] = before + step
                values.append(held())
            flat[i] = before
            expected = (values[0] - values[1]) / 2e-4
            assert slope[i].item() == pytest.approx(expected, rel=1e-4, abs=1e-8), name
            moved += abs(expected) > 1e-6
    assert moved >= 8


def test_failed_uavs_do_not_count(recorded: SimpleNamespace) -> None:
    """A state's last number says whether it is scored; what is not may be anywhere."""
    loss = TrustLoss(recorded.network, [recorded.ekf], [recorded.scenario])

    def of(scored: float, away: float) -> float:
        batch = recorded.batch.clone()
        state = batch["state"].unflatten(-1, (3, -1)).clone()
        state[:, :, 1, -1] = scored
        state[:, :, 1, :3] += away
        batch["state"] = state.flatten(-2)
        return float(loss(batch)["loss_trust"].detach())

    assert of(0.0, 0.0) == of(0.0, 1e3)
    assert of(1.0, 1e3) > of(1.0, 0.0) + 1
    assert of(0.0, 0.0) != of(1.0, 0.0)


def test_through_the_bank_it_is_the_learned_branch_that_is_run_again() -> None:
    """A batch that the bank made: the loss is that of the candidate's own estimates."""
    scenario = make_scenario("indoor-v0", n_uavs=3, horizon=9, nlos=0.5, false_matches=0.3)
    bank: Any = make("ekf_trust", scenario)
    network = bank.filter.screen.candidate.network
    ekf: Any = make("ekf_trust:bank=false:iterations=2", scenario)
    ekf.learn(network)
    ekf.screen = Capped(ekf.screen)
    beliefs: list[Any] = []

    def watch(before: Any, after: Any, tensordict: Any) -> dict[str, Tensor]:
        beliefs.append(after)
        return training._record(0, before, after, tensordict)

    policy = LocalizerPolicy(bank, scenario, record=watch)
    batch = next(iter(episode_collector(CoLocEnv(scenario, 2, seed=5), policy, 3)))
    loss = TrustLoss(network, [ekf], [scenario])
    truth = batch["state"].unflatten(-1, (3, -1)).double()
    losses = []
    for t, belief in enumerate(beliefs[-3:]):
        assert not belief.restarted.any()
        candidate = belief.candidate
        offset = candidate.state[..., :3] - truth[:, t, :, :3]
        losses.append(negative_log_likelihood(offset, candidate.covariance[..., :3, :3]))
    assert float(loss(batch)["loss_trust"]) == pytest.approx(
        float(torch.stack(losses).mean()), rel=1e-4
    )


# ---------------------------------------------------------------- epochs


def test_an_epoch_has_every_variant_in_worlds_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(training, "VARIANTS", VARIANTS)
    made = TRAININGS["trust"](**SMALL)
    optimizer = made.trainer.optimizer
    priors = set()
    for epoch, share in ((0, 1.0), (1, 0.05)):
        collector = made.collector.make(epoch)
        assert [group["lr"] for group in optimizer.param_groups] == [pytest.approx(1e-3 * share)]
        batches = list(collector)
        collector.shutdown()
        assert [int(b["train", "variant"][0, 0]) for b in batches] == [0, 1, 0, 1]
        assert all(b.shape == (1, 5) for b in batches)
        priors |= {float(b["uav", "observation", "prior"][0, 0, 0, 0]) for b in batches}
    assert len(priors) == 4


# ---------------------------------------------------------------- runs


@pytest.fixture(autouse=True)
def _two_variants(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of them take minutes, and differ by a scenario only."""
    monkeypatch.setattr(training, "VARIANTS", VARIANTS)


def outcome(folder: Path) -> dict[str, bytes]:
    """Weights and metrics of a finished run."""
    files = [folder / "trust.safetensors", *sorted((folder / "metrics/scalars").glob("*.csv"))]
    return {file.name: file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    torch.set_num_threads(1)
    folder = tmp_path_factory.mktemp("unbroken") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "VARIANTS", VARIANTS)
        runs.start("trust", SMALL, folder, quiet)
    return outcome(folder)


@pytest.mark.slow
def test_same_seed_same_weights(unbroken: dict[str, bytes], tmp_path: Path) -> None:
    runs.start("trust", SMALL, tmp_path / "same", quiet)
    assert outcome(tmp_path / "same") == unbroken
    runs.start("trust", {**SMALL, "seed": 1}, tmp_path / "other", quiet)
    assert outcome(tmp_path / "other")["trust.safetensors"] != unbroken["trust.safetensors"]


@pytest.mark.parametrize("losses", first_fast(BATCHES + 1, 1, 2 * BATCHES))
def test_interrupted_in_training(
    unbroken: dict[str, bytes], losses: int, tmp_path: Path, interrupted: Callable[..., Any]
) -> None:
    """In the first epoch, just after its save point, and at the last batch."""
    with interrupted(TrustLoss, "forward", losses):
        runs.start("trust", SMALL, tmp_path / "run", quiet)
    assert (tmp_path / "run/state.safetensors").exists() == (losses > BATCHES)
    assert not (tmp_path / "run/trust.safetensors").exists()
    runs.resume(tmp_path / "run", quiet)
    assert outcome(tmp_path / "run") == unbroken


@pytest.mark.slow
def test_card_and_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SCORED", ("", "nlos=0.3"))
    options = {**SMALL, "epochs": 1, "score_runs": 1}
    weights = runs.start("trust", options, tmp_path / "run", quiet)
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["kind"] == "trust"
    assert card["features"] == list(TrustNetwork(relative=True).features)
    assert card["training"] == "trust"
    assert card["command"].startswith("coloc train trust --set scenario=indoor-v0:n_uavs=3")
    assert card["options"] == {
        "learning_rate": 1e-3,
        "seed": 0,
        "start": "trust",
        **DEFAULTS,
        **options,
    }
    assert card["epochs"] == 1
    assert card["frames"] == 10 * len(VARIANTS)
    assert card["metrics"].keys() >= {"loss_trust", "grad_norm", "optim_steps"}
    assert card["metrics"]["optim_steps"] == BATCHES
    scores = card["scores"]
    assert (scores["runs"], scores["seeds"], scores["steps"]) == (1, [0, 0], 300)
    assert scores["rmse"].keys() == {"default", "nlos=0.3"}
    for found in scores["rmse"].values():
        assert found.keys() == {"ekf_trust_rmse", "ekf_huber_rmse"}
        assert all(0 < value < 0.2 for value in found.values())

    localizer: Any = make("ekf_trust", make_scenario("indoor-v0"), weights=str(weights))
    assert isinstance(localizer.filter.screen.candidate, TrustScreen)
    fresh = TRAININGS["trust"](**options).module.state_dict()
    trained = localizer.filter.screen.candidate.network.state_dict()
    assert any(not torch.equal(trained[name], fresh[name]) for name in fresh)
    assert all(value.isfinite().all() for value in trained.values())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"worlds": 0}, "worlds=0 is not allowed"),
        ({"epochs": 0}, "epochs=0 is not allowed"),
        ({"steps": 0}, "steps=0 is not allowed"),
        ({"score_runs": -1}, "score_runs=-1 is not allowed"),
        ({"learning_rate": 0.0}, "learning_rate=0.0"),
        ({"learning_rate": float("inf")}, "learning_rate"),
        ({"scenario": "indor-v0"}, "did you mean 'indoor-v0'"),
        ({"epoch": 3}, "did you mean 'epochs'"),
    ],
)
def test_one_clear_line(options: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words) as error:
        runs.start("trust", options, tmp_path / "run", quiet)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()
