"""A team's step beside the ``particles`` library: both localize; what the table says."""

import sys

import numpy as np
import pytest

from coloc_env.world import World
from training.bench import filters


@pytest.mark.slow
def test_both_follow_the_team() -> None:
    pytest.importorskip("particles")
    scenario = filters.room()
    seen = filters.observed(scenario, filters.WARM_UP + filters.STEPS)
    world = World(scenario, 1)
    world.reset(0)
    for _ in range(len(seen) - 1):
        world.step(seen[0]["prior"].new_zeros(1, 6, 9))
    truth = world.truth.position[0].numpy()
    own = filters.ours("pfnn", scenario, seen, filters.beliefs(scenario, seen))
    for run in (filters.peer(scenario, seen), own):
        first, second = run(), run()
        assert np.median(np.linalg.norm(first - truth, axis=-1)) < 0.2
        assert np.median(np.linalg.norm(second - truth, axis=-1)) < 0.2


def test_ratios_are_those_of_the_best_rounds() -> None:
    found = {
        filters.PEER: [10.0, 20.0, 30.0],
        "`apf`": [5.0, 4.0, 5.0],
        "`pfnn`": [5.5, 6.0, 5.0],
    }
    table = filters.table(found, "command")
    assert [row[1:] for row in table["rows"]] == [
        ["10.00", "20.00", "1.0 ×"],
        ["4.00", "5.00", "2.5 ×"],
        ["5.00", "5.50", "2.0 ×"],
    ]
    assert "the corrector adds 25% (`pfnn`)" in table["caption"]


def test_without_the_library_it_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["filters", "--out", "table.json"])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(SystemExit):
        filters.main()
    assert "particles is not installed: pip install --no-deps" in capsys.readouterr().err
