"""A sensor that the bound cannot count is named once, in one line; evaluation goes on."""

import dataclasses
import warnings

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from coloc_env.bounds import posterior_bound
from coloc_env.scenario import Scenario
from coloc_env.scenarios import make_scenario
from coloc_env.sensors import Sensor
from coloc_env.sensors.base import Layout, Leaf, Window
from training.cli.command import app
from training.evaluation.evaluate import evaluate


class Sonar(Sensor):
    """A sensor of somebody's own, of which the bound knows nothing."""

    def leaves(self, layout: Layout) -> dict[str, Leaf]:
        return {"sonar": Leaf(1)}

    def sample(self, window: Window, placed: dict[str, Tensor]) -> dict[str, Tensor]:
        return {"sonar": torch.ones(*window.alive.shape, 1, dtype=torch.float32)}


def scenario() -> Scenario:
    built = make_scenario("indoor-v0", n_uavs=2, horizon=3)
    return dataclasses.replace(built, sensors=(*built.sensors, Sonar()))


def test_the_bound_names_the_sensor() -> None:
    with pytest.raises(NotImplementedError, match=r"no Fisher information is known for Sonar$"):
        posterior_bound(scenario(), runs=1)


def test_an_evaluation_goes_on_without_the_bound_and_warns_once() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = evaluate(scenario(), ["ekf", "dead_reckoning"], runs=2)
    words = [str(one.message) for one in caught if "bound" in str(one.message)]
    expected = "indoor-v0: no posterior bound: bounds: no Fisher information is known for Sonar"
    assert words == [expected]
    assert found.summary["bound"]["rmse"] is None
    assert found.summary["agents"]["ekf"]["rmse"] > 0


def test_the_command_prints_it_in_one_line(tmp_path: object) -> None:
    words = ["evaluate", "stein2d-v0", "--agents", "dead_reckoning", "--runs", "1", "--no-figures"]
    result = CliRunner().invoke(app, [*words, "--set", "horizon=3", "--out", f"{tmp_path}/out"])
    assert result.exit_code == 0, result.output
    lines = [line for line in result.stderr.splitlines() if "bound" in line]
    assert lines == [
        "warning: stein2d-v0: no posterior bound: bounds: no Fisher information is known for "
        "RelativePose"
    ]
