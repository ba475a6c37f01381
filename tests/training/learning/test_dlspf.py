"""Training of the latent-space filter: its windows, the discrepancy, and that it learns."""

import csv
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from agents import make
from agents.particle.latent import WINDOW, LatentModel
from agents.policies.adapters import LocalizerPolicy
from agents.weights import card_of
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import make_scenario
from training.learning import run as runs
from training.learning.collectors import episode_collector
from training.learning.dlspf import AHEAD, LatentLoss, discrepancy, dlspf, samples

SMALL = {
    "scenario": "indoor-v0:n_uavs=2:horizon=24:motion=random",
    "worlds": 2,
    "epochs": 2,
    "passes": 3,
    "minibatch": 24,
    "score_runs": 1,
}


def quiet(what: str, done: int, total: int) -> None:
    pass


def test_windows_are_errors_of_integrated_references() -> None:
    """They start as far off as they are scaled to, and velocity's error moves position's."""
    scenario = make_scenario("indoor-v0", n_uavs=2, horizon=24, motion="random")
    process = make("dlspf", scenario).process  # type: ignore[attr-defined]
    policy = LocalizerPolicy(make("dead_reckoning", scenario), scenario)
    collector = episode_collector(CoLocEnv(scenario, 3, seed=1), policy, 24, compact_obs=True)
    (batch,) = collector
    rows = samples(batch, process, scenario, 8, 0)
    errors = rows["errors"].double()
    assert errors.shape[1:] == (WINDOW + AHEAD, 6)
    places, paces = errors.split(3, -1)
    start = (places[:, 0].square().mean().sqrt(), places[:, 0].mean().abs())
    assert start[0] == pytest.approx(1.0, rel=0.2)
    assert start[1] < 0.2
    moved, carried = places.diff(dim=1), (paces[:, 1:] + paces[:, :-1]) / (2 * WINDOW)
    assert (moved - carried).square().mean().sqrt() < 0.05 * moved.square().mean().sqrt()
    again = samples(batch, process, scenario, 8, 0)
    assert torch.equal(again["errors"], rows["errors"])


def test_discrepancy() -> None:
    """Of one distribution it is 0 on average; of two, it grows with what separates them."""
    g = torch.Generator().manual_seed(0)
    draws = torch.randn(40, 200, 4, generator=g)
    same = torch.stack([discrepancy(a, b) for a, b in zip(draws[::2], draws[1::2], strict=True)])
    assert same.mean().abs() < 3 * same.std() / len(same) ** 0.5
    apart = [float(discrepancy(draws[0] + shift, draws[1])) for shift in (0.3, 1.0, 3.0)]
    assert same.max() < apart[0] < apart[1] < apart[2]


def test_perfect_windows_cost_nothing_but_the_discrepancy() -> None:
    """Errors that never change, and a model that carries them."""
    model, eye = LatentModel(), torch.eye(6)
    with torch.no_grad():
        for one in (model.encoder, model.decoder, model.transition):
            one.straight.weight.zero_()
            one.straight.weight[:6, :6] = eye
        model.decoder.straight.weight[:, :6] = eye.repeat(WINDOW, 1)
    loss = LatentLoss(model, 0.5)
    g = torch.Generator().manual_seed(0)
    entries = {
        "errors": torch.randn(30, 1, 6, generator=g).expand(-1, WINDOW + AHEAD, -1),
        "scale": torch.ones(30, 6),
        "normal": torch.randn(30, 8, generator=g),
    }
    found = loss(TensorDict(entries, (30,)))
    assert float(found["loss_reconstruction"]) == float(found["loss_transition"]) == 0.0
    z = torch.cat((entries["errors"][:, 0], torch.zeros(30, 2)), -1)
    torch.testing.assert_close(found["loss_mmd"], 0.5 * discrepancy(z, entries["normal"]))


@pytest.mark.slow
def test_same_seed_same_weights_and_it_learns(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    for name in ("one", "same"):
        runs.start("dlspf", SMALL, tmp_path / name, quiet)
    one, same = ((tmp_path / n / "dlspf.safetensors").read_bytes() for n in ("one", "same"))
    assert one == same
    with (tmp_path / "one/metrics/scalars/held_out_reconstruction.csv").open() as file:
        losses = [float(value) for _, value in csv.reader(file)]
    assert losses[-1] < 0.9 * losses[0]
    assert card_of(tmp_path / "one/dlspf.safetensors")["scores"]["runs"] == 1


@pytest.mark.parametrize(
    ("scenario", "words"),
    [
        ("indoor-v0:horizon=15", "a horizon of 15 steps is too short: 16 at least"),
        ("indoor-v0:imu_bias=true", "a scenario with an IMU without biases is needed"),
    ],
)
def test_scenarios_that_do_not_fit(scenario: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        dlspf(scenario=scenario)
