"""Errors that several sensors have in common: of ranges, of clocks, and errors that persist."""
