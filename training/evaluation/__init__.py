"""Evaluation: the rollout, the run record, figures of merit, tables and files."""
