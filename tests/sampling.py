"""Cases that cross several factors, thinned out for the fast tests."""

from collections.abc import Iterable
from itertools import product
from typing import Any

import pytest


def crossed(*factors: Iterable[Any], every: int) -> list[Any]:
    """The product of the factors, as ``parametrize`` takes it; a factor may be of tuples, which are
    spread out. All but one case in ``every`` are slow; every value is among those that are not,
    where another factor has as many values."""
    cases = []
    for numbered in product(*(list(enumerate(factor)) for factor in factors)):
        values = [x for _, v in numbered for x in (v if isinstance(v, tuple) else (v,))]
        later = sum(i for i, _ in numbered) % every != 0
        cases.append(pytest.param(*values, marks=pytest.mark.slow if later else ()))
    return cases


def slowly(*cases: Any) -> list[Any]:
    """Cases that are slow."""
    return [
        pytest.param(*(c if isinstance(c, tuple) else (c,)), marks=pytest.mark.slow) for c in cases
    ]


def first_fast(first: Any, *others: Any) -> list[Any]:
    """Cases of which all but the first are slow."""
    return [first, *slowly(*others)]
