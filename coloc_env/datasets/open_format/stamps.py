"""Stamps as they are written, in whole nanoseconds and without rounding on the way."""

import decimal
from collections.abc import Sequence

import numpy as np

from coloc_env.datasets.recording import Stamps

DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}  # decimals of a unit that are whole nanoseconds
FARTHEST_TIME = 1 << 62  # ns from the zero of any clock
_LONGEST = 48  # characters


def nanoseconds(texts: Sequence[str], unit: str) -> Stamps:
    """Stamps written in a unit as int64 ns, rounded to the nearest.

    Raises ValueError whose first argument is the index of one that is no time.
    """
    digits = DIGITS[unit]
    found = []
    for i, text in enumerate(texts):
        whole, _, part = text.partition(".")
        try:
            number = text[-1:].isdigit() or text[:1].isdigit()
            if len(part) > digits or not number or "_" in text:
                raise ValueError
            time = int(whole + part.ljust(digits, "0"))
        except ValueError:
            time = _exact(text, digits, i)
        if not -FARTHEST_TIME < time < FARTHEST_TIME:
            raise ValueError(i)
        found.append(time)
    return np.array(found, np.int64)


def seconds_text(stamp: int) -> str:
    """A stamp in ns as s, to the last digit."""
    whole, part = divmod(abs(stamp), 10**9)
    return f"{'-' * (stamp < 0)}{whole}.{part:09d}"


def from_numbers(values: np.ndarray, unit: str) -> Stamps:
    """Stamps that are numbers already (whole, or seconds as a float).

    Raises ValueError whose first argument is the index of one that is no time.
    """
    scale = 10 ** DIGITS[unit]
    if values.dtype.kind in "iu":
        wide = [int(value) * scale for value in values.tolist()]
        for i, value in enumerate(wide):
            if not -FARTHEST_TIME < value < FARTHEST_TIME:
                raise ValueError(i)
        return np.array(wide, np.int64)
    return nanoseconds([repr(value) for value in values.astype(np.float64).tolist()], unit)


def _exact(text: str, digits: int, index: int) -> int:
    """A stamp in any notation; ValueError with the index if it is none."""
    try:
        if len(text) > _LONGEST or "_" in text:
            raise ValueError
        value = decimal.Decimal(text.strip()).scaleb(digits)
        if not value.is_finite() or value.adjusted() > 18:
            raise ValueError
        return int(value.to_integral_value(decimal.ROUND_HALF_EVEN))
    except (ArithmeticError, ValueError):
        raise ValueError(index) from None
