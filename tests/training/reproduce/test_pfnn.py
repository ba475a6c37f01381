"""``coloc reproduce pfnn``: verdicts on made-up results, tables with both sides, the command."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner, Result

from coloc_env.bounds import Bound
from coloc_env.scenarios import make_scenario
from training.cli.command import app
from training.evaluation.record import RunRecord, Worlds
from training.evaluation.results import Evaluation
from training.reproduce.cost import Cost
from training.reproduce.pfnn import goals, paper, report, robustness, tables
from training.reproduce.pfnn.claims import verdicts
from training.reproduce.pfnn.flown import Flown
from training.reproduce.pfnn.in_flight import InFlight
from training.reproduce.pfnn.plan import TABLE_AGENTS, ablation_agents, default, variants
from training.reproduce.verdicts import CONTRADICTED, NOT, REPRODUCED, UNKNOWN, Verdict

RUNS, STEPS = 10, 150
PAPERS = {  # errors as the paper has them, in m: what would bear out its claims
    "pf500": 0.612,
    "pf800": 0.523,
    "apf": 0.481,
    "ekf": 0.687,
    "pfnn": 0.437,
} | {agent: 0.5 for agent in ablation_agents() if agent != "pfnn"}
SERIES = {"particles": 790.0, "ess_share": 0.45}


def made(size: Mapping[str, float], series: Mapping[str, float] = SERIES) -> Evaluation:
    """Agents whose errors have these sizes (m), alike but for 2 % from run to run; particle filters
    with these figures of their own."""
    rng = np.random.default_rng(0)
    scenario = make_scenario("indoor-v0", horizon=STEPS)
    shape = (RUNS, STEPS, 6)
    world = rng.uniform(0.8, 1.2, size=(RUNS, 1, 1)) * rng.uniform(0.5, 1.3, size=shape)
    scored = torch.ones(shape, dtype=torch.bool)
    worlds = Worlds(0, np.full((*shape, 3), 5.0), np.zeros((STEPS, 6, 4)), scored.numpy())
    agents = {}
    for name, scale in size.items():
        error = scale * world * (1 + 0.02 * rng.normal(size=(RUNS, 1, 1)))
        own = {} if name.startswith("ekf") else series
        agents[name] = RunRecord(
            worlds=worlds,
            offset=np.stack((error, 0 * error, 0 * error), -1).astype(np.float32),
            error=error.astype(np.float32),
            nees=np.full(shape, 3.0, np.float32),
            broken=np.zeros(RUNS, bool),
            series={key: np.full(shape, value, np.float32) for key, value in own.items()},
            ms_per_step=None,
        )
    bound = Bound(torch.full(shape, 0.034**2, dtype=torch.float64), scored, 0.1)
    return Evaluation(scenario, worlds, bound, agents)


def flown(size: Mapping[str, float] = PAPERS, series: Mapping[str, float] = SERIES) -> Flown:
    results = made(size, series)
    rng = np.random.default_rng(1)
    cost = {
        name: Cost(row.ms.mean + rng.normal(size=STEPS), 10**6, round(1e6 * row.memory))
        for name, row in paper.TABLE_5.items()
        if name in size
    }
    loss = 0.04 + 0.11 * np.exp(-np.arange(60) / 10) + 0.002 * rng.normal(size=(RUNS, 60))
    learning = None
    if "pfnn" in size:
        learning = InFlight(results.agents["pfnn"].error, np.full((RUNS, STEPS, 6), 700.0), loss)
    methods = {name: one for name, one in results.agents.items() if name in TABLE_AGENTS}
    return Flown(results, replace(results, agents=methods), cost, learning)


def about(judged: list[Verdict], *words: str) -> Verdict:
    """The verdict on the claim with these words."""
    (found,) = [v for v in judged if all(word in v.claim.words for word in words)]
    return found


@pytest.fixture(scope="module")
def as_printed() -> list[Verdict]:
    return verdicts(flown())


def test_the_papers_own_numbers_bear_out_its_comparisons(as_printed: list[Verdict]) -> None:
    for words in (
        ("PF-NN's RMSE is below that of Standard PF",),
        ("PF-NN's RMSE is below that of Adaptive PF", "PF-NN's RMSE"),
        ("PF-NN's RMSE is below that of EKF",),
        ("Fixed PF (N = 800)'s RMSE is below that of Standard PF",),
        ("PF-NN is the best",),
        ("[0.4, 1.0]", "lowest RMSE"),
        ("lowest RMSE of all particle filters",),
        ("near 800",),
        ("ESS ratio",),
        ("sub-metre",),
        ("Proposed PF-NN meets 100 ms",),
        ("Proposed PF-NN takes less time", "Fixed PF"),
        ("Standard PF (N = 500) takes less time",),
        ("PF-NN takes less memory",),
        ("below 0.05 after 50",),
        ("loss starts",),
    ):
        found = [v for v in as_printed if v.claim.words.find(words[0]) >= 0]
        found = [v for v in found if "learning in flight" not in v.claim.words]
        found = [v for v in found if all(word in v.claim.words for word in words)]
        assert [v.verdict for v in found] == [REPRODUCED], (words, found)


def test_its_table_contradicts_its_text(as_printed: list[Verdict]) -> None:
    """Table 5 has PF500, PF800 and APF below 100 ms, which its text says only EKF and PF-NN are."""
    for agent in ("Standard PF", "Fixed PF", "Adaptive PF"):
        found = about(as_printed, agent, "misses 100 ms")
        assert (found.verdict, found.reason) == (CONTRADICTED, "the opposite holds")


def test_what_was_not_flown_is_not_measured(as_printed: list[Verdict]) -> None:
    found = about(as_printed, "D-LSPF")
    assert (found.verdict, found.ours, found.reason) == (UNKNOWN, None, "not flown: dlspf")
    judged = verdicts(flown({"pf500": 0.6, "ekf": 0.7}))
    assert len(judged) == len(as_printed)
    kinds = {v.claim.words: v.verdict for v in judged}
    assert kinds.pop("Standard PF (N = 500)'s RMSE is below that of EKF Cooperative") == REPRODUCED
    assert kinds.pop("Standard PF (N = 500) misses 100 ms a step") == CONTRADICTED
    assert set(kinds.values()) == {UNKNOWN}


def test_no_effect_is_not_reproduced() -> None:
    judged = verdicts(flown(PAPERS | {"pfnn": 0.481} | dict.fromkeys(ablation_agents(), 0.481)))
    found = about(judged, "PF-NN's RMSE is below that of Adaptive PF (no NN)")
    assert found.ours is not None
    assert found.ours.low < 0 < found.ours.high
    assert (found.verdict, found.reason) == (NOT, "no detectable effect")
    assert about(judged, "[0.4, 1.0]", "RMSE").verdict == NOT


def test_the_opposite_contradicts() -> None:
    small = dict.fromkeys(PAPERS, 0.035) | {"ekf": 0.030, "pfnn:correction=0.2,1": 0.033}
    judged = verdicts(flown(small, {"particles": 300.0, "ess_share": 0.9}))
    for words in (
        "PF-NN's RMSE is below that of EKF",
        "PF-NN is the best",
        "[0.4, 1.0] gives the lowest RMSE",
        "near 800",
        "ESS ratio",
        "start above 2 m",
        "spikes above 2 m",
    ):
        assert about(judged, words).verdict == CONTRADICTED, words
    assert about(judged, "average particles").reason == "ours is lower"
    assert about(judged, "below 1 m after 10 s").verdict == REPRODUCED
    assert about(judged, "medians are below 0.2 m").verdict == REPRODUCED


def test_a_smaller_gain_is_told_as_such() -> None:
    judged = verdicts(flown(PAPERS | {"pf500": 1.1 * 0.437}))
    found = about(judged, "PF-NN's RMSE is below that of Standard PF")
    assert (found.verdict, found.reason) == (NOT, "same direction, but smaller")


def cells(table: tables.Table, name: str) -> dict[str, str]:
    """A table's line by its first cell."""
    header, lines = table
    assert all(len(line) == len(header) for line in lines)
    (line,) = [line for line in lines if line[0] == name and "flight" not in line[1]]
    return dict(zip(header, line, strict=True))


