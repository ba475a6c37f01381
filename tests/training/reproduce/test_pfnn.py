"""``coloc reproduce pfnn``: verdicts on made-up results, tables with both sides, the command."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made import Made, runs_of
from typer.testing import CliRunner, Result

from agents import make
from coloc_env.bounds import Bound
from coloc_env.scenarios import make_scenario, parse_scenario
from training.cli.command import app
from training.evaluation.record import Worlds
from training.evaluation.rollout import rollout
from training.reproduce.cost import Cost
from training.reproduce.measures import rmse
from training.reproduce.pfnn import oracle, paper, plan, regimes, rivals, robustness, tables
from training.reproduce.pfnn.claims import claims
from training.reproduce.pfnn.plan import ABLATION, ONLINE, PRINTED, TABLE_AGENTS, Online
from training.reproduce.results import Runs
from training.reproduce.settings import Settings
from training.reproduce.tables import Table
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
)
from training.reproduce.work import WORLD, Piece

RUNS, STEPS = 10, 150
PAPERS = {  # errors as the paper has them, in m: what would bear out its claims
    "pf500": 0.612,
    "pf800": 0.523,
    "apf": 0.481,
    "ekf": 0.687,
    "dfgo": 0.398,
    "dlspf": 0.456,
    "pfnn": 0.437,
} | {agent: 0.5 for agent in ABLATION if agent != "pfnn"}
SERIES = {"particles": 790.0, "ess_share": 0.45, "renewed": 0.028}


SETTINGS = Settings(Path("x"), RUNS)


def made(size: Mapping[str, float], series: Mapping[str, float] = SERIES) -> dict[str, Runs]:
    """Agents whose errors have these sizes (m), alike but for 2 % from run to run; particle filters
    with these series of their own."""
    rng = np.random.default_rng(0)
    scenario, shape = make_scenario("indoor-v0", horizon=STEPS), (RUNS, STEPS, 6)
    world = rng.uniform(0.8, 1.2, size=(RUNS, 1, 1)) * rng.uniform(0.5, 1.3, size=shape)
    scored = torch.ones(shape, dtype=torch.bool)
    worlds = Worlds(0, np.full((*shape, 3), 5.0), np.zeros((STEPS, 6, 4)), scored.numpy())
    bound = Bound(torch.full(shape, 0.034**2, dtype=torch.float64), scored, 0.1)
    found = {}
    for name, scale in size.items():
        error = scale * world * (1 + 0.02 * rng.normal(size=(RUNS, 1, 1)))
        own = {} if name.startswith("ekf") else {k: np.full(shape, v) for k, v in series.items()}
        found[name] = runs_of(scenario, error, name, own, bound, worlds=worlds)
    return found


class Study(Made):
    """Results of all cells alike."""

    settings = SETTINGS

    def runs(self, name: str, agents: Any = None) -> dict[str, Runs]:
        every = [key[0] for key in self.usual if len(key) == 1] if agents is None else agents
        there = {agent: self.get(name, agent) for agent in every}
        return {agent: one for agent, one in there.items() if one is not None}

    def __getitem__(self, what: tuple[str, str]) -> Any:
        return self.get(*what)


def printed(agent: str) -> str:
    """The same agent as printed, where there is one."""
    name, *options = agent.split(":")
    return ":".join((PRINTED.get(name, name), *options))


def study(size: Mapping[str, float] = PAPERS, series: Mapping[str, float] = SERIES) -> Study:
    """Methods alike as printed and as ours."""
    there = made(size, series)
    there |= {printed(agent): one for agent, one in there.items()}
    rng = np.random.default_rng(1)
    usual: dict[Any, Any] = {(name,): one for name, one in there.items()}
    usual |= {
        (agent, "cost"): Cost(row.ms.mean + rng.normal(size=STEPS), 10**6, round(1e6 * row.memory))
        for name, row in paper.TABLE_5.items()
        for agent in {name, printed(name)} & there.keys()
    }
    loss = 0.04 + 0.11 * np.exp(-np.arange(60) / 10) + 0.002 * rng.normal(size=(RUNS, 60))
    if "pfnn" in size:
        count = np.full((RUNS, STEPS, 6), 700.0)
        for agent in ("pfnn", PRINTED["pfnn"]):
            usual[agent, ONLINE.label] = Online(there[agent].error, count, loss)
    usual[WORLD,] = next(iter(there.values()))
    return Study({}, usual)


def judged_of(size: Mapping[str, float] = PAPERS, series: Any = SERIES) -> list[Verdict]:
    return judge(claims(SETTINGS), study(size, series))


def about(judged: list[Verdict], *words: str) -> Verdict:
    """The verdict on the claim with these words."""
    (found,) = [v for v in judged if all(word in v.claim.words for word in words)]
    return found


@pytest.fixture(scope="module")
def as_printed() -> list[Verdict]:
    return judged_of()


def test_the_papers_own_numbers_bear_out_its_comparisons(as_printed: list[Verdict]) -> None:
    for words in (
        ("PF-NN's RMSE is below that of Standard PF",),
        ("PF-NN's RMSE is below that of Adaptive PF", "PF-NN's RMSE"),
        ("PF-NN's RMSE is below that of EKF",),
        ("PF-NN's RMSE is below that of D-LSPF",),
        ("DFGO's RMSE is below that of Proposed PF-NN",),
        ("Proposed PF-NN takes less time", "D-LSPF"),
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


def test_what_was_not_run_is_not_measured(as_printed: list[Verdict]) -> None:
    few = judged_of({agent: size for agent, size in PAPERS.items() if agent != "dlspf"})
    found = about(few, "PF-NN's RMSE", "D-LSPF")
    assert (found.verdict, found.ours, found.reason) == (UNKNOWN, None, "not run: dlspf in default")
    judged = judged_of({"pf500": 0.6, "ekf": 0.7})
    assert len(judged) == len(as_printed)
    kinds = {v.claim.words: v.verdict for v in judged}
    assert kinds.pop("Standard PF (N = 500)'s RMSE is below that of EKF Cooperative") == REPRODUCED
    assert kinds.pop("Standard PF (N = 500) misses 100 ms a step") == CONTRADICTED
    assert set(kinds.values()) == {UNKNOWN}


def test_no_effect_is_not_reproduced() -> None:
    judged = judged_of(PAPERS | {"pfnn": 0.481} | dict.fromkeys(ABLATION, 0.481))
    found = about(judged, "PF-NN's RMSE is below that of Adaptive PF (no NN)")
    assert found.ours is not None
    assert found.ours.low < 0 < found.ours.high
    assert (found.verdict, found.reason) == (NOT, "no detectable effect")
    assert about(judged, "[0.4, 1.0]", "RMSE").verdict == NOT


def test_the_opposite_contradicts() -> None:
    small = dict.fromkeys(PAPERS, 0.035) | {"ekf": 0.030, "pfnn:correction=0.2,1": 0.033}
    judged = judged_of(small, {"particles": 300.0, "ess_share": 0.9})
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


def test_a_smaller_gain_is_called_so() -> None:
    judged = judged_of(PAPERS | {"pf500": 1.1 * 0.437})
    found = about(judged, "PF-NN's RMSE is below that of Standard PF")
    assert (found.verdict, found.reason) == (NOT, "same direction, but smaller")


def cells(table: Table, name: str) -> dict[str, str]:
    """A table's line by its first cell."""
    header, lines = table.header, table.rows
    assert all(len(line) == len(header) for line in lines)
    (line,) = [line for line in lines if line[0] == name and "," not in line[1]]
    return dict(zip(header, line, strict=True))


