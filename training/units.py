"""A unit of work, what comes of it, and running it where another process waits for that."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

REPORT_EVERY = 0.5  # s between a worker's reports of its progress


class Unit(Protocol):
    """Work of ``size`` steps, which another process can be given."""

    @property
    def size(self) -> int: ...

    def settings(self) -> Mapping[str, Any]:
        """All that the result depends on, code included: what worker and parent must agree on."""
        ...

    def run(self, progress: Callable[[int], None]) -> Any:
        """The result; ``progress`` is given steps as they are done."""
        ...


U = TypeVar("U", bound=Unit)


@dataclass(frozen=True, eq=False)
class Outcome(Generic[U]):
    """A unit with its ``result``, or the ``error`` that it ended in."""

    unit: U
    result: Any = None
    error: Exception | None = None


class WorkerDied(Exception):
    """The process, or the machine, in which a unit ran is gone."""


def outcome(unit: Unit, progress: Callable[[int], None]) -> tuple[Any, Exception | None]:
    """Run a unit; what it raises is returned, an interruption aside."""
    done = 0

    def counted(size: int) -> None:
        nonlocal done
        done += size
        progress(size)

    try:
        return unit.run(counted), None
    except Exception as error:
        progress(unit.size - done)
        return None, error


def checked_outcome(
    unit: Unit, settings: Mapping[str, Any], progress: Callable[[int], None], otherwise: str
) -> tuple[Any, Exception | None]:
    """In a worker: run a unit, if all that it depends on is here what it is for the parent; if not,
    the error says ``otherwise``. Errors can be sent."""
    try:
        same = unit.settings() == settings
    except Exception as error:
        return None, _portable(error)
    if not same:
        return None, RuntimeError(otherwise)
    result, raised = outcome(unit, progress)
    return result, None if raised is None else _portable(raised)


def _portable(error: Exception) -> Exception:
    """An error that another process can read."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
