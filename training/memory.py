"""Memory of a computation on the CPU."""

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from torch.profiler import ProfilerActivity, profile


def peak_bytes(call: Callable[[], Any]) -> int:
    """Bytes allocated at the height of a call, as torch's profiler counts them."""
    with tempfile.TemporaryDirectory() as folder, _silenced():
        with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
            call()
        trace = Path(folder) / "trace.json"
        profiler.export_chrome_trace(str(trace))
        events = json.loads(trace.read_text())["traceEvents"]
    changes = [e for e in events if e.get("name") == "[memory]"]
    changes.sort(key=lambda event: event["ts"])
    held = np.cumsum([0, *(event["args"]["Bytes"] for event in changes)])
    return int(held.max())


@contextmanager
def _silenced() -> Iterator[None]:
    """The profiler writes about itself to stderr, past Python: not here."""
    kept = os.dup(2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
