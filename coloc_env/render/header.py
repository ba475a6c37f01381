"""The head of the picture: which scenario, when, and how well the team knows where it is."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text

from coloc_env.render import style
from coloc_env.render.history import History, rms
from coloc_env.render.shapes import HEIGHT, WIDTH, metres
from coloc_env.render.snapshot import Snapshot
from coloc_env.scenario import Scenario

_TILES = (("time", 700), ("step", 820), ("team RMSE now", 960), ("RMSE so far", 1090))


class Header:
    """Name and facts on the left, four figures on the right."""

    def __init__(self, figure: Figure, scenario: Scenario) -> None:
        self._scenario = scenario
        figure.text(24 / WIDTH, 716 / HEIGHT, scenario.name, size=17, weight="bold")
        self._facts = figure.text(24 / WIDTH, 696 / HEIGHT, "", size=10, color=style.MUTED)
        self._tiles: list[Text] = []
        for name, left in _TILES:
            figure.text(left / WIDTH, 696 / HEIGHT, name, size=9.5, color=style.MUTED)
            self._tiles.append(figure.text(left / WIDTH, 716 / HEIGHT, "", size=15))

    def update(self, snapshot: Snapshot, history: History) -> None:
        """Show the moment."""
        self._facts.set_text(self._describe(snapshot))
        now = float(rms(snapshot.error[None])[0])
        words = (
            f"{snapshot.step * self._scenario.arena.dt:.1f} s",
            f"{snapshot.step} / {self._scenario.horizon}",
            _error(now),
            _error(history.rmse),
        )
        for tile, word in zip(self._tiles, words, strict=True):
            tile.set_text(word)

    def _describe(self, snapshot: Snapshot) -> str:
        arena = self._scenario.arena
        sides = [b - a for a, b in zip(arena.low, arena.high, strict=True)]
        large = max(sides) >= 2000
        shown = [f"{side / 1000 if large else side:.3g}" for side in sides]
        words = [_count(arena.n_uavs, "UAV"), f"{' × '.join(shown)} {'km' if large else 'm'}"]
        for kind, points in (("landmark", snapshot.landmarks), ("anchor", snapshot.anchors)):
            if len(points):
                words.append(_count(len(points), kind))
        words += [f"{key}={value}" for key, value in self._scenario.overrides.items()]
        text = "  ·  ".join(words)
        return text if len(text) <= 96 else text[:95] + "…"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("s" if number != 1 else "")


def _error(value: float) -> str:
    """An error in m with three digits at most; a dash where there is none."""
    if not np.isfinite(value):
        return "–"
    return f"{value:.2f} m" if value < 10 else metres(float(f"{value:.3g}"))