def test_tables_have_both_sides() -> None:
    run: Any = study(PAPERS | {"pfnn": 0.0351})
    four = cells(tables._table_4(run), "Proposed PF-NN")
    assert four["RMSE, paper"] == "0.437 ± 0.048"
    errors = rmse(run.get("default", "pfnn"))
    assert four["RMSE, ours"] == f"{errors.mean():.3g} ± {errors.std(ddof=1):.3g}"
    assert (four["max, paper"], four["particles, paper"]) == ("6.91 ± 1.12", "720 ± 95")
    assert four["particles, ours"] == "790 ± 0"
    absent: Any = study({"pfnn": 0.0351})
    later = cells(tables._table_4(absent), "DFGO")
    assert (later["RMSE, paper"], later["RMSE, ours"]) == ("0.398 ± 0.041", "–")
    assert four["redrawn (%)"] == "2.8"
    as_printed = cells(tables._table_4(run), "Proposed PF-NN, as printed")
    for column in ("RMSE, paper", "RMSE, ours"):
        assert as_printed[column] == four[column]
    assert cells(tables._table_4(run), "EKF Cooperative")["particles, paper"] == "N/A"
    assert cells(tables._table_4(run), "*posterior bound*")["RMSE, ours"].startswith("0.034")
    three = cells(tables._table_3(run), "UAV-4")
    assert (three["RMSE, paper"], three["max, paper"]) == ("0.535", "10.385")
    own = np.sqrt((run.get("default", "pfnn").error[:, :, 3].astype(float) ** 2).mean(1))
    assert three["RMSE, ours"].startswith(f"{own.mean():.3g} ±")
    average = cells(tables._table_3(run), "Average")
    assert (average["RMSE, paper"], average["mean, paper"]) == ("0.437", "0.189")
    lines = tables._table_5(run).rows
    line = next(line for line in lines if line[1] == "`pfnn`")
    assert line[2] == "63.4 ± 6.7"
    assert line[3].startswith("63.")
    assert (line[6], line[7], line[8]) == ("178", "1.000", "178.00")
    lines = tables._figure_2(run).rows
    assert [line[0] for line in lines] == 2 * [f"[{a}, {b}]" for a, b in paper.RANGES]
    assert next(line for line in lines if line[1] == "`pfnn`")[3] == "–"


