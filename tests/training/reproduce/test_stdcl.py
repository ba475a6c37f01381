"""``coloc reproduce stdcl``: its plan, figures of merit, verdicts on made-up runs, a report."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from agents import make
from agents.registry import LOCALIZERS
from coloc_env.bounds import Bound, SnapshotBound, posterior_bound, snapshot_bound
from coloc_env.scenarios import make_scenario
from training.cli.command import app
from training.evaluation.record import RunRecord, Worlds
from training.evaluation.results import Evaluation
from training.reproduce import pool
from training.reproduce.cost import Cost
from training.reproduce.stdcl import goals, links, plan, tables
from training.reproduce.stdcl.claims import verdicts
from training.reproduce.stdcl.flown import Flown
from training.reproduce.stdcl.links import Event, Watched
from training.reproduce.stdcl.measures import Runs, better, paired, told_by
from training.reproduce.stdcl.plan import METHODS, OPTIMIZER, RIVALS, WHOLE, Plan, merged
from training.reproduce.stdcl.run import NAMES, reproduce
from training.reproduce.store import Store
from training.reproduce.study import BOUNDS, WORLD, Study
from training.reproduce.verdicts import CONTRADICTED, NOT, REPRODUCED, UNKNOWN

RUNS, STEPS, N = 6, 120, 4
ALL = tuple(plan.PARTS)
THE = Plan(50)


def quiet(*_: Any) -> None:
    """Tells nobody."""


# ---------------------------------------------------------------- the plan


def scenes() -> list[plan.Scene]:
    return [scene for part in plan.PARTS for scene in THE.scenes(part)]


def test_a_variants_scenes_become_one() -> None:
    one = merged(scenes())["v50"]
    assert (one.runs, one.blocks, one.bounded) == (50, (5, 45), 5)
    assert set(METHODS) <= set(one.agents)
    assert {"map", *plan.ABLATION, plan.UNFED} - set(METHODS) <= set(one.few)
    assert not set(one.agents) & set(one.few)


def test_nobody_flies_the_same_world_twice(tmp_path: Path) -> None:
    study = Study(Store(tmp_path), 0)
    for scene in merged(scenes()).values():
        pieces = list(scene.pieces(study))
        for agent in {piece.agent for piece in pieces} - set(BOUNDS):
            seeds = [s for p in pieces if p.agent == agent for s in range(p.seed, p.seed + p.runs)]
            assert len(seeds) == len(set(seeds))


def test_a_key_is_one_variant() -> None:
    by_key: dict[str, plan.Variant] = {}
    for scene in scenes():
        assert by_key.setdefault(scene.variant.key, scene.variant) == scene.variant


def test_every_swarm_can_be_built() -> None:
    for key, scene in merged(scenes()).items():
        if scene.variant.scenario == "swarm-v0":
            built = scene.variant.build()
            assert built.arena.n_uavs == 200, key
    for agent in (*METHODS, *plan.REFERENCES):
        if agent.split(":")[0] in LOCALIZERS and agent not in (WHOLE, plan.LEARNED):
            make(agent, THE.speed(50.0).build())


def test_few_runs_are_at_least_one() -> None:
    one = merged(scene for part in plan.PARTS for scene in Plan(1).scenes(part))
    assert {scene.blocks for scene in one.values()} <= {(1,), (2,)}


# ---------------------------------------------------------------- runs


def flown(error: Any, agent: str = "x", steps: int = STEPS, noise: float = 0.02) -> Runs:
    """An agent's runs with errors of about ``error`` m, or with these [R, K]."""
    rng = np.random.default_rng(0)
    if np.ndim(error) == 0:
        error = error * (1 + noise * rng.random((RUNS, steps)))
    error = np.repeat(np.asarray(error)[..., None], N, -1).astype(np.float32)
    offset = np.zeros((*error.shape, 3), np.float32)
    offset[..., 0] = error * np.where(np.arange(N) % 2, 1, -1)
    scored = np.ones(error.shape, bool)
    scored[..., 0] = False  # an anchor
    scenario = make_scenario("swarm-v0", n_uavs=N, horizon=error.shape[1])
    truth = np.zeros((*error.shape, 3)) + 1000.0 * np.arange(N)[:, None] * np.array([1.0, 0, 0])
    worlds = Worlds(0, truth, truth[0], scored)
    nees, broken = np.full(error.shape, 3.0, np.float32), np.zeros(len(error), bool)
    one = RunRecord(worlds, offset, error, nees, broken)
    return Runs(Evaluation(scenario, worlds, None, {agent: one}), agent)


