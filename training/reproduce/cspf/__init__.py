"""CSPF: the claims of the collaborative Stein particle filter, outliers, and what lies beyond."""

from training.reproduce.cspf import claims, clouds, particle_errors, plan, report
from training.reproduce.study import Part, Study


def cspf() -> Study:
    """CSPF: a collaborative Stein particle filter for relative poses with wrong matches, in its
    own worlds, in harder ones, and on recordings."""
    own = Part(
        "The paper's worlds",
        plan.paper,
        report.text,
        claims.claims,
        tables=report.paper_tables,
        figures=report.FIGURES | clouds.FIGURES,
    )
    beyond = Part("Beyond the paper", plan.beyond, tables=report.beyond_tables)
    real = Part(
        "Recordings",
        plan.real,
        claims=claims.real,
        tables=report.real_tables,
        figures=particle_errors.FIGURES,
    )
    parts = {"paper": own, "robustness": beyond, "real": real}
    return Study("cspf", "CSPF", plan.TITLE, 100, parts)
