"""One short script per library: how coloc is used from it; ``python -m training.examples.NAME``."""