def test_figures_of_a_run() -> None:
    error = np.full((2, 240), 2.0)
    error[0, 10:110], error[0, -100:] = 1.0, 3.0
    one = flown(error)
    assert one.rmse == pytest.approx(np.sqrt((error**2).mean(1)))
    assert one.nrmse == pytest.approx(one.rmse / 5000.0)
    assert one.drift() == pytest.approx([3.0, 1.0])
    assert one.restless()[1] == pytest.approx(0.0, abs=1e-6)
    assert one.restless()[0] == pytest.approx(error[0, 10:].std(), rel=1e-5)
    assert one.ate == pytest.approx(one.rmse)
    assert np.isnan(flown(error[:, :150]).drift()).all()


def test_formation_error_is_of_distances() -> None:
    # UAVs 1, 2, 3 are off by +2, −2, +2 m along the line they are on: distances by −4, +4 and 0.
    assert flown(np.full((1, 5), 2.0)).fge == pytest.approx([np.sqrt(32 / 3)])


def test_a_bound_is_met_over_its_own_runs_where_it_is_finite() -> None:
    one = flown(np.full((3, 4), 6.0))
    mse = torch.full((2, 4, N), 9.0, dtype=torch.float64)
    scored = torch.ones(2, 4, N, dtype=torch.bool)
    assert one.ratio_to(Bound(mse, scored, 1.0)) == pytest.approx(2.0)
    mse[0] = torch.inf
    bound = SnapshotBound(mse, scored, 1.0)
    assert one.ratio_to(bound) == pytest.approx(2.0)
    assert told_by(bound) == pytest.approx(3.0)
    assert np.isnan(one.ratio_to(None))


def test_pairs_are_of_the_worlds_that_both_met() -> None:
    many, few = flown(np.arange(1, 5)[:, None] * np.ones(6)), flown(np.full((2, 6), 3.0))
    assert [len(x) for x in paired(many.rmse, few.rmse)] == [2, 2]
    assert better(many, few).mean == pytest.approx(50.0)


@pytest.mark.parametrize("power", [1.0, 2.3])
def test_the_exponent_of_a_power_law(power: float) -> None:
    sizes = (20, 100, 200, 500)
    times = [9.0, *(1e-3 * n**power for n in sizes[1:])]  # small swarms cost what calls cost
    assert tables.exponent(sizes, times) == pytest.approx(power)
    assert np.isnan(tables.exponent((20, 100), (1.0, 2.0)))


# ---------------------------------------------------------------- links


def watched_link() -> tuple[Watched, Event]:
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
    return Watched(error, length, blocked, measured, weight, 0.1), Event(0, 2, 60, 80)


def test_the_event_of_a_link() -> None:
    watched, event = watched_link()
    assert watched.event() == event
    assert watched.fall(event) == pytest.approx(0.4)
    assert watched.peak(event) == 5.0
    assert watched.components.tolist() == 90 * [1] + 10 * [2]


def test_a_link_that_is_never_cut_off() -> None:
    watched, event = watched_link()
    whole = replace(watched, weight=np.ones((100, 3, 3)))
    assert whole.fall(event) == np.inf


@pytest.mark.parametrize("why", ["in sight", "nothing measured", "between anchors", "no start"])
def test_what_is_no_event(why: str) -> None:
    watched, _ = watched_link()
    if why == "in sight":
        watched = replace(watched, blocked=np.zeros((100, 3, 3), bool))
    elif why == "nothing measured":
        watched.range[60:81] = np.nan
    elif why == "between anchors":
        watched.error[:, [0, 2]] = np.nan
    else:
        watched.range[:60] = np.nan
    assert watched.event() is None


def test_weights_are_those_of_the_step(tmp_path: Path) -> None:
    variant = Plan(1, 6, 12).swarm("tiny", "tiny", uwb_dropout=0.3)
    store = Store(tmp_path)
    one = links.watched(store, variant, f"{OPTIMIZER}:confidence=none", 3, quiet, True)
    assert one is not None
    there = np.isfinite(one.range)
    assert 0 < there.mean() < 1
    # Without confidence a link weighs as much as its noise says; what either end measures counts.
    either = there | there.transpose(0, 2, 1)
    np.testing.assert_allclose(one.weight, either)
    off = (one.range - one.length)[there]
    assert np.abs(off).max() < 25 + 60
    assert (
        links.watched(store, variant, f"{OPTIMIZER}:confidence=none", 3, quiet, False) is not None
    )
    assert links.watched(store, variant, f"{OPTIMIZER}:confidence=none", 4, quiet, False) is None


# ---------------------------------------------------------------- verdicts