def test_claims_are_judged_by_the_filters_as_printed() -> None:
    found = study()
    for agent in PRINTED:
        found.usual[printed(agent),] = found.usual["pf500",]
    judged = judge(claims(SETTINGS), found)
    assert about(judged, "PF-NN's RMSE is below that of EKF").verdict == NOT
    assert about(judged, "PF-NN's RMSE is below that of Standard PF").verdict == NOT


def test_the_oracle_is_the_filter_with_another_correction() -> None:
    """And the corrector that knows the truth is not worse than one that says nothing of use."""
    where = plan.variants(steps=6)[0]
    found, _ = oracle.compute(Piece(where, ("pfnn",), 0, 2, plan.ORACLE), lambda *_: None)
    assert found["error"].shape == found["count"].shape == (2, 6, 6)
    same, _ = oracle.compute(
        Piece(where, ("pfnn:correction=1,1",), 0, 2, plan.ORACLE), lambda *_: None
    )
    scenario = where.build()
    plain = [
        (step.estimate.position.double() - step.world.truth.position).norm(dim=-1)
        for step in rollout(make("apf", scenario), scenario, torch.arange(2))
        if step.estimate is not None
    ]
    np.testing.assert_allclose(same["error"], torch.stack(plain, 1).numpy(), atol=1e-6)
    assert not np.allclose(found["error"], same["error"], atol=1e-6)


def test_the_papers_numbers_are_consistent_with_what_it_says() -> None:
    for other, gain in paper.GAINS.items():
        ours, theirs = (paper.TABLE_4[x].rmse.mean for x in ("pfnn", other))
        assert 100 * (1 - ours / theirs) == pytest.approx(gain, abs=0.06)
    average = np.mean([row.rmse for name, row in paper.TABLE_3.items() if name != "Average"])
    assert average == pytest.approx(paper.TABLE_3["Average"].rmse, abs=0.002)


