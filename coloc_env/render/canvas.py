"""Where pictures go: an Agg canvas in memory, or a pyplot window."""

from typing import Protocol

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from coloc_env.render.history import History
from coloc_env.render.picture import Picture
from coloc_env.render.shapes import DPI, HEIGHT, WIDTH
from coloc_env.render.snapshot import Snapshot
from coloc_env.scenario import Scenario

_SIZE = (WIDTH / DPI, HEIGHT / DPI)  # inches


class Canvas(Protocol):
    """What the renderer draws on."""

    def __init__(self, scenario: Scenario, scale: float) -> None: ...

    def draw(
        self, snapshot: Snapshot, history: History, alive: np.ndarray
    ) -> np.ndarray | None: ...

    def close(self) -> None: ...


class Image:
    """Pictures as arrays; pyplot and its backend are never touched."""

    def __init__(self, scenario: Scenario, scale: float) -> None:
        figure = Figure(figsize=_SIZE, dpi=scale * DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(figure)
        self._picture = Picture(figure, scenario)

    def draw(self, snapshot: Snapshot, history: History, alive: np.ndarray) -> np.ndarray:
        """RGB [H, W, 3] uint8."""
        self._picture.update(snapshot, history, alive)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Nothing to close: the figure is known to nobody else."""


class Window:
    """A pyplot window, updated in place; one that the user closed stays closed."""

    def __init__(self, scenario: Scenario, scale: float) -> None:
        import matplotlib.pyplot as plt
        from matplotlib.backends import BackendFilter, backend_registry

        hint = "use render_mode='rgb_array', which needs no display"
        try:
            figure = plt.figure(figsize=_SIZE, dpi=scale * DPI, facecolor="white")
        except Exception as error:  # each backend has its own
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise RuntimeError(f"render_mode='human' found no display ({reason}); {hint}") from None
        backend = plt.get_backend()
        windowed = backend.lower() in backend_registry.list_builtin(BackendFilter.INTERACTIVE)
        if not windowed and figure.canvas.required_interactive_framework is None:
            plt.close(figure)
            raise RuntimeError(
                f"render_mode='human' needs a windowed matplotlib backend, not {backend}; {hint}"
            )
        self._figure = figure
        self._picture = Picture(figure, scenario)
        plt.show(block=False)

    def draw(self, snapshot: Snapshot, history: History, alive: np.ndarray) -> None:
        """Update the window."""
        import matplotlib.pyplot as plt

        if not plt.fignum_exists(self._figure.number):
            return
        self._picture.update(snapshot, history, alive)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        """Close the window if it is open."""
        import matplotlib.pyplot as plt

        plt.close(self._figure)


CANVASES: dict[str, type[Canvas]] = {"rgb_array": Image, "human": Window}
