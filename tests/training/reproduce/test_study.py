"""A study run and taken up again: blocks add up, work is resumed, whatever raises is counted."""

from pathlib import Path

import numpy as np
import pytest

from coloc_env.scenarios import make_scenario
from training.evaluation.evaluate import evaluate
from training.pool import ALONE, Workers
from training.reproduce import study, work
from training.reproduce.cost import COST, measure
from training.reproduce.drawing import panels
from training.reproduce.measures import rmse
from training.reproduce.results import Results
from training.reproduce.settings import Settings
from training.reproduce.study import STUDIES, Part, Study, reproduce
from training.reproduce.tables import by_agent, with_ends
from training.reproduce.verdicts import Claim, Goal, mean_of
from training.reproduce.work import (
    POSTERIOR,
    SNAPSHOT,
    WORLD,
    Cell,
    Piece,
    Training,
    TrainingRun,
    Variant,
)

SMALL = Variant("small", "small", (("n_uavs", 2),), steps=12)
OTHER = Variant("other", "other", (("n_uavs", 2), ("nlos", 0.3)), steps=12)
STILL = "test_still:offset=0.1"


def silent(*_: object) -> None:
    pass


def figure(results: Results):  # type: ignore[no-untyped-def]
    """Nothing but axes."""
    return panels(1, 1, (2, 2), "t")[0] if results.runs("small") else None


def small(*cells: Cell) -> Study:
    """A study of one part with these cells."""
    part = Part(
        "A part",
        lambda settings: cells,
        lambda settings: ["Some words."],
        lambda settings: [Claim("exact", "0 m", "m", "above", 0.0, None,
                                (("small", "ekf"),), mean_of(rmse))],
        lambda settings: [Goal("near", "m", 9.0, False, (("small", "ekf"),), mean_of(rmse)),
                          Goal("far", "m", 9.0, False, (("nowhere", "x"),), mean_of(rmse))],
        lambda results: [by_agent("Errors", {"small": results.runs("small")},
                                  [("RMSE", with_ends(rmse))])],
        {"figure.png": figure},
    )  # fmt: skip
    return Study("small", "SMALL", "nowhere", 5, {"own": part})


def results_of(out: Path, *cells: Cell, seed: int = 5) -> Results:
    return Results(Settings(out, 5, seed=seed), cells, cells)


def run(
    out: Path, *cells: Cell, seed: int = 5, workers: Workers = ALONE
) -> tuple[Results, list[str]]:
    """Everything run; the results, and what was reported."""
    lines: list[str] = []
    reproduce(small(*cells), Settings(out, 5, seed=seed, workers=workers), silent, lines.append)
    found = results_of(out, *cells, seed=seed)
    found.pieces()
    return found, lines