# ------------------------------------------------------------------ robustness

SIZES = {"apf": 0.08, "ekf:robust=huber": 0.05, "ekf:robust=gate": 0.04}
TRUST = {"pf_trust": 0.035, "pf_trust:weights=b": 0.06}


def goals(found: dict[str, Runs], agents: tuple[str, ...], where: str) -> dict[str, Verdict]:
    """Verdicts by the goals' words, of one variant."""
    there = Made({(where, agent): one for agent, one in found.items()})
    settings = Settings(Path("x"), RUNS, agents=agents)
    every = [g for g in robustness.goals(settings) if g.needs[0][0] == where]
    return {v.claim.words: v for v in judge_goals(every, there)}


def test_goals_are_judged_for_every_training_of_an_agent() -> None:
    judged = goals(made(SIZES | TRUST), (*SIZES, *TRUST), "few-nlos")
    huber, gate = "`ekf:robust=huber`", "`ekf:robust=gate`"
    expected = {
        f"RMSE as a multiple of that of {huber}": (MET, MISSED),
        f"typical ratio, interval and all, to {huber}": (MET, MISSED),
        f"RMSE below that, interval and all, of {huber}": (MET, MISSED),
        f"RMSE not worse than that of {gate}": (MET, MISSED),
        "no run lost": (MET, MET),
    }
    for words, verdicts in expected.items():
        found = [judged[f"`{agent}`, 5 landmarks + NLOS: {words}"].verdict for agent in TRUST]
        assert tuple(found) == verdicts, words
    assert len(judged) == 2 * len(expected)


def test_a_goal_without_its_rival_is_not_measured() -> None:
    judged = goals(made({"pf_trust": 0.03}), ("pf_trust",), "few-nlos")
    one = judged["`pf_trust`, 5 landmarks + NLOS: RMSE as a multiple of that of `ekf:robust=huber`"]
    assert (one.verdict, one.reason) == (UNKNOWN, "not run: ekf:robust=huber in few-nlos")


def test_limits_of_one_figure() -> None:
    judged = goals(made({"apf": 0.03, "pfnn": 0.05}), ("apf", "pfnn"), "default")
    assert judged["`apf`, default: steady RMSE"].verdict == MET
    assert judged["`pfnn`, default: steady RMSE"].verdict == MISSED


def test_robust_tables_and_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    found = study(SIZES | TRUST)
    found.settings = Settings(Path("x"), RUNS, agents=(*SIZES, *TRUST))
    few = [v for v in plan.variants() if v.key in ("default", "few-nlos")]
    monkeypatch.setattr(robustness, "variants", lambda: few)
    *matrices, whole = robustness.tables(found)  # type: ignore[arg-type]
    assert [len(table.rows) for table in matrices] == [2] * 5
    one, other = found["few-nlos", "pf_trust"], found["few-nlos", "ekf:robust=huber"]
    error = one.summary["rmse"]
    assert f"**{error:.3g}**" in matrices[0].rows[1]
    assert matrices[0].rows[1][:2] == ["5 landmarks + NLOS", "0.034"]
    assert len(whole.rows) == 10
    row = dict(zip(whole.header, whole.rows[8], strict=True))
    assert (row["agent"], row["RMSE (m)"], row["runs"]) == ("`pf_trust`", f"{error:.3g}", "10")
    mean = (rmse(one) - rmse(other)).mean()
    assert row["minus `ekf:robust=huber` (95 %)"].startswith(f"−{-mean:.2g} (")
    assert robustness.heat_map(found) is not None  # type: ignore[arg-type]
    assert robustness.forest(found) is not None  # type: ignore[arg-type]


