"""Frames to files: animated GIF and PNG."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

_COLOURS = 128  # in a GIF's palette: plenty for drawings, and a third smaller than 256


def save_animation(frames: Iterable[np.ndarray], path: str | Path, fps: float = 10.0) -> None:
    """Write frames [H, W, 3] uint8 as a GIF that loops for ever, at ``fps`` frames per second.

    One palette, taken from the last frame (by then everything is on the picture), serves all
    frames, so that colours do not flicker. Raises ValueError for a path that does not end in
    ``.gif``, no frames, frames of different shapes, or an fps outside (0, 100].
    """
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise ValueError(f"save_animation: {path.name!r} is not allowed: a name ending in .gif")
    if not 0 < fps <= 100:
        raise ValueError(f"save_animation: fps={fps!r} is not allowed: 0 < fps ≤ 100")
    images = [_image(frame) for frame in frames]
    if not images:
        raise ValueError("save_animation: no frames; at least one is needed")
    if len({image.size for image in images}) > 1:
        raise ValueError("save_animation: all frames must have the same shape")
    palette = images[-1].quantize(_COLOURS, dither=Image.Dither.NONE)
    first, *rest = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    path.parent.mkdir(parents=True, exist_ok=True)
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0)


def frame_to_png(frame: np.ndarray, path: str | Path) -> None:
    """Write one frame [H, W, 3] uint8 as a PNG."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"frame_to_png: {path.name!r} is not allowed: a name ending in .png")
    path.parent.mkdir(parents=True, exist_ok=True)
    _image(frame).save(path, optimize=True)


def _image(frame: np.ndarray) -> Image.Image:
    """A frame as an image; refuses anything but [H, W, 3] uint8."""
    frame = np.asarray(frame)
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise ValueError(f"a frame is [H, W, 3] uint8, not {frame.dtype}{list(frame.shape)}")
    return Image.fromarray(frame)
