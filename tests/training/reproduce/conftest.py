"""What tests of studies share can be imported, also by processes that they start; short timings."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(autouse=True)
def _short_timings(monkeypatch: pytest.MonkeyPatch) -> None:
    """A localizer's time a step, of 5 steps instead of 50."""
    monkeypatch.setattr("training.evaluation.evaluate._TIMED", 5)
