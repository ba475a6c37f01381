"""Whether a motion's settings fit its arena: checks that name the setting and what is allowed."""

from coloc_env.motion.base import Arena, Box, Motion


def positive(motion: Motion, *settings: str) -> None:
    """Every named setting that is given must be a positive finite number."""
    for setting in settings:
        value = getattr(motion, setting)
        if value is not None and not 0 < value < float("inf"):
            raise ValueError(f"{_name(motion, setting)} must be positive, not {value!r}")


def interval(motion: Motion, setting: str, zero: bool = False) -> tuple[float, float]:
    """A setting that is a range (smallest, largest) of positive numbers, or from zero on."""
    small, large = getattr(motion, setting)
    if not (0 < small <= large < float("inf") or (zero and 0 == small <= large)):
        above = "from 0 on" if zero else "above 0"
        raise ValueError(
            f"{_name(motion, setting)} must be (smallest, largest) {above}, not {(small, large)}"
        )
    return small, large


def at_most(motion: Motion, setting: str, value: float, limit: float, arena: Arena) -> float:
    """``value`` if it is allowed. ``setting`` may explain how the value comes about."""
    if not value <= limit * (1 + 1e-12):
        raise ValueError(
            f"{_name(motion, setting)} = {value:g} does not fit the arena of {_size(arena)}: "
            f"at most {limit:g}"
        )
    return value


def half_extents(motion: Motion, arena: Arena, margin: float = 0.0) -> tuple[float, ...]:
    """Half the arena's sides (m), less a margin kept from every wall."""
    halves = tuple(0.5 * (b - a) for a, b in zip(arena.low, arena.high, strict=True))
    if not 0 <= margin < min(halves):
        raise ValueError(
            f"{_name(motion, 'margin')} = {margin:g} does not fit the arena of {_size(arena)}: "
            f"must be in [0, {min(halves):g})"
        )
    return tuple(half - margin for half in halves)


def altitude(motion: Motion, arena: Arena, height: float | None, swing: float = 0.0) -> float:
    """The mean height (m), mid-room if not given; ``swing`` above and below it must fit (3-D)."""
    if arena.dim == 2:
        return 0.0
    if not swing >= 0:
        raise ValueError(f"{_name(motion, 'height_amplitude')} = {swing:g} must be at least 0")
    low, high = arena.low[2], arena.high[2]
    at_most(motion, "height_amplitude", swing, 0.5 * (high - low), arena)
    height = arena.centre[2] if height is None else height
    if not low + swing <= height <= high - swing:
        raise ValueError(
            f"{_name(motion, 'height')} = {height:g} does not fit the arena of {_size(arena)}: "
            f"must be in [{low + swing:g}, {high - swing:g}]"
        )
    return height


def inside(motion: Motion, setting: str, boxes: tuple[Box, ...], arena: Arena) -> None:
    """Every box must have a volume, and lie in the arena."""
    for box in boxes:
        low, high = box
        fits = len(low) == len(high) == arena.dim
        limits = zip(arena.low, low, high, arena.high, strict=False)
        if not (fits and all(a <= b < c <= d for a, b, c, d in limits)):
            raise ValueError(
                f"{_name(motion, setting)}: {box} is no box ((low), (high)) in the arena from "
                f"{arena.low} to {arena.high}"
            )


def only_3d(motion: Motion, arena: Arena) -> None:
    if arena.dim != 3:
        raise ValueError(f"{type(motion).__name__} needs an arena of 3 dimensions, not {arena.dim}")


def _name(motion: Motion, setting: str) -> str:
    return f"{type(motion).__name__}: {setting}"


def _size(arena: Arena) -> str:
    return " × ".join(f"{b - a:g}" for a, b in zip(arena.low, arena.high, strict=True)) + " m"
