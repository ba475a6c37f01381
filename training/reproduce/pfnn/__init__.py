"""PF-NN: its tables 3 to 5 and figures 2 to 9, and a study of robustness beyond it."""

from training.reproduce.pfnn import (
    claims,
    corrector,
    figures,
    paper,
    plan,
    regimes,
    rivals,
    robustness,
    tables,
)
from training.reproduce.study import Part, Study


def pfnn() -> Study:
    """PF-NN: an adaptive particle filter with a neural weight corrector, and robust filters in
    worlds beyond it (*Computers* 2026, 15(3), 172)."""
    own = Part(
        "Tables and figures of the paper",
        plan.paper,
        tables.text,
        claims.claims,
        tables=tables.tables,
        figures=figures.FIGURES,
    )
    beyond = Part(
        "Robustness",
        plan.robustness,
        goals=robustness.goals,
        tables=robustness.tables,
        figures=robustness.FIGURES,
    )
    where = Part(
        "Where the corrector works",
        regimes.cells,
        regimes.text,
        tables=regimes.tables,
        trainings=regimes.trainings,
    )
    more = Part("More rivals", rivals.cells, rivals.text, tables=rivals.tables)
    sees = Part(
        "A corrector that sees residuals", corrector.cells, corrector.text, tables=corrector.tables
    )
    parts = {
        "paper": own,
        "robustness": beyond,
        "rivals": more,
        "regimes": where,
        "corrector": sees,
    }
    return Study("pfnn", "PF-NN", paper.TITLE, paper.RUNS, parts)