class Told(Flown):
    """What is said to have been flown, by default by variant and agent."""

    def __init__(self, told: dict[tuple[str, str], Any], default: dict[str, Any]) -> None:
        whole, _ = watched_link()
        fast = whole.weight.copy()
        fast[60:81, 0, 2] = fast[60:81, 2, 0] = 0.1
        quick, poor = replace(whole, weight=fast), replace(whole, error=3 * whole.error)
        both = {WHOLE: quick, f"{OPTIMIZER}:confidence=none": poor}
        super().__init__(None, {}, {}, both, None, None)  # type: ignore[arg-type]
        object.__setattr__(self, "told", told)
        object.__setattr__(self, "default", default)

    def find(self, key: str, what: str) -> Any:
        return self.told.get((key, what), self.default.get(what))  # type: ignore[attr-defined]


def cost(ms: float) -> Cost:
    return Cost(ms * (1 + 0.01 * np.random.default_rng(0).random(30)), 0, 0)


def as_the_paper_says() -> Told:
    """Methods as good as the paper tells."""
    none, papers = (f"{OPTIMIZER}:confidence={c}" for c in ("none", "paper"))
    default: dict[str, Any] = {
        WHOLE: flown(30.0),
        "mds": flown(400.0, noise=1.0),
        "fcmds": flown(120.0, noise=1.0),
        "dwmds": flown(90.0, noise=1.0),
        "vmds": flown(60.0, noise=1.0),
        plan.LEARNED: flown(70.0, noise=1.0),
        OPTIMIZER: flown(40.0),
        plan.HUBER: flown(40.0),
        plan.OPEN: flown(38.0),
        plan.UNFED: flown(40.0),
        plan.PAPERS_FEEDBACK: flown(30.0),
        plan.CLOSED_AFTERWARDS: flown(39.0),
        none: flown(100.0),
        papers: flown(40.0),
        f"ms:{WHOLE}": cost(36.0),
        "ms:dwmds": cost(28.2),
        "ms:mds": cost(94.0),
    }
    told: dict[tuple[str, str], Any] = {}
    for i, metres in enumerate(plan.RADII):
        own = flown(60.0 - 5 * i)
        told[THE.radius(metres).key, WHOLE] = own
        if metres > 2500:
            told[THE.radius(metres).key, "vmds"] = flown(1.05 * own.error[..., 0])
    mse = torch.full((2, STEPS, N), 38.0**2, dtype=torch.float64)
    bound = SnapshotBound(mse, torch.ones(2, STEPS, N, dtype=torch.bool), 1.0)
    told[THE.radius(3500.0).key, plan.SNAPSHOT] = bound
    sparse = THE.sparse(plan.SPARSE[0]).key
    told |= {(sparse, agent): flown(500.0, noise=1.0) for agent in RIVALS}
    told[sparse, "mds"] = flown(1500.0, noise=1.0)
    for agent in ("dwmds", plan.LEARNED):
        told[THE.share(0.5).key, agent] = flown(300.0, noise=1.0)
    for name in plan.FLIGHTS:
        key = THE.flight(name).key
        worse = {"mds": 9.0, "dwmds": 3.01, "vmds": 2.45, plan.LEARNED: 3.5}
        told |= {(key, agent): flown(x) for agent, x in worse.items()}
        told[key, WHOLE] = flown(0.45)
    told[THE.long().key, WHOLE] = flown(30.0, steps=240)
    return Told(told, default)


def test_the_papers_own_figures_bear_out_its_claims() -> None:
    judged = verdicts(as_the_paper_says(), THE, ALL)
    wrong = {x.claim.words: (x.verdict, x.ours) for x in judged if x.verdict != REPRODUCED}
    assert not wrong
    assert len(judged) > 45


def test_the_opposite_contradicts_them() -> None:
    papers = as_the_paper_says()
    turned = {WHOLE: flown(900.0, noise=1.0), plan.PAPERS_FEEDBACK: flown(41.0)}
    turned |= {agent: flown(30.0) for agent in (*RIVALS, plan.LEARNED)}
    turned[f"ms:{WHOLE}"] = cost(300.0)
    judged = verdicts(Told({}, papers.default | turned), THE, ("paper", "stress", "learned"))  # type: ignore[attr-defined]
    by = {x.claim.words: x.verdict for x in judged}
    best = [verdict for words, verdict in by.items() if "best" in words]
    assert len(best) > 5
    assert set(best) == {CONTRADICTED}
    assert by["v_max 50: average NRMSE"] == CONTRADICTED
    assert by["N = 200 within 10 Hz's 100 ms"] == CONTRADICTED
    assert by["v_max 50 m/s: the paper's feedback lowers the error"] == CONTRADICTED
    assert by["NRMSE falls as the radius grows, at every step"] == NOT


def test_what_was_not_flown_is_not_judged() -> None:
    judged = verdicts(Told({}, {}), THE, ("paper", "stress", "learned", "real"))
    assert {each.verdict for each in judged} == {UNKNOWN}


