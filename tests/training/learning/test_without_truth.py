"""Training without ground truth: no truth is read, labels are what they say, left-out predictions
are those of an update that left the measurement out."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from scipy.optimize import least_squares
from torch import Tensor

from agents.models.measurements import Block
from agents.models.update import information, posterior
from agents.robust import Trust
from coloc_env.envs.torchrl import CoLocEnv
from coloc_env.scenarios import parse_scenario
from tests.sampling import first_fast
from training.evaluation.evaluate import silent
from training.learning import run
from training.learning.labels import calibrated, smoothed, tied, trilaterated
from training.learning.left_out import DEGREES, left_out
from training.learning.pfnn import LabelName as CorrectorLabels
from training.learning.trust import LabelName as TrustLabels

ROOM = "indoor-v0:n_uavs=2:anchors=8:horizon=40"
LEAST = {"scenario": ROOM, "worlds": 1, "epochs": 1, "score_runs": 0}
MODES = [
    *(("pfnn", {"labels": one, "passes": 1}) for one in CorrectorLabels.__args__ if one != "truth"),
    ("pfnn", {"labels": "prediction", "mode": "online"}),
    ("pfnn", {"labels": "contrastive", "mode": "online"}),
    *(
        ("trust", {"labels": one, "variants": "horizon=20", "steps": 5})
        for one in TrustLabels.__args__
        if one != "truth"
    ),
]


def trained(name: str, options: dict[str, Any], out: Path) -> dict[str, Tensor]:
    return load_file(run.start(name, LEAST | options, out, silent))


def hide(patch: pytest.MonkeyPatch) -> None:
    """The privileged state is NaN from now on."""
    whole = CoLocEnv._observe

    def blind(self: CoLocEnv, leaves: Any) -> Any:
        out = whole(self, leaves)
        return out.set("state", torch.full_like(out["state"], torch.nan))

    patch.setattr(CoLocEnv, "_observe", blind)


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_no_loss_reads_the_truth(
    mode: tuple[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, options = mode
    seen = trained(name, options, tmp_path / "seen")
    hide(monkeypatch)
    blind = trained(name, options, tmp_path / "blind")
    first = trained(name, options | {"seed": 1}, tmp_path / "other")
    for key, value in seen.items():
        assert torch.equal(blind[key], value)
    assert any(not torch.equal(first[key], value) for key, value in seen.items())


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_it_learns_and_from_given_weights(mode: tuple[str, dict[str, Any]], tmp_path: Path) -> None:
    """Weights move from those that it starts from; a run's file does as well as a name."""
    name, options = mode
    first = trained(name, options, tmp_path / "first")
    file = str(tmp_path / f"first/{name}.safetensors")
    second = trained(name, options | {"start": file}, tmp_path / "second")
    again = trained(name, options, tmp_path / "again")
    assert all(torch.equal(again[key], value) for key, value in first.items())
    assert any(not torch.equal(second[key], value) for key, value in first.items())


@pytest.mark.slow
def test_the_truth_is_needed_for_its_own_labels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That the truth hidden is a truth not read would say nothing if it could not be hidden."""
    hide(monkeypatch)
    with pytest.raises(ValueError, match="NaN"):
        trained("trust", {"variants": "horizon=20", "steps": 5}, tmp_path / "blind")


# ---------------------------------------------------------------- labels


def test_trilateration_is_scipys() -> None:
    """Of moving UAVs, some of whose ranges are missing."""
    g = torch.Generator().manual_seed(0)
    anchors = 10 * torch.rand(6, 3, generator=g, dtype=torch.float64)
    places = 2 + 6 * torch.rand(5, 3, generator=g, dtype=torch.float64)
    lag = torch.tensor([-0.2, 0.0, 0.3]).double()
    along = places.unsqueeze(1) + lag.unsqueeze(-1) * torch.tensor([0.5, -1.0, 0.2])
    noise = 0.05 * torch.randn(5, 3, 6, generator=g).double()
    ranges, there = torch.cdist(along, anchors) + noise, torch.rand(5, 3, 6, generator=g) < 0.9
    there[4, :, 1:] = False
    start = torch.full((5, 3), 5.0).double()
    found, known = trilaterated(start, anchors.expand(5, 6, 3), ranges, there, lag, 0.05)
    assert known.tolist() == [True, True, True, True, False]
    for k in range(4):

        def residual(x: Any, k: int = k) -> Any:
            p = x[:3] + lag.numpy()[:, None] * x[3:]
            apart = ((p[:, None] - anchors.numpy()) ** 2).sum(-1) ** 0.5 - ranges[k].numpy()
            return apart[there[k].numpy()]

        begin = [*start[k].tolist(), 0.0, 0.0, 0.0]
        expected = least_squares(residual, begin, ftol=1e-15, xtol=1e-12, gtol=1e-12).x
        torch.testing.assert_close(found[k], torch.from_numpy(expected[:3]), atol=1e-5, rtol=0)


@pytest.mark.parametrize("make", first_fast(calibrated, smoothed))
def test_labels_are_near_the_truth(make: Any) -> None:
    """As near as a single range's noise, or its half; and of the steps that they say."""
    scenario = parse_scenario(ROOM)
    labels = make(scenario, 1, 7)
    env = CoLocEnv(scenario, 1, seed=7)
    batch = env.rollout(40, auto_reset=True)
    true = batch["state"].unflatten(-1, (2, -1))[..., :3].double()
    off = (labels.position - true).norm(dim=-1)[labels.known]
    assert labels.known.sum() >= 40
    assert off.square().mean().sqrt() < (0.4 if make is calibrated else 0.1)
    if make is smoothed:
        assert not labels.known[:, -10:].any()


