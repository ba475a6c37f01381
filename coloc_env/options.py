"""Options by keyword: what each may be, checked when called from Python, parsed from a command
line.

Options of a scenario, a localizer or a training are the keyword-only parameters of the function or
class that makes it; their annotations state what fits: a number what it measures, and within
what bounds (``Metres``, ``Share``, ``Annotated[float, Quantity("dB", 0)]``). Options that several
functions have in common are declared once, in a dataclass that extends ``Group``: a parameter of
that type stands for all its fields, with the defaults that the function gives. Every refusal is one
line that names the option and what is allowed.
"""

import dataclasses
import difflib
import inspect
import math
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

_UNFIT = object()
_MOST = 1e12  # of anything that is measured: beyond, float32 makes no sense of it


@dataclass(frozen=True)
class Quantity:
    """What a number measures: its ``unit`` and the bounds within which it must lie; ``above`` and
    ``below``: bounds that it must not reach. Infinity fits only where ``infinite``."""

    unit: str = ""
    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    infinite: bool = False

    def allows(self, value: float) -> bool:
        """Whether a number lies within the bounds (NaN does not)."""
        sane = abs(value) <= _MOST or (self.infinite and abs(value) == math.inf)
        under = value < self.below or self.below == math.inf
        return sane and self.least <= value <= self.most and value > self.above and under

    def words(self) -> str:
        """The bounds and the unit, as they follow "a number"."""
        bounds = ""
        if self.above > -math.inf:
            bounds = f" > {self.above:g}"
            if self.below < math.inf:
                bounds += f" and < {self.below:g}"
            elif self.most < math.inf:
                bounds += f" and ≤ {self.most:g}"
        elif self.least > -math.inf and self.below < math.inf:
            bounds = f" ≥ {self.least:g} and < {self.below:g}"
        elif self.least > -math.inf and self.most < math.inf:
            bounds = f" from {self.least:g} to {self.most:g}"
        elif self.least > -math.inf:
            bounds = f" ≥ {self.least:g}"
        return bounds + (f" in {self.unit}" if self.unit else "")


@dataclass(frozen=True)
class OneOf:
    """The names that a text may be."""

    names: tuple[str, ...]


Coordinate = Annotated[float, Quantity("m")]
Metres = Annotated[float, Quantity("m", 0.0)]
PositiveMetres = Annotated[float, Quantity("m", above=0.0)]
Seconds = Annotated[float, Quantity("s", 0.0)]
PositiveSeconds = Annotated[float, Quantity("s", above=0.0)]
Speed = Annotated[float, Quantity("m/s", 0.0)]
PositiveSpeed = Annotated[float, Quantity("m/s", above=0.0)]
Acceleration = Annotated[float, Quantity("m/s²", 0.0)]
WhiteAcceleration = Annotated[float, Quantity("m/s²/√Hz", 0.0)]
AngularRate = Annotated[float, Quantity("rad/s", 0.0)]
Radians = Annotated[float, Quantity("rad", 0.0)]
Degrees = Annotated[float, Quantity("°", 0.0)]
Share = Annotated[float, Quantity("", 0.0, 1.0)]
OpenShare = Annotated[float, Quantity("", above=0.0, below=1.0)]
PositiveShare = Annotated[float, Quantity("", most=1.0, above=0.0)]
Ratio = Annotated[float, Quantity("", 0.0)]
Factor = Annotated[float, Quantity("", above=0.0)]
Count = Annotated[int, Quantity("", 0)]
PositiveCount = Annotated[int, Quantity("", 1)]
Uavs = Annotated[int, Quantity("", 1, 10_000)]  # beyond, all pairs of them fit in no memory


class Group:
    """Base of frozen dataclasses of options that several functions have in common."""

    title: ClassVar[str]


@dataclass(frozen=True)
class Option:
    """One option: its type, its default (``inspect.Parameter.empty``: it must be given), the title
    of the group that it belongs to and what is ``about`` that, and the parameter that takes the
    group (None: the option is a parameter itself)."""

    name: str
    annotation: Any
    default: Any
    group: str = ""
    parameter: str | None = None
    about: str = ""

    @property
    def unit(self) -> str:
        """Unit of the number, or of the first of several; empty where there is none."""
        return next((q.unit for q in _quantities(self.annotation) if q.unit), "")

    @property
    def choices(self) -> tuple[Any, ...]:
        """All that the option may be, where it is a choice."""
        for kind in _alternatives(self.annotation):
            names = _one_of(kind)
            if names is not None:
                return names
        return ()

    @property
    def words(self) -> str:
        """What the option may be, in a user's words."""
        return describe(self.annotation)


