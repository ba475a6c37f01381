"""Simultaneous localization and mapping by a team."""