def test_ties_pull_positions_together() -> None:
    """Exact vectors: relative positions become exact; one wrong landmark is left out."""
    g = torch.Generator().manual_seed(2)
    place = 10 * torch.rand(3, 3, generator=g, dtype=torch.float64)
    landmarks = 10 * torch.rand(200, 3, generator=g, dtype=torch.float64)
    vectors = landmarks - place.unsqueeze(1)
    there = torch.ones(3, 200, dtype=torch.bool)
    start = place + 0.1 * torch.randn(3, 3, generator=g, dtype=torch.float64)
    found = tied(start, vectors, there, 0.15)
    expected = place + (start - place).mean(0)  # the team's mean stays

    def apart(p: Tensor) -> Tensor:
        return (p - expected).norm(dim=-1).max()

    assert apart(found) < 0.5 * apart(start)
    torch.testing.assert_close(found.mean(0), start.mean(0))
    vectors[0, 5] += 50.0
    assert (tied(start, vectors, there, 0.15) - found).norm() < 0.01


# ---------------------------------------------------------------- left out


@pytest.mark.parametrize("k", [1, 3])
def test_left_out_is_the_update_without_it(k: int) -> None:
    """Of linear measurements: what an update without the measurement predicts of it."""
    g = torch.Generator().manual_seed(k)
    m, e = 4, 6
    h = torch.randn(1, 1, m, k, e, generator=g, dtype=torch.float64)
    r = torch.randn(1, 1, m, k, generator=g, dtype=torch.float64)
    variance = 0.1 + torch.rand(1, 1, m, k, generator=g, dtype=torch.float64)
    mask = torch.tensor([[[True, True, False, True]]])
    trust = Trust(torch.rand(1, 1, m, generator=g).double(), r[..., 0] * 0.1)
    block = Block(r, h, variance, mask)
    root = torch.randn(1, 1, e, e, generator=g, dtype=torch.float64)
    prior = root @ root.mT
    delta, after = posterior(prior, *information([block], [trust]))
    at = replace(block, residual=r - (h @ delta[..., None, :, None])[..., 0])
    found = left_out(at, trust, after)
    for i in range(m):
        if not mask[0, 0, i]:
            assert found[0, 0, i] == 0
            continue
        others = replace(block, mask=mask & (torch.arange(m) != i))
        mean, p = posterior(prior, *information([others], [trust]))
        residual = (r - (h @ mean[..., None, :, None])[..., 0])[0, 0, i]
        s = h[0, 0, i] @ p[0, 0] @ h[0, 0, i].T + torch.diag(variance[0, 0, i])
        squared = residual @ torch.linalg.solve(s, residual)
        score = 0.5 * (s.logdet() + (DEGREES + k) * (squared / DEGREES).log1p())
        torch.testing.assert_close(found[0, 0, i], score)


# ---------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("pfnn", {"labels": "calibration", "mode": "online"}, "labels=calibration is not allowed"),
        ("pfnn", {"labels": "left_out"}, "one of truth, calibration"),
        ("trust", {"labels": "prediction"}, "one of truth, left_out, self_supervised"),
        ("pfnn", {"labels": "calibration", "scenario": "indoor-v0:horizon=20"}, "anchors=4"),
    ],
)
def test_one_clear_line(name: str, options: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words) as error:
        run.start(name, LEAST | options, tmp_path / "run", silent)
    assert "\n" not in str(error.value)
