"""Settings that cannot work are refused with the setting, its value and what is allowed."""

import pytest

from coloc_env.motion import (
    Aggressive,
    Circle,
    FigureEight,
    FormationChange,
    Helix,
    Line,
    RandomCircles,
    RandomHelices,
    RandomVelocity,
    Square,
    StopAndGo,
    Waypoints,
    Weave,
)

SMALL = (4.0, 4.0, 2.5)
REFUSED = [
    (Circle(), r"Circle: speed / rate.* = 3.33333 .* 4 × 4 × 2.5 m: at most 2"),
    (Circle(speed=-1.0), "Circle: speed must be positive, not -1.0"),
    (Circle(0.1, height=2.4), r"Circle: height = 2.4 .* must be in \[0.3, 2.2\]"),
    (Circle(0.1, height_amplitude=2.0), "Circle: height_amplitude = 2 .* at most 1.25"),
    (Circle(0.1, height_amplitude=-0.1), "Circle: height_amplitude = -0.1 must be at least 0"),
    (Line(margin=2.0), r"Line: margin = 2 .* must be in \[0, 1.25\)"),
    (Line(speed=9.0), "Line: speed = 9 .* at most 1.5"),
    (Line(ramp=float("nan")), "Line: ramp must be positive, not nan"),
    (Helix(climb=2.0), "Helix: climb = 2 .* at most 0.75"),
    (Helix(radius=5.0), "Helix: radius = 5 .* at most 1.5"),
    (FigureEight(half_length=3.0), "FigureEight: half_length = 3 .* at most 1.5"),
    (Square(side=5.0), "Square: side = 5 .* at most 4.5"),
    (Square(side=2.0, corner=(-1.0, 0.0)), r"Square: corner \(-1.0, 0.0\) lies outside"),
    (Square(period=8.0), "Square: period = 8 s is too short .* at least 12 s"),
    (RandomCircles(radius=(1.0, 2.0)), r"RandomCircles: radius\[1\] = 2 .* at most 1.5"),
    (RandomCircles(speed=(0.0, 1.0)), r"RandomCircles: speed must be .* above 0, not \(0.0, 1.0\)"),
    (RandomCircles(height_amplitude=(0.5, 0.1)), "height_amplitude must be .* from 0 on"),
    (RandomCircles(boxes=(((0.0, 0.0), (1.0, 1.0)),)), "RandomCircles: boxes: .* is no box"),
    (
        RandomCircles(radius=(0.5, 1.0), boxes=(((0.0, 0.0, 0.0), (4.0, 2.0, 2.5)),)),
        r"RandomCircles: radius\[1\] = 1 .* 4 × 2 × 2.5 m: at most 0.5",
    ),
    (RandomHelices(climb=(0.0, 1.0)), r"RandomHelices: climb must be .* above 0, not \(0.0, 1.0\)"),
    (Weave(group=0), "Weave: group must be at least one UAV, not 0"),
    (Weave(half_length=(1.0, 2.0)), r"Weave: half_length\[1\] = 2 .* at most 1.5"),
    (Weave(height_amplitude=(0.0, 1.0)), r"Weave: height_amplitude\[1\] = 1 .* at most 0.75"),
    (Weave(speed=(2.0, 1.0)), r"Weave: speed must be .* above 0, not \(2.0, 1.0\)"),
    (Weave(boxes=(((0.0, 2.0, 0.0), (1.0, 2.0, 1.0)),)), "Weave: boxes: .* is no box"),
    (
        Waypoints(duration=1.0),
        "Waypoints: duration = 1 s exceeds max_speed = 3 m/s .* at least 2.8",
    ),
    (Waypoints(route=((1.0, 1.0, 1.0),)), "Waypoints: route needs two different points"),
    (Waypoints(route=((1.0, 1.0, 1.0), (5.0, 1.0, 1.0))), r"route\[1\] = .* not lie in the arena"),
    (
        Waypoints(route=((1.0, 1.0), (2.0, 1.0))),
        r"Waypoints: route\[0\] = \(1.0, 1.0\) does not lie",
    ),
    (
        Aggressive(max_speed=50.0, max_acceleration=80.0, max_jerk=1e4),
        "m/s² downwards; .* at most 8.8",
    ),
    (StopAndGo(radius=2.0), "StopAndGo: radius = 2 .* at most 1.5"),
    (StopAndGo(stop=0.0), "StopAndGo: stop must be positive, not 0.0"),
    (FormationChange(shapes=("line", "star")), "no shape 'star', only line, ring, vee, grid"),
    (FormationChange(shapes=()), "FormationChange: shapes is empty"),
    (FormationChange(size=1.4), "FormationChange: size = 1.4 .* at most 1.35"),
    (FormationChange(size=1.0, radius=1.0), "FormationChange: radius = 1 .* at most 0.5"),
    (FormationChange(blend=30.0), "blend = 30 s must be at most the period of 20 s"),
    (RandomVelocity(v_max=0.0), "RandomVelocity: v_max must be positive, not 0.0"),
    (
        RandomVelocity(boxes=(((0.0, 0.0, 0.0), (5.0, 1.0, 1.0)),)),
        r"RandomVelocity: boxes: .*5.0.* is no box .* in the arena from \(0.0, 0.0, 0.0\) to",
    ),
    (RandomVelocity(boxes=(((0.0, 0.0), (1.0, 1.0)),)), "is no box"),
    (RandomVelocity(boxes=(((0.0, 2.0, 0.0), (1.0, 2.0, 1.0)),)), "is no box"),
    (RandomVelocity(interval=-1.0), "interval = -1 s must be longer than the step"),
    (RandomVelocity(interval=float("nan")), "interval = nan s must be longer than the step"),
    (RandomVelocity(lag=0.05), "RandomVelocity: lag = 0.05 s .* longer than the step of 0.1 s"),
]


@pytest.mark.parametrize(("motion", "message"), REFUSED, ids=lambda x: str(x)[:30])
def test_refusals_say_what_is_allowed(motion, message, fly, arena):
    with pytest.raises(ValueError, match=message):
        fly(motion, arena(*SMALL), [0], 1)