def test_blocks_add_up_to_the_evaluation(tmp_path: Path) -> None:
    agents = (STILL, "ekf")
    cells = (Cell(SMALL, agents, 5), Cell(SMALL, ("ekf",), 3, key="few"))
    results, lines = run(tmp_path, *cells)
    assert sum("small/ekf-" in line for line in lines) == 2  # 3 runs, and 2 more
    found = results["small", "ekf"].evaluation
    whole = evaluate(make_scenario("indoor-v0", n_uavs=2, horizon=12), agents, runs=5, seed=5)
    assert (found.runs, found.seed, set(found.agents)) == (5, 5, {WORLD, *agents})
    np.testing.assert_array_equal(found.worlds.truth, whole.worlds.truth)
    np.testing.assert_array_equal(found.worlds.attitude, whole.worlds.attitude)
    np.testing.assert_array_equal(found.worlds.scored, whole.worlds.scored)
    assert found.bound is not None
    assert whole.bound is not None
    assert found.bound.rmse == pytest.approx(whole.bound.rmse)
    for name in agents:
        ours, theirs = found.agents[name], whole.agents[name]
        np.testing.assert_allclose(ours.error, theirs.error, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(ours.nees, theirs.nees, rtol=1e-3, atol=1e-4)
        assert ours.series.keys() == theirs.series.keys()
    still = found.agents[STILL].series["particles"]
    np.testing.assert_array_equal(still, whole.agents[STILL].series["particles"])
    few = results["few", "ekf"]
    assert len(few.error) == 3
    np.testing.assert_array_equal(few.error, results["small", "ekf"].error[:3])


def test_a_rerun_computes_nothing_and_more_runs_only_the_rest(tmp_path: Path) -> None:
    first = Cell(SMALL, ("test_still",), 2)
    run(tmp_path, first)
    page = (tmp_path / "page.md").read_text()
    assert run(tmp_path, first)[1] == []
    assert (tmp_path / "page.md").read_text() == page
    _, lines = run(tmp_path, first, Cell(SMALL, ("test_still", "ekf"), 3))
    assert [line.split(" (")[0] for line in lines] == [
        "1/4 small/dead_reckoning-7+1",
        "2/4 small/test_still-7+1",
        "3/4 small/ekf-5+2",
        "4/4 small/ekf-7+1",
    ]


def test_what_is_written(tmp_path: Path) -> None:
    run(tmp_path, Cell(SMALL, ("ekf",), 2), Cell(SMALL, ("ekf",), 1, COST))
    content = study.page.read(tmp_path / "results.json")
    assert content["provenance"]["command"] == "coloc reproduce small --seed 5"
    assert content["provenance"]["runs"] == 5
    assert content["claims"][0]["verdict"] == "reproduced"
    assert [goal["goal"] for goal in content["goals"]] == ["near"]  # of what was asked for
    titles = [section["title"] for section in content["sections"]]
    assert titles == ["The paper's claims", "Our goals", "A part"]
    part = content["sections"][-1]
    (table,) = part["tables"]
    assert table["header"] == ["variant", "agent", "RMSE"]
    assert table["align"] == ["left", "left", "right"]
    assert [row[1] for row in table["rows"]] == ["`dead_reckoning`", "`ekf`"]
    assert part["figures"] == [{"file": "figure.png", "caption": "Nothing but axes."}]
    own = content["figures"]["small"]["agents"]["ekf"]
    assert own["rmse"] == pytest.approx(float(table["rows"][1][2].split()[0]), abs=6e-4)
    assert content["costs"]["small"]["ekf"]["ms_per_step"] > 0
    assert study.page.render(content) == (tmp_path / "page.md").read_text()
    assert "](../x/figure.png)" in study.page.render(content, "../x/")
    assert (tmp_path / "figure.png").stat().st_size > 1000


def test_an_interruption_keeps_what_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compute = work.Piece.run

    def interrupted(piece: Piece, *rest: object) -> object:
        if piece.agents == ("ekf",):
            raise KeyboardInterrupt
        return compute(piece, *rest)  # type: ignore[arg-type]

    cell = Cell(SMALL, ("test_still", "ekf"), 2)
    with monkeypatch.context() as patch:
        patch.setattr(work.Piece, "run", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, cell)
    left = [p for p in results_of(tmp_path, cell).pieces() if not p.done(tmp_path)]
    assert [piece.agents for piece in left] == [("ekf",)]


@pytest.mark.parametrize("change", ["seed", "steps", "code", "weights"])
def test_changed_settings_are_computed_again(
    change: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path, Cell(SMALL, ("test_still",), 2))
    seed, variant = 5, SMALL
    if change == "seed":
        seed = 6
    elif change == "steps":
        variant = Variant("small", "small", SMALL.overrides, steps=11)
    else:
        monkeypatch.setattr(work, f"{change}_of", lambda *_: "changed")
        work._settings.cache_clear()
    pieces = results_of(tmp_path, Cell(variant, ("test_still",), 2), seed=seed).pieces()
    assert not any(piece.done(tmp_path) for piece in pieces)
    work._settings.cache_clear()


def test_an_agent_that_raises_is_counted_not_dropped(tmp_path: Path) -> None:
    agent = "test_still:wrong=raises:west=18.3"
    results, _ = run(tmp_path, Cell(SMALL, (agent,), 6), Cell(SMALL, (agent,), 4, key="few"))
    fell = results["small", agent]
    assert fell.error.shape == (6, 12, 2)
    assert 0 < len(fell.record.messages) == fell.record.broken.sum() < 6
    assert "singular" in fell.record.messages[0]
    assert fell.diverged >= len(fell.record.messages)


def test_what_cannot_be_run_is_reported_and_the_rest_goes_on(tmp_path: Path) -> None:
    away = Variant("mrclam", "MRCLAM", (("data", "/no/where"),), "replay-mrclam-v0")
    agents = ("test_still:wrong=missing", "ekf:robust=hubr", "test_still")
    _, lines = run(tmp_path, Cell(SMALL, agents, 2), Cell(away, ("ekf",), 1))
    assert any("NotImplementedError: not there yet" in line for line in lines)
    assert any("hubr" in line for line in lines)
    not_run = "\n".join(study.page.read(tmp_path / "results.json")["not_run"])
    assert "NotImplementedError: not there yet" in not_run
    assert "/no/where" in not_run
    page = (tmp_path / "page.md").read_text()
    assert "## Not run" in page
    assert "| small | `test_still` |" in page


def test_agents_of_other_worlds_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results, _ = run(tmp_path, Cell(SMALL, ("test_still",), 2))
    load = Piece.load

    def tampered(self: Piece, store: object) -> object:
        arrays, facts = load(self, store)  # type: ignore[arg-type]
        return arrays, facts | ({"start": []} if self.agents == (WORLD,) else {})

    monkeypatch.setattr(Piece, "load", tampered)
    with pytest.raises(ValueError, match="other worlds"):
        results["small", "test_still"]


def test_paths_in_options_stay_in_the_store(tmp_path: Path) -> None:
    piece = Piece(SMALL, ("pfnn:weights=../../a.safetensors",), 0, 1)
    store = work.Store(tmp_path)
    assert store.path(piece.name, {}).parent == tmp_path / "small"


def test_progress_ends_at_all(tmp_path: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    cells = [Cell(v, ("test_still:wrong=raises",), 3) for v in (SMALL, OTHER)]
    reproduce(small(*cells), Settings(tmp_path, 3), lambda *x: seen.append(x))
    assert seen[-1] == ("simulations", 144, 144)


def test_bounds_are_pieces_of_a_study(tmp_path: Path) -> None:
    variant = Variant("small", "small", SMALL.overrides, steps=4, bounded=False)
    cells = (Cell(variant, ("test_still",), 2), Cell(variant, (), 2, POSTERIOR),
             Cell(variant, (), 1, POSTERIOR), Cell(variant, (), 1, SNAPSHOT))  # fmt: skip
    results, _ = run(tmp_path, *cells)
    assert results["small", WORLD].evaluation.bound is None
    known, expected = (
        results.get("small", "", POSTERIOR),
        work.posterior_bound(variant.build(), 2, 5),
    )
    np.testing.assert_array_equal(known.mse, expected.mse)
    np.testing.assert_array_equal(known.scored, expected.scored)
    known = results.get("small", "", SNAPSHOT)
    expected = work.snapshot_bound(variant.build(), 1, 5)
    assert type(known) is type(expected)
    np.testing.assert_array_equal(known.mse, expected.mse)


@pytest.mark.slow
def test_processes_make_the_same(tmp_path: Path) -> None:
    cell = Cell(SMALL, ("ekf",), 2)
    alone, _ = run(tmp_path / "alone", cell)
    together, lines = run(tmp_path / "together", cell, workers=Workers(2))
    assert len(lines) == 2
    for agent in (WORLD, "ekf"):
        a, b = (results["small", agent].record.offset for results in (alone, together))
        np.testing.assert_array_equal(a, b)


# ---------------------------------------------------------------- costs


def test_cost() -> None:
    agents = ("ekf", "pf500", "pf500:particles=100", "test_still:wrong=raises:at=7")
    found = measure(SMALL.build(), agents, 0, silent)
    assert list(found) == list(agents[:3])
    for one in found.values():
        assert one.ms.shape == (12,)
        assert (one.ms > 0).all()
    few, many = found["pf500:particles=100"], found["pf500"]
    # positions, velocities, attitudes and weights of 500 particles of two UAVs
    assert 2 * 500 * 11 * 4 <= many.belief <= 2.0 * 2 * 500 * 11 * 4
    assert 3 * few.belief < many.belief
    assert many.working > few.working > 0


def test_cost_of_runs_shorter_than_the_warm_up() -> None:
    variant = Variant("short", "short", SMALL.overrides, steps=2)
    assert measure(variant.build(), ["ekf"], 0, silent)["ekf"].ms.shape == (2,)


def test_cost_is_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = Cell(SMALL, ("ekf", "test_still", "ekf:robust=hubr"), 1, COST)
    first, _ = run(tmp_path, cell)
    monkeypatch.setattr("training.reproduce.cost.measure", lambda *_: pytest.fail("measured"))
    again, _ = run(tmp_path, cell)
    assert list(again.kinds("small", COST)) == ["ekf", "test_still"]
    a, b = (results.get("small", "ekf", COST) for results in (first, again))
    np.testing.assert_array_equal(a.ms, b.ms)
    assert a.working == b.working


# ---------------------------------------------------------------- doors


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"runs": 0}, "--runs 0"),
        ({"steps": 0}, "--steps 0"),
        ({"seed": -1}, "seed=-1"),
        ({"fresh": True, "report_only": True}, "nothing would be left"),
    ],
)
def test_settings_are_refused(wrong: dict[str, int], words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        Settings(tmp_path, **({"runs": 1} | wrong))  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["circle", "file", "file above", "foreign", "read-only"])
def test_folders_are_tried_before_anything_is_computed(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work.Piece, "run", lambda *_: pytest.fail("computed"))
    out = tmp_path / "out"
    if kind == "circle":
        out.symlink_to(out)
    elif kind.startswith("file"):
        out.write_text("")
        out = out / "below" if kind.endswith("above") else out
    elif kind == "foreign":
        out.mkdir()
        (out / "results.json").write_text("somebody else's")
    else:
        out.mkdir()
        monkeypatch.setattr("os.access", lambda *_: False)  # root may write everywhere
    with pytest.raises(ValueError, match=r"not a folder|overwritten|cannot be written"):
        reproduce(small(Cell(SMALL, ("ekf",), 1)), Settings(out, 1))