def test_goals_are_met_by_the_mean() -> None:
    told = Told({}, {WHOLE: flown(2.0), OPTIMIZER: flown(2.0), WORLD: flown(3.0)})
    keys = {key for goal in goals.goals(THE) for key, _ in goal.needs}
    object.__setattr__(told, "scenes", dict.fromkeys(keys))
    found = {x.goal.words: x.verdict for x in goals.outcomes(told, THE)}
    assert found["RMSE, NLOS 15 %"] == goals.MET
    assert found["RMSE, NLOS 0 %"] == goals.MISSED
    assert found["better than `dwmds_st`: NLOS 50 %"] == goals.MET  # not worse
    assert found["better than `dwmds_st`: R = 1230 m"] == goals.MISSED
    assert found["degree 2.5: of INS alone"] == goals.MISSED
    assert found["N = 200: median time of `stdcl`"] == goals.UNKNOWN


# ---------------------------------------------------------------- bounds, and all of it at once


def test_bounds_are_pieces_of_a_study(tmp_path: Path) -> None:
    study, variant = Study(Store(tmp_path), 2), Plan(1, 3, 8).swarm("tiny", "tiny")
    pieces = [p for what in (WORLD, *BOUNDS) for p in study.pieces(variant, what, 2)]
    pool.fly(study, pieces, 1, quiet, quiet)
    assert study.results(variant, [WORLD], 2).bound is None
    for which, computed in (
        ("posterior_bound", posterior_bound),
        ("snapshot_bound", snapshot_bound),
    ):
        known, expected = study.bound(variant, which, 2), computed(variant.build(), 2, 2)
        assert known is not None
        assert type(known) is type(expected)
        torch.testing.assert_close(known.mse, expected.mse)
        assert torch.equal(known.scored, expected.scored)


SMALL: dict[str, Any] = {"runs": 2, "seed": 0, "steps": 6, "jobs": 1, "n_uavs": 14}


def test_a_small_report(tmp_path: Path) -> None:
    where = ["v50", "nlos-0.5", "time-20"]
    reproduce(tmp_path, "all", where=where, missing=True, tell=quiet, note=quiet, **SMALL)
    text = (tmp_path / "report.md").read_text()
    assert "| 50 | `dwmds_st` |" in text
    assert "| NLOS 50 %; bound" in text
    assert "| v_max 50 m/s | `dwmds_st` | DW-MDS alone |" in text
    assert "## Not flown" not in text
    for name in ("figure_5_errors.png", "figure_6_nrmse.png", "figure_9_time.png",
                 "figure_10_nlos.png", "confidence.png", "ablation.png", "stdcl.json"):  # fmt: skip
        assert (tmp_path / name).exists(), name
        assert name in NAMES
    stored = sorted(file.stat().st_mtime for file in (tmp_path / "store").rglob("*.npz"))
    reproduce(tmp_path, "all", where=where, missing=False, tell=quiet, note=quiet, **SMALL)
    assert (tmp_path / "report.md").read_text() == text
    assert stored == sorted(file.stat().st_mtime for file in (tmp_path / "store").rglob("*.npz"))


def test_nothing_stored_nothing_told(tmp_path: Path) -> None:
    reproduce(tmp_path, "stress", where=None, missing=False, tell=quiet, note=quiet, **SMALL)
    text = (tmp_path / "report.md").read_text()
    assert " 0 reproduced, 0 not reproduced, 0 contradicted" in text
    assert not list(tmp_path.glob("*.png"))


def test_unknown_variants_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown variant 'v7'"):
        reproduce(tmp_path, "paper", 2, 0, ["v7"], 6, 1, True, quiet, quiet)


# ---------------------------------------------------------------- the command


def coloc(*arguments: str | Path) -> Any:
    return CliRunner().invoke(app, ["reproduce", *map(str, arguments)])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("stdcl", "--part", "robustness"), "stdcl has no part 'robustness': paper, stress"),
        (("pfnn", "--part", "campus"), "pfnn has no part 'campus': paper, robustness, all are"),
        (("stdcl", "--agents", "map"), "stdcl takes no --agents"),
    ],
)
def test_what_a_paper_does_not_have(arguments: tuple[str, ...], words: str, tmp_path: Path) -> None:
    done = coloc(*arguments, "--out", tmp_path / "x")
    assert done.exit_code != 0
    assert words in str(done.exception) + done.output
    assert not (tmp_path / "x").exists()


def test_a_report_of_nothing_from_the_command_line(tmp_path: Path) -> None:
    done = coloc("stdcl", "--part", "real", "--report-only", "--steps", 5, "--out", tmp_path)
    assert done.exit_code == 0, done.output
    assert "## Recordings" in (tmp_path / "report.md").read_text()