def test_tables_have_both_sides() -> None:
    run = flown(PAPERS | {"pfnn": 0.0351})
    four = cells(tables.table_4(run), "Proposed PF-NN")
    assert four["RMSE, paper"] == "0.437 ± 0.048"
    rmse = run.rmse("pfnn")
    assert four["RMSE, ours"] == f"{rmse.mean():.3g} ± {rmse.std(ddof=1):.3g}"
    assert (four["max, paper"], four["particles, paper"]) == ("6.91 ± 1.12", "720 ± 95")
    assert four["particles, ours"] == "790 ± 0"
    later = cells(tables.table_4(run), "DFGO")
    assert (later["RMSE, paper"], later["RMSE, ours"]) == ("0.398 ± 0.041", "–")
    assert cells(tables.table_4(run), "EKF Cooperative")["particles, paper"] == "N/A"
    assert cells(tables.table_4(run), "*posterior bound*")["RMSE, ours"].startswith("0.034")
    three = cells(tables.table_3(run), "UAV-4")
    assert (three["RMSE, paper"], three["max, paper"]) == ("0.535", "10.385")
    own = np.sqrt((run.error("pfnn")[:, :, 3].astype(float) ** 2).mean(1))
    assert three["RMSE, ours"].startswith(f"{own.mean():.3g} ±")
    average = cells(tables.table_3(run), "Average")
    assert (average["RMSE, paper"], average["mean, paper"]) == ("0.437", "0.189")
    _, lines = tables.table_5(run)
    line = next(line for line in lines if line[1] == "`pfnn`")
    assert line[2] == "63.4 ± 6.7"
    assert line[3].startswith("63.")
    assert (line[6], line[7], line[8]) == ("178", "1.000", "178.00")
    _, lines = tables.figure_2(run)
    assert [line[0] for line in lines] == [f"[{a}, {b}]" for a, b in paper.RANGES]
    assert next(line for line in lines if line[1] == "`pfnn`")[3] == "–"


