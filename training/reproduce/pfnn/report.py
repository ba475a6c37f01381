"""The report: every table and figure with the paper's numbers beside ours, and the verdicts."""

import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from training.evaluation.tables import table
from training.reproduce import cost, reporting, verdicts
from training.reproduce.pfnn import figures, goals, paper, robust_figures, robustness, tables
from training.reproduce.pfnn.claims import verdicts as judge
from training.reproduce.pfnn.flown import Flown
from training.reproduce.pfnn.robustness import Cells
from training.reproduce.reporting import Text
from training.reproduce.study import Variant

FILES = (
    *figures.FILES,
    *robust_figures.FILES,
    "paper.json",
    "robustness.csv",
    "robustness.json",
    "robustness.md",
)


def paper_part(flown: Flown, folder: Path) -> Text:
    """Write figures and ``paper.json``; the part's lines for the report."""
    judged = judge(flown)
    captions = figures.draw(flown, folder)
    printed = {
        "Table 3. Errors of each UAV (m)": tables.table_3(flown),
        "Table 4. Methods (errors in m)": tables.table_4(flown),
        "Table 5. Cost of a team's step": tables.table_5(flown),
        "Figure 2 in numbers (m)": tables.figure_2(flown),
    }
    what = flown.tables
    text = [
        "## The paper's claims",
        "",
        verdicts.RULE,
        "",
        reporting.counts(judged),
        "",
        *reporting.claims(judged),
    ]
    last, more = what.seed + what.runs - 1, what.seed + flown.cdf.runs - 1
    text += [
        "",
        "## Tables",
        "",
        f"`{what.scenario.name}`, {what.runs} runs of {what.scenario.horizon} steps of "
        f"{what.dt:g} s, seeds {what.seed} to {last} (figure 9: to {more}); the paper has "
        f"{paper.RUNS} runs. Ours: mean ± standard deviation over runs. The largest error is the "
        "mean of the UAVs' largest. DFGO and D-LSPF are not built yet.",
    ]
    for title, (header, lines) in printed.items():
        text += ["", f"### {title}", "", *table(header, lines, left=1 + header.count("agent"))]
        if title.startswith("Table 5"):
            text += ["", _timed(flown), cost.MEMORY]
    text += ["", "## Figures"]
    for name, caption in captions.items():
        text += ["", f"![{caption}]({name})", "", f"*{caption}*"]
    content = {
        "runs": what.runs,
        "seed": what.seed,
        "bound": what.summary["bound"],
        "agents": what.summary["agents"],
        "cost": {
            name: {
                "ms_per_step": float(one.ms.mean()),
                "ms_per_step_std": float(one.ms.std()),
                "belief_bytes": one.belief,
                "working_set_bytes": one.working,
            }
            for name, one in flown.cost.items()
        },
        "claims": [reporting.as_json(each) for each in judged],
    }
    reporting.write_json(folder / "paper.json", content)
    return text


def robust_part(
    found: Cells,
    bounds: Mapping[str, float | None],
    variants: Sequence[Variant],
    agents: Sequence[str],
    folder: Path,
) -> Text:
    """Write the study's table and figures; the part's lines for the report."""
    lines = robustness.rows(found, bounds, variants)
    captions = robust_figures.draw(found, bounds, variants, agents, folder)
    judged = goals.outcomes(found, agents)
    (folder / "robustness.csv").write_text(robustness.csv_text(lines), encoding="utf-8")
    full = "\n".join(["# Robustness: all figures", "", *robustness.full_table(lines)])
    (folder / "robustness.md").write_text(full + "\n", encoding="utf-8")
    content = {
        "rows": lines,
        "goals": [
            {"agent": o.agent, "variant": o.goal.variant, "goal": o.goal.words, "found": o.found,
             "verdict": o.verdict}
            for o in judged
        ],
    }  # fmt: skip
    reporting.write_json(folder / "robustness.json", content)
    text = ["## Robustness", ""]
    for name, caption in captions.items():
        text += [f"![{caption}]({name})", "", f"*{caption}*", ""]
    text += ["All figures with paired differences: `robustness.md`, `.csv`, `.json`."]
    for key, title in robustness.MATRICES.items():
        matrix = robustness.matrix(found, bounds, variants, agents, key)
        text += ["", f"### {title}", "", *matrix]
    titles = {variant.key: variant.title for variant in variants}
    body = [
        [
            f"`{o.agent}`",
            titles.get(o.goal.variant, o.goal.variant),
            o.goal.words,
            o.found,
            o.verdict,
        ]
        for o in judged
    ]
    count = Counter(o.verdict for o in judged)
    total = ", ".join(f"{count[x]} {x}" for x in (goals.MET, goals.MISSED, goals.UNKNOWN))
    text += ["", "### To beat", "", goals.RULE, "", f"{len(judged)} goals: {total}.", ""]
    return text + table(["agent", "variant", "goal", "found", "verdict"], body, left=5)


def _timed(flown: Flown) -> str:
    machine = platform.processor() or platform.machine()
    return (
        f"Times: one world, one thread ({machine}, torch), all methods step by step in turn; mean "
        "± standard deviation over steps. The paper's are MATLAB's on an Apple M1."
    )
