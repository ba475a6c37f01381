"""Colours, type and sizes, the same for all panels."""

import numpy as np

INK = "#1c2331"
MUTED = "#667085"
RULE = "#d5dae3"
GRID = "#e4e8ef"
FLOOR = "#f6f7fa"
BACK = "#fafbfc"
LINK = "#8d9ab0"
LANDMARK = "#98a2b3"
WALL = "#7a869c"
FONT = {
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "text.color": INK,
    "mathtext.default": "rm",
}

# Okabe and Ito's colours without yellow and black, then two of Tol's: distinct to all eyes.
UAV_COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#882255",
    "#7F7F1F",
)


def uav_colours(n_uavs: int) -> np.ndarray:
    """RGB [N, 3] in [0, 1]; beyond eight UAVs the colours come round again."""
    return np.array([rgb(UAV_COLOURS[i % len(UAV_COLOURS)]) for i in range(n_uavs)])


def rgb(colour: str) -> tuple[float, float, float]:
    """``#rrggbb`` as three numbers in [0, 1]."""
    red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


def tint(colours: np.ndarray, strength: np.ndarray | float) -> np.ndarray:
    """Colours [..., 3] mixed into the floor's: strength 0 is the floor, 1 the full colour.

    Opaque tints instead of transparency: pieces of a trail that touch leave no seams.
    """
    floor = np.array(rgb(FLOOR))
    return floor + np.asarray(strength)[..., None] * (colours - floor)