def of(function: Callable[..., Any]) -> dict[str, Option]:
    """Options of a function or class, by name: its keyword-only parameters, those of a ``Group``
    spread out. A class that takes ``**options`` passes them on to the class it extends, and so has
    that one's, too."""
    own = inspect.signature(function, eval_str=True).parameters
    found: dict[str, Option] = {}
    for name, parameter in own.items():
        if parameter.kind is not parameter.KEYWORD_ONLY:
            continue
        kind = parameter.annotation
        if isinstance(kind, type) and issubclass(kind, Group):
            hints, about = typing.get_type_hints(kind, include_extras=True), _about(kind)
            for field in dataclasses.fields(kind):  # type: ignore[arg-type]
                default, hint = getattr(parameter.default, field.name), hints[field.name]
                found[field.name] = Option(field.name, hint, default, kind.title, name, about)
        else:
            found[name] = Option(name, kind, parameter.default)
    if isinstance(function, type) and any(p.kind is p.VAR_KEYWORD for p in own.values()):
        extended = of(function.__mro__[1])
        return found | {name: one for name, one in extended.items() if name not in found}
    return found


def _about(group: type[Group]) -> str:
    """What the docstrings of a group, and before them of those it extends, say of its options."""
    kinds = [kind for kind in group.__mro__[::-1] if issubclass(kind, Group) and kind is not Group]
    return " ".join(text for kind in kinds for text in paragraphs(kind.__doc__ or ""))


def checked(owner: str, chosen: Mapping[str, Any], known: Mapping[str, Option]) -> dict[str, Any]:
    """The chosen values, numpy's scalars as Python's; ValueError for an unknown option or a value
    that does not fit."""
    found = {}
    for key, value in chosen.items():
        _known(owner, key, known)
        value = _plain(value)
        if not fits(value, known[key].annotation):
            raise ValueError(_unfit(owner, known[key], value))
        found[key] = value
    return found


def grouped(function: Callable[..., Any], chosen: Mapping[str, Any]) -> dict[str, Any]:
    """The chosen options as keywords of ``function``: what belongs to a group put into that group,
    whose other options keep the function's defaults."""
    known, keywords = of(function), dict(chosen)
    groups: dict[str, dict[str, Any]] = {}
    for name in chosen:
        parameter = known[name].parameter
        if parameter is not None:
            groups.setdefault(parameter, {})[name] = keywords.pop(name)
    defaults = inspect.signature(function).parameters
    for parameter, fields in groups.items():
        keywords[parameter] = dataclasses.replace(defaults[parameter].default, **fields)
    return keywords


def parse(owner: str, text: str, known: Mapping[str, Option]) -> tuple[str, Any]:
    """``key=value`` from a command line, the value read as the option's type.

    Lists of numbers are written ``30,20,5``, time spans ``40:60``, nothing ``none``.
    """
    key, separator, value = text.partition("=")
    if not separator:
        raise ValueError(f"{owner}: option {text!r} is not of the form key=value")
    _known(owner, key, known)
    for kind in _alternatives(known[key].annotation):
        parsed = _parse(value, kind)
        if parsed is not _UNFIT:
            return key, parsed
    raise ValueError(_unfit(owner, known[key], value))


def parse_all(
    owner: str,
    texts: Iterable[str],
    known: Mapping[str, Option],
    given: Mapping[str, Any] = types.MappingProxyType({}),
) -> dict[str, Any]:
    """Several ``key=value``, and what is ``given`` already. Raises ValueError, too, for an option
    that is given twice."""
    found = dict(given)
    for text in texts:
        key, value = parse(owner, text, known)
        if key in found:
            raise ValueError(f"{owner}: {key} is given twice")
        found[key] = value
    return found


def typed(value: Any) -> str:
    """A setting as it would be typed on a command line."""
    if isinstance(value, list | tuple):
        return ",".join(map(typed, value))
    return str(value).lower() if value is None or isinstance(value, bool) else str(value)


def set_words(chosen: Mapping[str, Any]) -> list[str]:
    """Options as words of a command line: ``--set key=value`` each."""
    return [word for key, value in chosen.items() for word in ("--set", f"{key}={typed(value)}")]


def require_known(what: str, wanted: Iterable[str] | None, known: Iterable[str]) -> None:
    """Raise ValueError for a wanted name that does not exist; None wants nothing in particular."""
    names = list(known)
    for key in wanted or ():
        if key not in names:
            raise ValueError(unknown(what, key, names))


