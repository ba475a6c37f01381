"""Flying and coming back to it: blocks add up, work is resumed, whatever raises is counted."""

from pathlib import Path

import numpy as np
import pytest

from coloc_env.scenarios import make_scenario
from training.evaluation.evaluate import evaluate
from training.reproduce import pool, study
from training.reproduce.cost import measure, measured
from training.reproduce.store import Store
from training.reproduce.study import WORLD, Piece, Study, Variant

SMALL = Variant("small", "small", (("n_uavs", 2),), steps=12)
OTHER = Variant("other", "other", (("n_uavs", 2), ("nlos", 0.3)), steps=12)


def silent(*_: object) -> None:
    pass


def fly(store: Store, agents: tuple[str, ...], *blocks: int, seed: int = 5) -> Study:
    """Everything flown in SMALL."""
    found = Study(store, seed)
    pieces = [p for agent in (WORLD, *agents) for p in found.pieces(SMALL, agent, *blocks)]
    pool.fly(found, pieces, 1, silent, silent)
    return found


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def test_blocks_add_up_to_the_evaluation(store: Store) -> None:
    agents = ("test_still:offset=0.1", "ekf")
    results = fly(store, agents, 3, 2).results(SMALL, agents, 3, 2)
    whole = evaluate(make_scenario("indoor-v0", n_uavs=2, horizon=12), agents, runs=5, seed=5)
    assert (results.runs, results.seed, list(results.agents)) == (5, 5, list(agents))
    np.testing.assert_array_equal(results.worlds.truth, whole.worlds.truth)
    np.testing.assert_array_equal(results.worlds.attitude, whole.attitude)
    np.testing.assert_array_equal(results.worlds.scored, whole.worlds.scored)
    assert results.bound is not None
    assert whole.bound is not None
    assert results.bound.rmse == pytest.approx(whole.bound.rmse)
    for name in agents:
        ours, theirs = results.agents[name], whole.agents[name]
        np.testing.assert_allclose(ours.error, theirs.error, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(ours.nees, theirs.nees, rtol=1e-3, atol=1e-4)
        assert ours.series.keys() == theirs.series.keys()
    still = results.agents[agents[0]].series["particles"]
    np.testing.assert_array_equal(still, whole.agents[agents[0]].series["particles"])


def test_the_first_block_alone_is_the_shorter_study(store: Store) -> None:
    found = fly(store, ("test_still",), 3, 2)
    few, many = (found.results(SMALL, ("test_still",), *blocks) for blocks in ((3,), (3, 2)))
    a, b = (each.agents["test_still"].error for each in (few, many))
    np.testing.assert_array_equal(a, b[:3])


def test_a_rerun_computes_nothing_and_more_runs_only_the_rest(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly(store, ("test_still",), 2)
    flown: list[Piece] = []

    def counted(piece: Piece, *rest: object) -> None:
        flown.append(piece)
        compute(piece, *rest)  # type: ignore[arg-type]

    compute = study.compute
    monkeypatch.setattr(pool, "compute", counted)
    fly(store, ("test_still",), 2)
    assert flown == []
    fly(store, ("test_still", "ekf"), 2, 1)
    assert [(p.agent, p.seed, p.runs) for p in flown] == [
        (WORLD, 7, 1),
        ("test_still", 7, 1),
        ("ekf", 5, 2),
        ("ekf", 7, 1),
    ]


def test_an_interruption_keeps_what_is_done(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    compute = study.compute

    def interrupted(piece: Piece, *rest: object) -> None:
        if piece.agent == "ekf":
            raise KeyboardInterrupt
        compute(piece, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(pool, "compute", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fly(store, ("test_still", "ekf"), 2)
    found = Study(store, 5)
    pieces = [p for a in (WORLD, "test_still", "ekf") for p in found.pieces(SMALL, a, 2)]
    assert [piece.agent for piece in found.missing(pieces)] == ["ekf"]


@pytest.mark.parametrize("change", ["seed", "steps", "code", "weights"])
def test_changed_settings_are_flown_anew(
    change: str, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly(store, ("test_still",), 2)
    seed, variant = 5, SMALL
    if change == "seed":
        seed = 6
    elif change == "steps":
        variant = Variant("small", "small", SMALL.overrides, steps=11)
    else:
        monkeypatch.setattr(study, f"{change}_of", lambda *_: "changed")
        study._settings.cache_clear()
    found = Study(store, seed)
    pieces = found.pieces(variant, "test_still", 2)
    assert found.missing(pieces) == pieces
    study._settings.cache_clear()


def test_an_agent_that_raises_is_counted_not_dropped(store: Store) -> None:
    agents = ("test_still:wrong=raises:west=18.3", "test_still")
    results = fly(store, agents, 4, 2).results(SMALL, agents, 4, 2)
    fell = results.agents[agents[0]]
    assert fell.error.shape == (6, 12, 2)
    assert 0 < len(fell.messages) == fell.broken.sum() < 6
    assert "singular" in fell.messages[0]
    assert results.summary["agents"][agents[0]]["diverged_runs"] >= len(fell.messages)


def test_what_cannot_be_flown_is_told_and_the_rest_goes_on(store: Store) -> None:
    lines: list[str] = []
    found = Study(store, 0)
    agents = (WORLD, "test_still:wrong=missing", "ekf:robust=hubr", "test_still")
    pieces = [p for agent in agents for p in found.pieces(SMALL, agent, 2)]
    pool.fly(found, pieces, 1, silent, lines.append)
    assert found.failed.keys() == {("small", agent) for agent in agents[1:3]}
    assert "NotImplementedError: not there yet" in found.failed["small", agents[1]]
    assert "hubr" in found.failed["small", agents[2]]
    assert any("not there yet" in line for line in lines)
    assert list(found.results(SMALL, agents[1:], 2).agents) == ["test_still"]


def test_recordings_that_are_not_there(store: Store) -> None:
    found = Study(store, 0)
    away = Variant("mrclam", "MRCLAM", (("data", "/no/where"),), "replay-mrclam-v0")
    assert found.missing(found.pieces(away, WORLD, 1)) == []
    assert not found.can(away)
    assert found.can(SMALL)
    assert "/no/where" in found.failed["mrclam", WORLD]


def test_agents_of_other_worlds_are_refused(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    found = fly(store, ("test_still",), 2)
    load = Study._load

    def tampered(self: Study, piece: Piece) -> object:
        arrays, facts = load(self, piece)
        return arrays, facts | ({"start": []} if piece.agent == WORLD else {})

    monkeypatch.setattr(Study, "_load", tampered)
    with pytest.raises(ValueError, match="other worlds"):
        found.results(SMALL, ("test_still",), 2)


def test_paths_in_options_stay_in_the_store(store: Store) -> None:
    piece = Piece(SMALL, "pfnn:weights=../../a.safetensors", 0, 1)
    assert store.path(piece.name, {}).parent == store.folder / "small"


def test_progress_ends_at_all(store: Store) -> None:
    told: list[tuple[str, int, int]] = []
    found = Study(store, 0)
    pieces = [p for v in (SMALL, OTHER) for p in found.pieces(v, "test_still:wrong=raises", 3)]
    pool.fly(found, pieces, 1, lambda *x: told.append(x), silent)
    assert told[0] == ("flights", 0, 72)
    assert told[-1] == ("flights", 72, 72)


@pytest.mark.slow
def test_processes_make_the_same(store: Store, tmp_path: Path) -> None:
    agents = ("ekf", "ekf:robust=huber", "pf500")
    alone = fly(store, agents, 2).results(SMALL, agents, 2)
    found = Study(Store(tmp_path / "spread"), 5)
    pieces = [p for agent in (WORLD, *agents) for p in found.pieces(SMALL, agent, 2)]
    told: list[tuple[str, int, int]] = []
    pool.fly(found, pieces, 2, lambda *x: told.append(x), silent)
    together = found.results(SMALL, agents, 2)
    assert found.failed == {}
    assert told[-1][2] == 96
    for agent in agents:
        np.testing.assert_array_equal(alone.agents[agent].offset, together.agents[agent].offset)


def test_cost(store: Store) -> None:
    scenario = SMALL.build()
    agents = ("ekf", "pf500", "pf500:particles=100", "test_still:wrong=raises:at=7")
    found = measure(scenario, agents, 0, silent)
    assert list(found) == list(agents[:3])
    for one in found.values():
        assert one.ms.shape == (12,)
        assert (one.ms > 0).all()
    few, many = found["pf500:particles=100"], found["pf500"]
    # positions, velocities, attitudes and weights of 500 particles of two UAVs
    assert 2 * 500 * 11 * 4 <= many.belief <= 2.0 * 2 * 500 * 11 * 4
    assert 3 * few.belief < many.belief
    assert many.working > few.working > 0


def test_cost_is_stored(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    first = measured(store, SMALL, 0, ["ekf", "test_still"], silent)
    monkeypatch.setattr("training.reproduce.cost.measure", lambda *_: pytest.fail("measured"))
    again = measured(store, SMALL, 0, ["ekf", "test_still"], silent)
    assert list(again) == ["ekf", "test_still"]
    np.testing.assert_array_equal(first["ekf"].ms, again["ekf"].ms)
    assert first["ekf"].working == again["ekf"].working
    assert measured(store, SMALL, 0, [], silent) == {}
