"""``coloc reproduce stdcl``: its plan, measures, verdicts on made-up runs, a small page."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made import Made, runs_of

from agents import make
from coloc_env.bounds import Bound, SnapshotBound
from coloc_env.scenarios import make_scenario
from training.evaluation.record import Worlds
from training.reproduce.cost import Cost
from training.reproduce.measures import rmse, rmse_of_bound
from training.reproduce.results import Results, Runs
from training.reproduce.settings import Settings
from training.reproduce.stdcl import claims, goals, links, loop_claims, plan, stdcl, tables
from training.reproduce.stdcl.links import Event, Links
from training.reproduce.stdcl.measures import (
    ate,
    better,
    drift,
    fge,
    nrmse,
    ratio_to,
    restless,
)
from training.reproduce.stdcl.plan import (
    LINKS,
    LOOP,
    METHODS,
    OPTIMIZER,
    PAPERS_LOOP,
    RIVALS,
    WHOLE,
    W,
)
from training.reproduce.study import reproduce
from training.reproduce.verdicts import (
    CONTRADICTED,
    MET,
    MISSED,
    NOT,
    REPRODUCED,
    UNKNOWN,
    Verdict,
    judge,
    judge_goals,
    paired,
)
from training.reproduce.work import SNAPSHOT, WORLD, Cell, Piece

RUNS, STEPS, N = 6, 120, 4
PARTS = (claims.paper, claims.stress, loop_claims.loop, claims.campus)


# ---------------------------------------------------------------- the plan


def cells(runs: int) -> list[Cell]:
    settings = Settings(Path("x"), runs)
    return [cell for part in stdcl().parts.values() for cell in part.cells(settings)]


def test_expensive_agents_run_in_the_first_worlds_of_the_others(tmp_path: Path) -> None:
    every = cells(50)
    results = Results(Settings(tmp_path, 50), every, every)
    counts = {a: results._count("v50", a) for a in (*METHODS, *plan.REFERENCES, *plan.LOOPS)}
    assert counts == dict.fromkeys(METHODS, 50) | dict.fromkeys((*plan.REFERENCES, *plan.LOOPS), 5)
    blocks = results._blocks(W.speed(50.0), WHOLE, 50)
    assert [(piece.seed, piece.runs) for piece in blocks] == [(0, 5), (5, 45)]
    bounds = [cell.runs for cell in results.cells["v50"] if cell.kind is SNAPSHOT]
    assert bounds == [5]


def test_every_swarm_can_be_built() -> None:
    sized = ("time-", "sixty-", "sdp-")  # have a size of their own
    for variant in {cell.variant for cell in cells(50)}:
        if variant.scenario == "swarm-v0" and not variant.key.startswith(sized):
            assert variant.build().arena.n_uavs == 200, variant.key
    for agent in (*METHODS, *plan.REFERENCES):
        if agent not in (WHOLE, PAPERS_LOOP, plan.LEARNED):
            make(agent, W.speed(50.0).build())


def test_few_runs_are_at_least_one() -> None:
    assert {cell.runs for cell in cells(1)} <= {1, 2}


# ---------------------------------------------------------------- runs


def runs(error: Any, steps: int = STEPS, noise: float = 0.02) -> Runs:
    """An agent's runs with errors of about ``error`` m, or with these [R, K]; the first UAV is an
    anchor."""
    rng = np.random.default_rng(0)
    if np.ndim(error) == 0:
        error = error * (1 + noise * rng.random((RUNS, steps)))
    error = np.repeat(np.asarray(error)[..., None], N, -1).astype(np.float32)
    offset = np.zeros((*error.shape, 3), np.float32)
    offset[..., 0] = error * np.where(np.arange(N) % 2, 1, -1)
    scored = np.ones(error.shape, bool)
    scored[..., 0] = False
    scenario = make_scenario("swarm-v0", n_uavs=N, horizon=error.shape[1])
    truth = np.zeros((*error.shape, 3)) + 1000.0 * np.arange(N)[:, None] * np.array([1.0, 0, 0])
    worlds = Worlds(0, truth, np.zeros((error.shape[1], N, 4)), scored)
    return runs_of(scenario, error, worlds=worlds, offset=offset)


def test_figures_of_a_run() -> None:
    error = np.full((2, 240), 2.0)
    error[0, 10:110], error[0, -100:] = 1.0, 3.0
    one = runs(error)
    assert rmse(one) == pytest.approx(np.sqrt((error**2).mean(1)))
    assert nrmse(one) == pytest.approx(rmse(one) / 5000.0)
    assert drift(one) == pytest.approx([3.0, 1.0])
    assert restless(one)[1] == pytest.approx(0.0, abs=1e-6)
    assert restless(one)[0] == pytest.approx(error[0, 10:].std(), rel=1e-5)
    assert ate(one) == pytest.approx(rmse(one))
    assert np.isnan(drift(runs(error[:, :150]))).all()


def test_formation_error_is_of_distances() -> None:
    # UAVs 1, 2, 3 are off by +2, −2, +2 m along the line they are on: distances by −4, +4 and 0.
    assert fge(runs(np.full((1, 5), 2.0))) == pytest.approx([np.sqrt(32 / 3)])


def test_a_bound_is_met_over_its_own_runs_where_it_is_finite() -> None:
    one = runs(np.full((3, 4), 6.0))
    mse = torch.full((2, 4, N), 9.0, dtype=torch.float64)
    scored = torch.ones(2, 4, N, dtype=torch.bool)
    assert ratio_to(one, Bound(mse, scored, 1.0)) == pytest.approx(2.0)
    mse[0] = torch.inf
    bound = SnapshotBound(mse, scored, 1.0)
    assert ratio_to(one, bound) == pytest.approx(2.0)
    assert rmse_of_bound(bound) == pytest.approx(3.0)
    assert np.isnan(ratio_to(one, None))


def test_pairs_are_of_the_worlds_that_both_met() -> None:
    many, few = runs(np.arange(1, 5)[:, None] * np.ones(6)), runs(np.full((2, 6), 3.0))
    assert [len(x) for x in paired(rmse(many), rmse(few))] == [2, 2]
    assert better(many, few).mean == pytest.approx(50.0)


@pytest.mark.parametrize("power", [1.0, 2.3])
def test_the_exponent_of_a_power_law(power: float) -> None:
    sizes = (20, 100, 200, 500)
    times = [9.0, *(1e-3 * n**power for n in sizes[1:])]  # small swarms cost what calls cost
    assert tables.exponent(sizes, times) == pytest.approx(power)
    assert np.isnan(tables.exponent((20, 100), (1.0, 2.0)))


# ---------------------------------------------------------------- links


def a_link() -> tuple[Links, Event]:
    """Three UAVs for 100 steps of 0.1 s; the link of 0 and 2 is NLOS in steps 60 to 80, and cut
    four steps later; UAV 1 is alone from step 90 on."""
    length = np.full((100, 3, 3), 10.0)
    measured = length + 0.1
    measured[60:81, 0, 2] = measured[60:81, 2, 0] = 13.0
    weight = np.ones((100, 3, 3))
    weight[64:81, 0, 2] = weight[64:81, 2, 0] = 0.1
    measured[90:, 1, :] = measured[90:, :, 1] = np.nan
    error = np.ones((100, 3))
    error[70, 2], error[70, 1] = 5.0, 9.0
    blocked = np.zeros((100, 3, 3), bool)
    blocked[60:81, 0, 2] = blocked[60:81, 2, 0] = True
    return Links(error, length, blocked, measured, weight, 0.1), Event(0, 2, 60, 80)


def test_the_event_of_a_link() -> None:
    record, event = a_link()
    assert record.event() == event
    assert record.fall(event) == pytest.approx(0.4)
    assert record.peak(event) == 5.0
    assert record.components.tolist() == 90 * [1] + 10 * [2]


def test_a_link_that_is_never_cut_off() -> None:
    record, event = a_link()
    whole = replace(record, weight=np.ones((100, 3, 3)))
    assert whole.fall(event) == np.inf


@pytest.mark.parametrize("why", ["in sight", "nothing measured", "between anchors", "no start"])
def test_what_is_no_event(why: str) -> None:
    record, _ = a_link()
    if why == "in sight":
        record = replace(record, blocked=np.zeros((100, 3, 3), bool))
    elif why == "nothing measured":
        record.range[60:81] = np.nan
    elif why == "between anchors":
        record.error[:, [0, 2]] = np.nan
    else:
        record.range[:60] = np.nan
    assert record.event() is None


def test_weights_are_those_of_the_step(tmp_path: Path) -> None:
    variant = plan.Worlds(12, 6).swarm("tiny", "tiny", uwb_dropout=0.3)
    piece = Piece(variant, (f"{OPTIMIZER}:confidence=none",), 3, 1, LINKS)
    seen: list[int] = []
    piece.keep(tmp_path, piece.run(seen.append))
    assert sum(seen) == piece.size
    one = links.load_links(variant, *piece.load(Results(Settings(tmp_path, 1), [], []).store))
    there = np.isfinite(one.range)
    assert 0 < there.mean() < 1
    # Without confidence a link weighs as much as its noise says; what either end measures counts.
    either = there | there.transpose(0, 2, 1)
    np.testing.assert_allclose(one.weight, either)
    off = (one.range - one.length)[there]
    assert np.abs(off).max() < 25 + 60
    assert one.error.shape == (6, 12)


def test_confidences_of_a_loop(tmp_path: Path) -> None:
    variant = plan.Worlds(12, 6).swarm("tiny", "tiny")
    arrays, _ = links.record_loop(Piece(variant, (WHOLE,), 3, 1, LOOP), lambda *_: None)
    loop = links.load_loop(variant, arrays, {})
    assert loop.change.shape == loop.mean.shape == (6,)
    assert 0 < loop.change.max() < 1
    assert ((loop.mean > 0) & (loop.mean <= 1)).all()


# ---------------------------------------------------------------- verdicts


def cost(ms: float) -> Cost:
    return Cost(ms * (1 + 0.01 * np.random.default_rng(0).random(30)), 0, 0)


def link_records() -> dict[Any, Links]:
    """By agent: a weight that falls at once, and larger errors without weights."""
    whole, _ = a_link()
    fast = whole.weight.copy()
    fast[60:81, 0, 2] = fast[60:81, 2, 0] = 0.1
    plain = replace(whole, error=3 * whole.error)
    of_plain = (f"{OPTIMIZER}:confidence=none", "links")
    return {(PAPERS_LOOP, "links"): replace(whole, weight=fast), of_plain: plain}


def as_the_paper_says() -> Made:
    """Methods as good as the paper has them."""
    none, papers = (f"{OPTIMIZER}:confidence={c}" for c in ("none", "paper"))
    usual: dict[Any, Any] = link_records() | {
        WHOLE: runs(30.0),
        PAPERS_LOOP: runs(30.0),
        "mds": runs(400.0, noise=1.0),
        "fcmds": runs(120.0, noise=1.0),
        "dwmds": runs(90.0, noise=1.0),
        "vmds": runs(60.0, noise=1.0),
        plan.LEARNED: runs(70.0, noise=1.0),
        OPTIMIZER: runs(40.0),
        plan.HUBER: runs(40.0),
        plan.OPEN: runs(38.0),
        plan.PAPERS_FEEDBACK: runs(36.0),
        plan.PAPERS_LEARNED: runs(30.5),
        plan.CLOSED_AFTERWARDS: runs(39.0),
        none: runs(100.0),
        papers: runs(40.0),
        (PAPERS_LOOP, "cost"): cost(36.0),
        ("dwmds", "cost"): cost(28.2),
        ("mds", "cost"): cost(94.0),
    }
    found: dict[Any, Any] = {}
    for i, metres in enumerate(plan.RADII):
        own = runs(60.0 - 5 * i)
        found[W.radius(metres).key, PAPERS_LOOP] = own
        if metres > 2500:
            found[W.radius(metres).key, "vmds"] = runs(1.05 * own.error[..., 0])
    mse = torch.full((2, STEPS, N), 38.0**2, dtype=torch.float64)
    bound = SnapshotBound(mse, torch.ones(2, STEPS, N, dtype=torch.bool), 1.0)
    found[W.radius(3500.0).key, "", SNAPSHOT.label] = bound
    sparse = W.sparse(plan.SPARSE[0]).key
    found |= {(sparse, agent): runs(500.0, noise=1.0) for agent in RIVALS}
    found[sparse, "mds"] = runs(1500.0, noise=1.0)
    for agent in ("dwmds", plan.LEARNED):
        found[W.share(0.5).key, agent] = runs(300.0, noise=1.0)
    for name in plan.FLIGHTS:
        key = W.flight(name).key
        worse = {"mds": 9.0, "dwmds": 3.01, "vmds": 2.45, plan.LEARNED: 3.5}
        found |= {(key, agent): runs(x) for agent, x in worse.items()}
        found[key, PAPERS_LOOP] = runs(0.45)
    found[W.long().key, WHOLE] = runs(30.0, steps=240)
    usual = {k if isinstance(k, tuple) else (k,): one for k, one in usual.items()}
    return Made(found, usual)


def judged_of(found: Made, parts: Any = PARTS) -> list[Verdict]:
    settings = Settings(Path("x"), 50)
    return judge((claim for part in parts for claim in part(settings)), found)


def test_the_papers_own_figures_bear_out_its_claims() -> None:
    judged = judged_of(as_the_paper_says())
    wrong = {x.claim.words: (x.verdict, x.ours) for x in judged if x.verdict != REPRODUCED}
    assert not wrong
    assert len(judged) > 45


def test_the_opposite_contradicts_them() -> None:
    turned: dict[Any, Any] = {(a,): runs(900.0, noise=1.0) for a in (WHOLE, PAPERS_LOOP)}
    turned |= {(agent,): runs(30.0) for agent in (*RIVALS, plan.LEARNED)}
    turned |= {(PAPERS_LOOP, "cost"): cost(300.0), (plan.PAPERS_FEEDBACK,): runs(41.0)}
    judged = judged_of(Made({}, as_the_paper_says().usual | turned), PARTS[:3])
    by = {x.claim.words: x.verdict for x in judged}
    best = [verdict for words, verdict in by.items() if "best" in words]
    assert len(best) > 5
    assert set(best) == {CONTRADICTED}
    assert by["v_max 50: average NRMSE"] == CONTRADICTED
    assert by["N = 200 within 10 Hz's 100 ms"] == CONTRADICTED
    words = "v_max 50 m/s: the feedback of equation 36 lowers the optimizer's error"
    assert by[words] == CONTRADICTED
    assert by["NRMSE falls as the radius grows, at every step"] == NOT


def test_what_was_not_run_is_not_judged() -> None:
    assert {each.verdict for each in judged_of(Made({}))} == {UNKNOWN}
    never, _ = a_link()
    never = replace(never, blocked=np.zeros_like(never.blocked))
    agents = (PAPERS_LOOP, f"{OPTIMIZER}:confidence=none")
    judged = judged_of(Made({}, {(agent, "links"): never for agent in agents}), [claims.campus])
    assert [v.reason for v in judged].count("no such link") == 2


def test_goals_are_met_by_the_mean() -> None:
    usual = {(WHOLE,): runs(2.0), (OPTIMIZER,): runs(2.0), (WORLD,): runs(3.0)}
    judged = judge_goals(goals.goals(Settings(Path("x"), 50)), Made({}, usual))
    found = {x.claim.words: x.verdict for x in judged}
    assert found["RMSE, NLOS 15 %"] == MET
    assert found["RMSE, NLOS 0 %"] == MISSED
    assert found["better than `dwmds_st`: NLOS 50 %"] == MET  # not worse
    assert found["better than `dwmds_st`: R = 1230 m"] == MISSED
    assert found["degree 2.5: of INS alone"] == MISSED
    assert found["N = 200: median time of `stdcl:variant=calibrated`"] == UNKNOWN


# ---------------------------------------------------------------- all of it at once


@pytest.mark.slow
def test_a_small_page(tmp_path: Path) -> None:
    variants, agents = ["v50", "nlos-0.5", "time-20"], ["mds", OPTIMIZER, WHOLE, plan.UNFED]
    small: dict[str, Any] = {"variants": variants, "agents": agents, "steps": 4}
    reproduce(stdcl(n_uavs=10), Settings(tmp_path, 2, **small))
    text = (tmp_path / "page.md").read_text()
    assert "| 50 | `dwmds_st` |" in text
    assert "| NLOS 50 %; bound" in text
    assert "| v_max 50 m/s | `dwmds_st` | DW-MDS alone |" in text
    assert "## Not run" not in text
    for name in ("figure_5_errors.png", "figure_6_nrmse.png", "figure_9_time.png",
                 "figure_10_nlos.png", "confidence.png", "ablation.png"):  # fmt: skip
        assert (tmp_path / name).exists(), name
    stored = sorted(file.stat().st_mtime for file in (tmp_path / "store").rglob("*.npz"))
    reproduce(stdcl(n_uavs=10), Settings(tmp_path, 2, report_only=True, **small))
    assert (tmp_path / "page.md").read_text() == text
    assert stored == sorted(file.stat().st_mtime for file in (tmp_path / "store").rglob("*.npz"))