def test_variants_are_unlike_and_build() -> None:
    every = plan.variants(steps=7)
    assert len({variant.key for variant in every}) == len(every)
    simulated = [variant for variant in every if variant.scenario == "indoor-v0"]
    assert len({variant.overrides for variant in simulated}) == len(simulated)
    for variant in simulated:
        assert variant.build().horizon == 7
    runs = {cell.variant.key: cell.runs for cell in plan.robustness(Settings(Path("x"), 20))}
    assert (runs["hard"], runs["helix"], runs["mrclam"]) == (20, 10, 5)


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
    text = (out / "page.md").read_text()
    content = json.loads((out / "results.json").read_text())
    assert "0.612 ± 0.089" in text
    assert content["figures"]["default"]["agents"].keys() == {WORLD, "pf500", "ekf"}
    costs = content["costs"]["default"]
    assert costs["pf500"]["working_set_bytes"] > costs["ekf"]["belief_bytes"]
    verdicts = {claim["claim"]: claim["verdict"] for claim in content["claims"]}
    assert verdicts["PF-NN's RMSE"] == UNKNOWN
    assert [path.name for path in out.glob("*.png")] == ["figure_9_cdf.png"]
    assert "](figure_9_cdf.png)" in text
    again = coloc(*arguments, "--agents", "ekf,pf500", "--report-only")
    assert again.exit_code == 0
    page = tmp_path / "docs" / "pfnn.md"
    page.parent.mkdir()
    done = coloc("--out", out, "--page", page)
    assert done.exit_code == 0, done.output
    assert "](../out/figure_9_cdf.png)" in page.read_text()
    assert page.read_text().replace("../out/", "") == (out / "page.md").read_text()


def test_figures_2_to_8(monkeypatch: pytest.MonkeyPatch) -> None:
    from training.reproduce.pfnn.figures import FIGURES

    found: Any = study({a: PAPERS[a] for a in (*TABLE_AGENTS, *ABLATION) if a in PAPERS})
    assert [name for name, drawing in FIGURES.items() if drawing(found) is None] == []
    assert {name for name, drawing in FIGURES.items() if drawing(Study({})) is None} == set(FIGURES)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--agents", "ekff"], "did you mean 'ekf'"),
        (["--agents", "test_still", "--part", "paper"], "is not in this study: pf500, pf800"),
        (["--runs", "0"], "--runs 0"),
        (["--jobs", "0"], "--jobs 0"),
        (["--seed", "-1"], "--seed -1"),
        (
            ["--part", "campus"],
            "pfnn has no part 'campus': paper, robustness, rivals, regimes, corrector, all are",
        ),
        (["--report-only"], "holds nothing yet: run without --report-only first"),
        (["--page", "x.md"], "results.json does not exist: run the study first"),
    ],
)
def test_one_clear_line(arguments: list[str], words: str, tmp_path: Path) -> None:
    done = coloc("--out", tmp_path / "out", *arguments)
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_unknown_studies_are_named(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["reproduce", "pfn", "--out", str(tmp_path)])
    assert (done.exit_code, done.stdout) == (2, "")
    assert "unknown study 'pfn' (did you mean 'pfnn'?)" in done.stderr


def test_a_replacement_that_was_cut_short_is_completed_before_it_is_read(tmp_path: Path) -> None:
    out = tmp_path / "out"
    journal = out / ".out.journal"
    for folder in ("new", "old"):
        (journal / folder).mkdir(parents=True)
    plan = {"remove": [], "place": ["results.json"]}
    (journal / "plan.json").write_text(json.dumps(plan))
    content = {"study": "A", "source": "B", "sections": [], "not_run": []}
    facts = {"versions": {}, "commit": "", "command": "c", "date": "d", "runs": 1, "seed": 0}
    content["provenance"] = facts | {"machine": "m"}
    (journal / "new" / "results.json").write_text(json.dumps(content))
    done = coloc("--out", out, "--page", tmp_path / "x.md")
    assert done.exit_code == 0, done.output
    assert (tmp_path / "x.md").read_text().startswith("# A, reproduced")
    assert [path.name for path in out.iterdir()] == ["results.json"]


