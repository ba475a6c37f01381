"""Particle filtering in parts: the cloud, its likelihood, resampling and tempering."""
