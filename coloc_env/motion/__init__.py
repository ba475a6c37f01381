"""Where the truth's motion comes from: one seam for scripted, random, recorded and steered motion.

All motions are frozen dataclasses. A setting left at ``None`` is fitted to the arena; one that is
given is kept, or refused with a ``ValueError`` that names what fits. Velocity is the derivative of
position, in closed form. Positions in m, times in s, angles in rad, z up.
"""

from typing import Annotated

from coloc_env.motion.aggressive import Aggressive
from coloc_env.motion.base import Arena, Box, Carry, Kinematics, Motion
from coloc_env.motion.court import Court
from coloc_env.motion.curves import Circle, FigureEight, Helix
from coloc_env.motion.followed import Followed
from coloc_env.motion.formation import FormationChange
from coloc_env.motion.groups import Groups
from coloc_env.motion.gusts import GustOptions, Gusts
from coloc_env.motion.inspection import Inspection
from coloc_env.motion.kidnapped import KidnapOptions, Kidnapped
from coloc_env.motion.lanes import Line, Square
from coloc_env.motion.patrol import Patrol
from coloc_env.motion.random_circles import RandomCircles
from coloc_env.motion.random_helices import RandomHelices
from coloc_env.motion.random_velocity import RandomVelocity
from coloc_env.motion.random_walk import RandomWalk
from coloc_env.motion.recorded import RecordedMotion
from coloc_env.motion.roam import Roam
from coloc_env.motion.split import Split
from coloc_env.motion.steered import ControlOptions, Steered
from coloc_env.motion.stop_and_go import StopAndGo
from coloc_env.motion.waypoints import Waypoints
from coloc_env.motion.weave import Weave
from coloc_env.options import OneOf

MOTIONS: dict[str, Motion] = {
    "circle": Circle(),
    "line": Line(),
    "helix": Helix(),
    "figure_eight": FigureEight(),
    "square": Square(),
    "random": RandomCircles(),
    "waypoints": Waypoints(),
    "aggressive": Aggressive(),
    "stop_and_go": StopAndGo(),
    "formation": FormationChange(),
    "random_velocity": RandomVelocity(),
    "multi_scale": Inspection(),
}
MotionName = Annotated[str, OneOf(tuple(MOTIONS))]

__all__ = [
    "MOTIONS",
    "Aggressive",
    "Arena",
    "Box",
    "Carry",
    "Circle",
    "ControlOptions",
    "Court",
    "FigureEight",
    "Followed",
    "FormationChange",
    "Groups",
    "GustOptions",
    "Gusts",
    "Helix",
    "Inspection",
    "KidnapOptions",
    "Kidnapped",
    "Kinematics",
    "Line",
    "Motion",
    "MotionName",
    "Patrol",
    "RandomCircles",
    "RandomHelices",
    "RandomVelocity",
    "RandomWalk",
    "RecordedMotion",
    "Roam",
    "Split",
    "Square",
    "Steered",
    "StopAndGo",
    "Waypoints",
    "Weave",
]