@pytest.mark.parametrize("content", ["", "[]", "{}", "[" * 100_000, '{"study": 1'])
def test_what_is_no_results_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "results.json").write_text(content)
    done = coloc("--out", tmp_path, "--page", tmp_path / "x.md")
    assert done.exit_code == 2
    assert "results.json holds no results of a study" in done.stderr
    assert done.stderr.count("\n") == 1


# ---------------------------------------------------------------- more rivals, and regimes


def test_rivals_have_accuracy_and_costs() -> None:
    scenario = make_scenario("indoor-v0", horizon=4)
    error = np.full((2, 4, 6), 0.3)
    error[:, 2:], error[0, -1, :2] = 0.1, 5.0
    one = runs_of(scenario, error)
    found: Any = Made(
        {}, {("pf500",): one, ("pf500", "cost"): Cost(np.array([3.0, 5.0]), 10**6, 2)}
    )
    found.settings = Settings(Path("x"), 4, steps=4)
    found.runs = lambda name, agents: {a: one for a in agents if a == "pf500"}
    found.kinds = lambda name, kind: {"pf500": found.get(name, "pf500", kind)}
    *places, cost = rivals.tables(found)
    assert len(places) == 5
    whole, late = np.sqrt((error**2).mean()), np.sqrt((error[:, 2:] ** 2).mean())
    for place in places:
        assert place.rows == [["`pf500`", f"{whole:.3g}", f"{late:.3g}", "0.3", "3", "2 of 12"]]
    assert cost.rows == [["`pf500`", "4.0", "1.000", "0.00"]]
    names = [cell.agents for cell in rivals.cells(found.settings)]
    assert len(names) == 6
    for agent in names[0]:
        make(agent, rivals.variants()[2].build())


def test_a_regime_pairs_the_corrector_with_all_it_must_beat(tmp_path: Path) -> None:
    settings = Settings(tmp_path, 6, steps=9)
    where = regimes.regimes(9)[0]
    scenario, level = make_scenario("indoor-v0", horizon=9), np.arange(1, 4)[:, None, None]
    factors = {"apf": 1.0, regimes.trained(where, tmp_path): 0.9, "ekf": 0.5, WORLD: 9.0}
    there = {
        agent: runs_of(scenario, factor * level * np.ones((3, 9, 6)))
        for agent, factor in factors.items()
    }
    there["pfnn:weights=none"] = there["apf"]
    found: Any = Made({(where.key, agent): one for agent, one in there.items()})
    found.found[where.key, "pfnn", "oracle"] = oracle.Oracle(
        0.8 * level * np.ones((3, 9, 6)), np.ones((3, 9, 6))
    )
    found.settings = settings
    found.runs = lambda name, agents: {
        a: found.get(name, a) for a in agents if found.get(name, a) is not None
    }
    (table,) = regimes.tables(found)
    (line,) = table.rows
    cells = [cell.split(" ")[0] for cell in line]
    assert cells[2:] == ["−10", "+0", "−20", "−50", "−10", "+80"]


def test_every_regime_is_trained_in_and_builds(tmp_path: Path) -> None:
    settings = Settings(tmp_path, 2)
    every, trained = regimes.regimes(), list(regimes.trainings(settings))
    assert len({v.key for v in every}) == len(every) == len(trained) == 14
    for variant, training in zip(every, trained, strict=True):
        learned_in = parse_scenario(dict(training.options)["scenario"])
        assert learned_in.horizon == variant.build().horizon == 300
        assert learned_in.overrides == {**variant.build().overrides, "horizon": 300}
    chosen = Settings(tmp_path, 2, variants=["ranges-random"])
    assert [t.key for t in regimes.trainings(chosen)] == ["ranges-random-300"]