def unknown(what: str, key: str, known: Iterable[str]) -> str:
    """The words for a name that does not exist: the closest one, and all there are."""
    names = list(known)
    close = difflib.get_close_matches(key, names, 1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return f"unknown {what} {key!r}{hint}; known: {', '.join(names) or 'none'}"


def describe(annotation: Any) -> str:
    """A type in a user's words."""
    return " or ".join(_describe(kind) for kind in _alternatives(annotation))


def fits(value: Any, annotation: Any) -> bool:
    """Whether a value is of an annotated type and within its bounds (an int fits float; bool fits
    neither)."""
    return any(_fits(value, kind) for kind in _alternatives(annotation))


def paragraphs(text: str) -> list[str]:
    """A docstring's paragraphs, one line each, without marks of code; one that is empty if there is
    no docstring."""
    plain = inspect.cleandoc(text).replace("``", "")
    return [" ".join(paragraph.split()) for paragraph in plain.split("\n\n")]


# ------------------------------------------------------------------ types


def _known(owner: str, key: str, known: Mapping[str, Option]) -> None:
    if key not in known:
        raise ValueError(f"{owner}: {unknown('option', key, known)}")


def _unfit(owner: str, option: Option, value: Any) -> str:
    words = option.words
    if "number" in words and _beyond(value):
        words += f", at most {_MOST:g},"
    return f"{owner}: {option.name}={value!r} is not allowed: {words} is needed"


def _beyond(value: Any) -> bool:
    """Whether a value is a number, or the text of one, that is larger than any may be."""
    try:
        return abs(float(value)) > _MOST
    except (TypeError, ValueError, OverflowError):
        return isinstance(value, int)


def _plain(value: Any) -> Any:
    """A value without numpy: its scalars have an ``item``."""
    if isinstance(value, tuple | list):
        return type(value)(map(_plain, value))
    return value.item() if getattr(value, "shape", None) == () and hasattr(value, "item") else value


def _alternatives(annotation: Any) -> list[Any]:
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return list(typing.get_args(annotation))
    return [annotation]


def _bare(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type, and what is annotated to it."""
    if typing.get_origin(kind) is Annotated:
        inner, *notes = typing.get_args(kind)
        return inner, tuple(notes)
    return kind, ()


def _one_of(kind: Any) -> tuple[Any, ...] | None:
    """The choices of a type; None if it is not a choice."""
    if typing.get_origin(kind) is typing.Literal:
        return typing.get_args(kind)
    return next((note.names for note in _bare(kind)[1] if isinstance(note, OneOf)), None)


def _quantities(annotation: Any) -> list[Quantity]:
    found = []
    for kind in _alternatives(annotation):
        bare, notes = _bare(kind)
        found += [note for note in notes if isinstance(note, Quantity)]
        if typing.get_origin(bare) is tuple:
            found += [q for each in typing.get_args(bare) for q in _quantities(each)]
    return found


def _describe(kind: Any) -> str:
    names = _one_of(kind)
    if names is not None:
        return "one of " + ", ".join(map(str, names))
    bare, notes = _bare(kind)
    bounds = next((note.words() for note in notes if isinstance(note, Quantity)), "")
    words = {
        int: "a whole number",
        float: "a number",
        str: "a name",
        bool: "true or false",
        type(None): "none",
    }
    if typing.get_origin(bare) is tuple:
        inner = typing.get_args(bare)
        size = "" if inner[-1] is Ellipsis else f"{len(inner)} "
        units = dict.fromkeys(q.words() for each in inner for q in _quantities(each))
        return f"{size}numbers{','.join(units)} separated by ',' or ':'"
    return words.get(bare, getattr(bare, "__name__", str(bare))) + bounds


def _each(inner: Sequence[Any], count: int) -> list[Any]:
    """The types of a tuple's ``count`` entries."""
    return [inner[0]] * count if inner[-1] is Ellipsis else list(inner)


def _fits(value: Any, kind: Any) -> bool:
    bare, notes = _bare(kind)
    names = _one_of(kind)
    if names is not None:
        return any(type(value) is type(each) and value == each for each in names)
    if typing.get_origin(bare) is tuple:
        if not isinstance(value, (tuple, list)):
            return False
        kinds = _each(typing.get_args(bare), len(value))
        return len(kinds) == len(value) and all(map(fits, value, kinds))
    bounds = [note for note in notes if isinstance(note, Quantity)]
    if bare in (float, int):
        numbers = (int, float) if bare is float else int
        right = isinstance(value, numbers) and not isinstance(value, bool) and value == value
        return right and all(bound.allows(value) for bound in bounds)
    return isinstance(value, bare)


def _parse(text: str, kind: Any) -> Any:
    bare, _ = _bare(kind)
    names = _one_of(kind)
    if names is not None:
        return next((each for each in names if str(each) == text), _UNFIT)
    if bare is type(None):
        return None if text.lower() == "none" else _UNFIT
    if bare is bool:
        return {"true": True, "false": False, "1": True, "0": False}.get(text.lower(), _UNFIT)
    if typing.get_origin(bare) is tuple:
        pieces = text.replace(":", ",").split(",")
        kinds = _each(typing.get_args(bare), len(pieces))
        if len(kinds) != len(pieces):
            return _UNFIT
        values = tuple(_parse(piece, k) for piece, k in zip(pieces, kinds, strict=True))
        return _UNFIT if _UNFIT in values else values
    try:
        value = bare(text)
    except ValueError:
        return _UNFIT
    return value if fits(value, kind) else _UNFIT
