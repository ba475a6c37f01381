"""Calibration of a recording's sensors: noise, biases, delays, places and scales."""
