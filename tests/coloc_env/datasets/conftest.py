"""What damage to a file may do: be refused in one line, or leave a recording that is sound."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import strategies as st

from coloc_env.datasets import DataError, Recording

_CHARACTERS = "0123456789.-+e# \n\t\"',;naxé"
_NUMBERS = ("1e308", "-1", "inf", "-inf", "nan", "1e400", "0", "-0.0", "\ufeff", "\r\n\r\n", "1e9")
Survives = Callable[[Callable[[], Recording]], None]


def _sound(recording: Recording) -> None:
    """Everything is finite and in the range of what it stands for."""
    assert np.isfinite(recording.anchors).all()
    assert np.isfinite(recording.landmarks).all()
    for track in recording.truth:
        assert (np.diff(track.time) > 0).all()
        assert (np.abs(track.position) <= 1e7).all()
        assert np.isfinite(track.attitude).all()
        if recording.dim == 3:
            np.testing.assert_allclose(np.linalg.norm(track.attitude, axis=1), 1, atol=1e-6)
    counts = {
        "robot": len(recording.robots),
        "landmark": len(recording.landmarks),
        "anchor": len(recording.anchors),
        "own_tag": recording.tags.shape[1],
        "tag": recording.tags.shape[1],
    }
    for tables in recording.streams.values():
        for table in tables:
            assert (np.diff(table.time) >= 0).all()
            assert np.isfinite(table.values).all()
            for name, column in zip(table.columns, table.values.T, strict=True):
                if name in counts:
                    assert set(column) <= set(range(counts[name]))
                elif name == "range":
                    assert ((column > 0) & (column <= 1000)).all()
                elif name == "bearing":
                    assert (np.abs(column) <= np.pi).all()
                else:
                    assert (np.abs(column) <= 1e9).all()
    assert all(count >= 0 for count in recording.dropped.values())


@pytest.fixture(scope="session")
def survives() -> Survives:
    """Loads; a refusal must be one line."""

    def load(loader: Callable[[], Recording]) -> None:
        try:
            recording = loader()
        except DataError as error:
            if "\n" in str(error):
                pytest.fail(f"more than one line: {error}")
            return
        _sound(recording)

    return load


@pytest.fixture(scope="session")
def damaged() -> Callable[[st.DataObject, str], str]:
    """A text with up to three of its pieces replaced, cut or doubled."""

    def change(data: st.DataObject, content: str) -> str:
        for _ in range(data.draw(st.integers(1, 3))):
            start = data.draw(st.integers(0, len(content)))
            end = data.draw(st.integers(start, min(start + 8, len(content))))
            random = st.text(_CHARACTERS, max_size=4) | st.sampled_from(_NUMBERS)
            content = content[:start] + data.draw(random) + content[end:]
        return content

    return change