def test_links_are_followed_even_if_they_dangle(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "there")
    run(tmp_path / "link", Cell(SMALL, ("test_still",), 1))
    assert (tmp_path / "there" / "page.md").exists()
    assert (tmp_path / "link").is_symlink()


def test_a_report_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"store holds nothing yet: run without --report-only"):
        reproduce(small(Cell(SMALL, ("ekf",), 1)), Settings(tmp_path / "x", 1, report_only=True))
    assert not (tmp_path / "x").exists()


def test_a_report_of_some_says_what_is_missing(tmp_path: Path) -> None:
    run(tmp_path, Cell(SMALL, ("test_still",), 2))
    cells = Cell(SMALL, ("test_still", "ekf"), 2)
    reproduce(small(cells), Settings(tmp_path, 2, seed=5, report_only=True))
    content = study.page.read(tmp_path / "results.json")
    assert content["not_run"] == ["*small*, `ekf`: not run"]
    assert content["claims"][0]["reason"] == "not run: ekf in small"


def test_fresh_throws_the_store_away(tmp_path: Path) -> None:
    cell, lines = Cell(SMALL, ("test_still",), 2), []  # type: ignore[var-annotated]
    run(tmp_path, cell)
    reproduce(small(cell), Settings(tmp_path, 2, seed=5, fresh=True), silent, lines.append)
    assert len(lines) == 2


