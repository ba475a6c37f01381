"""The renderer behind ``render()``: remembers an episode and draws it when asked."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float32

from coloc_env.render.history import History
from coloc_env.render.snapshot import take
from coloc_env.scenario import Scenario
from coloc_env.world import World

if TYPE_CHECKING:
    from coloc_env.render.canvas import Canvas


class Renderer:
    """Pictures of the first world of a batch.

    Call ``record`` before every step with the estimates about to be scored, ``render`` whenever a
    picture is wanted, ``reset`` when a new episode starts. A picture shows the last step recorded:
    truth, measurements and the estimates of that very step; before the first, the world as it
    stands. Figures are made at the first picture and kept; they do not travel with a pickle.
    ``scale`` times a size of 1200 by 750 pixels.
    """

    def __init__(self, scenario: Scenario, scale: float = 1.0) -> None:
        self.scenario, self.scale = scenario, scale
        self._canvases: dict[str, Canvas] = {}
        self.reset()

    def reset(self) -> None:
        """Forget the episode; an open window stays."""
        self._history = History(self.scenario.arena.n_uavs, self.scenario.arena.dim)

    def record(self, world: World, estimates: Float32[torch.Tensor, "1 N A"]) -> None:
        """Remember the current step and what the team makes of it: position (m), velocity (m/s),
        log-std of the position."""
        self._history.add(take(world, estimates))

    def render(self, world: World, mode: str) -> np.ndarray | None:
        """The picture as RGB [H, W, 3] uint8 (``rgb_array``), or None and a window (``human``).

        Raises RuntimeError where no window can be opened.
        """
        snapshot = self._history.latest
        if snapshot is None:
            snapshot = take(world, None)
            self._history.see(snapshot)
        if mode not in self._canvases:
            from coloc_env.render.canvas import CANVASES

            self._canvases[mode] = CANVASES[mode](self.scenario, self.scale)
        return self._canvases[mode].draw(snapshot, self._history, world.alive[0].cpu().numpy())

    def close(self) -> None:
        """Close the window and drop the figures; a later ``render`` makes new ones."""
        for canvas in self._canvases.values():
            canvas.close()
        self._canvases = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_canvases": {}}
