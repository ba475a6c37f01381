"""Recordings for rerun's viewer, read back with rerun's own API."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from agents import make
from coloc_env import make_scenario
from training.evaluation import runs
from training.evaluation.evaluate import evaluate
from training.evaluation.viewing import _ellipsoids, view_runs, view_scenario


def read(path: Path, component: str) -> dict[str, list[Any]]:
    """By entity what was logged of a component, in order."""
    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith(component):
                found.setdefault(chunk.entity_path, []).extend(batch.column(name).to_pylist())
    return found


def test_an_evaluation_comes_back(tmp_path: Path) -> None:
    scenario = make_scenario("indoor-v0", horizon=12, n_uavs=3, landmarks=5)
    made = runs.of(evaluate(scenario, ["ekf"], 1, bound=False), "x")
    view_runs(made, tmp_path / "x.rrd")
    points, scalars = read(tmp_path / "x.rrd", ":positions"), read(tmp_path / "x.rrd", ":scalars")
    np.testing.assert_allclose(points["/world/truth"], made.truth, rtol=1e-6)
    estimates = made.truth + made.methods["ekf"].offset
    np.testing.assert_allclose(points["/world/ekf/estimate"], estimates, rtol=1e-6)
    np.testing.assert_allclose(scalars["/error/ekf"], made.methods["ekf"].error[0], rtol=1e-6)
    assert len(points["/world/landmarks"][0]) == 5
    sizes = np.array(read(tmp_path / "x.rrd", ":half_sizes")["/world/ekf/ellipsoid"])
    volume = np.sqrt(np.linalg.det(made.methods["ekf"].covariance.astype(float)))
    np.testing.assert_allclose(sizes.prod(-1) / volume, 7.815**1.5, rtol=1e-3)


@pytest.mark.parametrize(("name", "agent"), [("indoor-v0", "pf500"), ("wsn-v0", "ekf")])
def test_a_scenario_as_it_runs(name: str, agent: str, tmp_path: Path) -> None:
    scenario = make_scenario(name, horizon=5, n_uavs=2)
    view_scenario(make(agent, scenario), scenario, 3, 5, tmp_path / "x.rrd")
    points = read(tmp_path / "x.rrd", ":positions")
    assert len(points["/world/truth"]) == len(points[f"/world/{agent}/estimate"]) == 5
    if agent == "pf500":
        clouds = np.array(points["/world/pf500/particles"][-1]).reshape(2, 500, 3)
        apart = np.linalg.norm(clouds.mean(1) - points["/world/truth"][-1], axis=-1)
        assert (apart < 2).all()
        assert len(read(tmp_path / "x.rrd", ":strips")["/world/ranges"]) == 5


def test_ellipsoids_turn_as_the_covariance_does() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4, 3, 3))
    covariance = root @ root.mT
    values, vectors = np.linalg.eigh(covariance)
    sizes, turns = _ellipsoids(vectors * np.sqrt(values)[:, None])
    np.testing.assert_allclose(turns @ (sizes[..., None] ** 2 * turns.mT), covariance, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)