def test_names_are_checked(tmp_path: Path) -> None:
    the = small(Cell(SMALL, ("ekf",), 1))
    for settings, words in (
        (
            Settings(tmp_path, 1, variants=["smal"]),
            r"unknown variant 'smal' \(did you mean 'small'",
        ),
        (Settings(tmp_path, 1, agents=["ekff"]), r"did you mean 'ekf'"),
        (Settings(tmp_path, 1, agents=["test_still"]), "not in this study: ekf are"),
        (Settings(tmp_path, 1, "stress"), "small has no part 'stress': own, all are allowed"),
    ):
        with pytest.raises(ValueError, match=words):
            reproduce(the, settings)


@pytest.mark.parametrize("name", list(STUDIES))
def test_every_study_is_well_made(name: str, tmp_path: Path) -> None:
    the, settings = STUDIES[name](), Settings(tmp_path, 40)
    assert STUDIES.summary(name)
    cells = [cell for part in the.parts.values() for cell in part.cells(settings)]
    by_key: dict[str, Variant] = {}
    for cell in cells:
        assert by_key.setdefault(cell.variant.key, cell.variant) == cell.variant
        assert 1 <= cell.runs <= 60
        assert len(set(cell.agents)) == len(cell.agents)
    names = {cell.name for cell in cells}
    for part in the.parts.values():
        for each in (*part.claims(settings), *part.goals(settings)):
            assert each.needs, each.words
            assert {need[0] for need in each.needs} <= names, each.words
    assert len(set(the.files)) == len(the.files)


@pytest.mark.parametrize("name", list(STUDIES))
def test_no_run_is_simulated_twice(name: str, tmp_path: Path) -> None:
    settings = Settings(tmp_path, 50)
    cells = [c for part in STUDIES[name]().parts.values() for c in part.cells(settings)]
    results = Results(settings, cells, cells)
    seeds: set[tuple[str, str, int]] = set()
    for cell in results.cells.values():
        for piece in dict.fromkeys(p for c in cell if c.kind is None for p in results._of(c)):
            for seed in range(piece.seed, piece.seed + piece.runs):
                run = (piece.name.rsplit("-", 1)[0], piece.variant.key, seed)
                seeds.add(run)
    whole = {p for cell in cells if cell.kind is None for p in results._of(cell)}
    assert len(seeds) == sum(piece.runs for piece in whole)


def test_trainings_are_units_of_work(tmp_path: Path) -> None:
    tiny = (("worlds", 2), ("epochs", 1), ("steps", 5), ("passes", 1), ("minibatches", 1),
            ("scenario", "indoor-v0:n_uavs=2:horizon=10"), ("score_runs", 0))  # fmt: skip
    one, bad = Training("a-0", "mappo", tiny), Training("b-0", "mappo", (("worlds", 0),))
    runs = [TrainingRun(each, each.folder(tmp_path)) for each in (one, bad)]
    first, second = study.pool.work(runs, ALONE, silent)
    assert first.error is None
    first.unit.keep(tmp_path, first.result)
    assert "worlds" in str(second.error)
    with pytest.raises(OSError, match="share"):
        second.unit.keep(tmp_path, None)
    assert one.done(tmp_path)
    assert not bad.done(tmp_path)
