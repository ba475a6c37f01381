"""TUM files of real runs: attitudes that are estimated, stamps that were recorded."""

from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coloc_env.scenarios import make_scenario
from training.evaluation.evaluate import evaluate
from training.evaluation.tum import write_tum

START = 1_700_000_000_123_456_789


@pytest.mark.parametrize(("agent", "imu"), [("ekf", True), ("pf500", True), ("ekf", False)])
def test_estimates_have_their_attitudes_and_stamps(agent: str, imu: bool, tmp_path: Path) -> None:
    """Near the true ones where a method estimates them, else the identity."""
    overrides = {"n_uavs": 2, "horizon": 12, "imu": imu, "landmarks": 20 if imu else 0}
    built = make_scenario("indoor-v0", anchors=8, **overrides)
    built = replace(built, arena=replace(built.arena, start=START))
    write_tum(evaluate(built, [agent], 1, bound=False), tmp_path)
    truth, found = (
        [line.split() for line in (tmp_path / name / "uav_1.txt").read_text().splitlines()]
        for name in ("groundtruth", agent)
    )
    stamps = [int(Decimal(row[0]).scaleb(9)) for row in found]
    assert stamps == [START + 100_000_000 * k for k in range(12)]
    q, exact = (Rotation.from_quat(np.array(rows, float)[:, 4:]) for rows in (found, truth))
    if imu:
        assert 1e-6 < (q.inv() * exact).magnitude().max() < 0.2
    else:
        np.testing.assert_array_equal(q.as_quat(), [[0, 0, 0, 1]] * 12)