def test_the_papers_numbers_are_consistent_with_what_it_says() -> None:
    for other, gain in paper.GAINS.items():
        ours, theirs = (paper.TABLE_4[x].rmse.mean for x in ("pfnn", other))
        assert 100 * (1 - ours / theirs) == pytest.approx(gain, abs=0.06)
    average = np.mean([row.rmse for name, row in paper.TABLE_3.items() if name != "Average"])
    assert average == pytest.approx(paper.TABLE_3["Average"].rmse, abs=0.002)


# ------------------------------------------------------------------ robustness


def hard(size: Mapping[str, float]) -> dict[str, robustness.Cell]:
    results = made(size)
    return {agent: robustness.Cell(results, agent) for agent in results.agents}


SIZES = {"apf": 0.08, "ekf:robust=huber": 0.05, "ekf:robust=gate": 0.04}
TRUST = {"pf_trust": 0.035, "pf_trust:weights=b": 0.06}


def outcome(found: robustness.Cells, agent: str, *words: str) -> goals.Outcome:
    judged = goals.outcomes(found, [*SIZES, *TRUST])
    (one,) = [o for o in judged if o.agent == agent and all(w in o.goal.words for w in words)
              and o.goal.variant == "few-nlos"]  # fmt: skip
    return one


def test_goals_are_judged_for_every_training_of_an_agent() -> None:
    found = {"few-nlos": hard(SIZES | TRUST)}
    good, bad = TRUST
    assert outcome(found, good, "RMSE ≤ 0.85 ×").verdict == goals.MET
    assert outcome(found, good, "typically ≤ 0.85").verdict == goals.MET
    assert outcome(found, bad, "typically ≤ 0.85").verdict == goals.MISSED
    assert outcome(found, good, "below", "interval").verdict == goals.MET
    assert outcome(found, good, "not worse").verdict == goals.MET
    assert outcome(found, bad, "RMSE ≤ 0.85 ×").verdict == goals.MISSED
    assert outcome(found, bad, "below", "interval").verdict == goals.MISSED
    assert outcome(found, bad, "not worse").verdict == goals.MISSED
    assert outcome(found, bad, "none lost").found == "0 of 10 runs"
    elsewhere = [o for o in goals.outcomes(found, list(TRUST)) if o.goal.variant != "few-nlos"]
    assert {o.verdict for o in elsewhere} == {goals.UNKNOWN}


def test_a_goal_without_its_rival_is_not_measured() -> None:
    found = {"few-nlos": hard({"pf_trust": 0.03})}
    one = outcome(found, "pf_trust", "RMSE ≤ 0.85 ×")
    assert (one.verdict, one.found) == (goals.UNKNOWN, "not flown: `ekf:robust=huber`")


