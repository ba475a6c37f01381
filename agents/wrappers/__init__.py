"""Estimators in an environment's loop."""
