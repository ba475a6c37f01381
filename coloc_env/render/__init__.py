"""Pictures of a running world: RGB frames, a live window, and the files made from frames.

Importing this package does not load matplotlib; drawing the first frame does.
"""

from coloc_env.render.files import frame_to_png, save_animation
from coloc_env.render.renderer import Renderer

__all__ = ["Renderer", "frame_to_png", "save_animation"]
