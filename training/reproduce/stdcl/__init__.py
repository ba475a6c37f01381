"""ST-DCL: its figures 4 to 11 and 14 and tables 1 and 2, stress beyond them, what the learned part
adds, and recordings."""

from functools import partial

from training.reproduce.stdcl import (
    claims,
    factors,
    figures,
    goals,
    loop_claims,
    loop_figures,
    plan,
    tables,
    theory_part,
)
from training.reproduce.study import Part, Study


def stdcl(*, n_uavs: int = 200) -> Study:
    """ST-DCL: spatio-temporally decoupled cooperative localization of a swarm (*Drones* 2026,
    10(1), 69), under stress, over a campus, and on recordings."""
    own = Part(
        "Simulations",
        partial(plan.paper, n_uavs),
        tables.paper_text,
        claims.paper,
        goals.goals,
        tables.paper,
        figures.PAPER,
    )
    stress = Part(
        "Stress",
        partial(plan.stress, n_uavs),
        tables.stress_text,
        claims.stress,
        goals.goals,
        tables.stress,
        figures.STRESS,
    )
    learned = Part(
        "The learned part",
        partial(plan.learned, n_uavs),
        tables.learned_text,
        loop_claims.loop,
        goals.goals,
        tables.learned,
        loop_figures.LEARNED,
    )
    theory = Part(
        "Theory and settings",
        partial(theory_part.cells, n_uavs),
        theory_part.text,
        theory_part.claims,
        tables=theory_part.tables,
        figures=theory_part.FIGURES,
    )
    campus = Part(
        "Flights over a campus, simulated",
        partial(plan.campus, n_uavs),
        tables.campus_text,
        claims.campus,
        goals.goals,
        tables.campus,
        loop_figures.CAMPUS,
    )
    real = Part("Recordings", partial(plan.real, n_uavs), tables.real_text, tables=tables.real)
    better = Part(
        "Joint biases and factors of ranges",
        factors.cells,
        factors.text,
        goals=factors.goals,
        tables=factors.table,
    )
    parts = {
        "paper": own, "stress": stress, "learned": learned, "theory": theory, "campus": campus,
        "real": real, "factors": better,
    }  # fmt: skip
    return Study("stdcl", "ST-DCL", plan.TITLE, 50, parts)
