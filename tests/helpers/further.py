"""Parameters of which the quick tests run some, and `make test-slow` all."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def slow_unless(quick: Callable[..., bool], values: Iterable[Any]) -> list[Any]:
    """Mark as slow each of the values, single ones or tuples, that `quick` is false for."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*row, marks=() if quick(*row) else pytest.mark.slow) for row in rows]
