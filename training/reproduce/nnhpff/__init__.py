"""NN-HPFF: its figures 4 to 8 and table 1, its detector in detail, and a study beyond."""

from training.reproduce.nnhpff import bias, claims, figures, noise, plan, tables
from training.reproduce.study import Part, Study


def nnhpff() -> Study:
    """NN-HPFF: a particle filter that a neural network restarts from a finite impulse response
    filter (*Electronics* 2025, 14(21), 4346), kidnapping, NLOS anchors, recordings."""
    own = Part(
        "The paper's three cases",
        plan.paper,
        tables.paper_text,
        claims.claims,
        tables=tables.paper,
        figures=figures.PAPER,
        trainings=plan.trainings,
    )
    detector = Part(
        "The detector", plan.detector, tables.detector_text, tables=tables.detector,
        figures=figures.DETECTOR,
    )  # fmt: skip
    beyond = Part("Beyond the paper", plan.beyond, tables=tables.beyond, figures=figures.BEYOND)
    several = Part("Several true σ", noise.cells, noise.text, tables=noise.tables)
    alike = Part("Where a network might win", bias.cells, bias.text, tables=bias.tables)
    parts = {
        "paper": own,
        "detector": detector,
        "noise": several,
        "bias": alike,
        "robustness": beyond,
    }
    return Study("nnhpff", "NN-HPFF", plan.TITLE, 100, parts)