def test_limits_of_one_figure() -> None:
    found = {"default": hard({"apf": 0.03, "pfnn": 0.05})}
    judged = {
        o.agent: o.verdict
        for o in goals.outcomes(found, ["apf", "pfnn"])
        if o.goal.figure == "rmse_after_10s" and o.goal.variant == "default"
    }
    assert judged == {"apf": goals.MET, "pfnn": goals.MISSED}


def test_robust_tables_and_figures(tmp_path: Path) -> None:
    few = [variant for variant in variants() if variant.key in ("default", "few-nlos")]
    found = {variant.key: hard(SIZES | TRUST) for variant in few}
    del found["default"]["apf"]
    agents = [*SIZES, *TRUST]
    bounds = {"default": 0.034, "few-nlos": None}
    text = "\n".join(report.robust_part(found, bounds, few, agents, tmp_path))
    names = ("robustness.csv", "robustness.json", "robustness.md", "robustness.png")
    assert {path.name for path in tmp_path.iterdir()} == {*names, "robustness_paired.png"}
    content = json.loads((tmp_path / "robustness.json").read_text())
    assert len(content["rows"]) == 9
    row = next(r for r in content["rows"] if r["agent"] == "pf_trust" and r["bound"] is None)
    cell = found["few-nlos"]["pf_trust"]
    other = found["few-nlos"]["ekf:robust=huber"]
    assert row["rmse"] == pytest.approx(cell.figures["rmse"])
    assert row["minus ekf:robust=huber"] == pytest.approx((cell.rmse - other.rmse).mean())
    assert row["minus ekf:robust=huber, low"] < row["minus ekf:robust=huber"] < 0
    assert "| 5 landmarks + NLOS | – |" in text
    assert f"**{cell.figures['rmse']:.3g}**" in text
    lines = (tmp_path / "robustness.csv").read_text().splitlines()
    assert len(lines) == 10
    assert lines[0].startswith("variant,title,agent,runs,bound,rmse,")


def test_variants_are_unlike_and_build() -> None:
    every = variants(steps=7)
    assert len({variant.key for variant in every}) == len(every)
    simulated = [variant for variant in every if variant.scenario == "indoor-v0"]
    assert len({variant.overrides for variant in simulated}) == len(simulated)
    for variant in simulated:
        assert variant.build().horizon == 7
    assert {goal.variant for goal in goals.goals()} <= {variant.key for variant in every}
    assert every[0] == default(7)


# ------------------------------------------------------------------ the command


def coloc(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["reproduce", "pfnn", *map(str, arguments)])


def test_the_paper_part(tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ("--out", out, "--part", "paper", "--runs", "2", "--steps", "12")
    done = coloc(*arguments, "--agents", "pf500,ekf")
    assert done.exit_code == 0, done.output
    assert f"written to {out}" in done.stdout
    assert "6/6 default/ekf-2+1" in done.stderr
    text = (out / "report.md").read_text()
    content = json.loads((out / "paper.json").read_text())
    assert "0.612 ± 0.089" in text
    assert content["agents"].keys() == {"pf500", "ekf"}
    assert content["cost"]["pf500"]["working_set_bytes"] > content["cost"]["ekf"]["belief_bytes"]
    claims = {claim["claim"]: claim for claim in content["claims"]}
    assert claims["PF-NN's RMSE"]["verdict"] == UNKNOWN
    assert [path.name for path in out.glob("*.png")] == ["figure_9_cdf.png"]
    assert "](figure_9_cdf.png)" in text
    again = coloc(*arguments, "--agents", "ekf,pf500")
    assert again.exit_code == 0
    assert again.stderr == ""  # nothing to fly
    fresh = coloc(*arguments, "--agents", "ekf", "--fresh")
    assert fresh.exit_code == 0
    assert "4/4" in fresh.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--agents", "ekff"], "did you mean 'ekf'"),
        (["--agents", "test_still", "--part", "paper"], "none of the paper's"),
        (["--runs", "0"], "--runs 0"),
        (["--jobs", "0"], "--jobs 0"),
        (["--steps", "0"], "--steps 0"),
        (["--seed", "-1"], "--seed -1"),
    ],
)
def test_one_clear_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    done = coloc("--out", tmp_path / "out", *arguments)
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []
