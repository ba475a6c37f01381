"""Kalman filters: one per UAV, or one over the whole team."""
