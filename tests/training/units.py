"""A unit of work that fails in the ways asked for, in a module that workers can import."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Unit:
    """Writes a file; its process is killed the first ``kills`` times; it may raise, or wait."""

    out: Path
    name: str
    kills: int = 0
    raises: bool = False
    seconds: float = 0.0
    size: int = 10

    def settings(self) -> dict[str, Any]:
        return {"name": self.name}

    def done(self) -> bool:
        return (self.out / self.name).exists()

    def run(self, progress: Callable[[int], None]) -> str:
        out = self.out
        tried = len(list(out.glob(f"{self.name}.try-*")))
        (out / f"{self.name}.try-{tried}-{os.getpid()}").touch()
        progress(4)
        if tried < self.kills:
            os.kill(os.getpid(), signal.SIGKILL)
        if self.raises:
            raise ZeroDivisionError("by nothing")
        time.sleep(self.seconds)
        progress(6)
        (out / self.name).touch()
        return self.name
