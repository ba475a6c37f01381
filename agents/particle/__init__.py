"""Particle filters and their parts: the cloud, its likelihood, resampling and tempering."""
