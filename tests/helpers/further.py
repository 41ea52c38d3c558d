"""Parameters of which the quick tests run some, and fixtures that only `make test-slow` makes."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def slow_unless(quick: Callable[..., bool], values: Iterable[Any]) -> list[Any]:
    """Mark as slow each of the values, single ones or tuples, that `quick` is false for."""
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*row, marks=() if quick(*row) else pytest.mark.slow) for row in rows]


_SLOW_FIXTURES = set()


def slow_fixture(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Declare a fixture of a module, with pytest's options, that makes slow what asks for it."""

    def declare(function: Callable[..., Any]) -> Any:
        _SLOW_FIXTURES.add((function.__module__, function.__name__))
        return pytest.fixture(**options)(function)

    return declare


def mark_what_asks_for_slow_fixtures(items: list[pytest.Item]) -> None:
    """Mark as slow the tests that ask for a slow fixture, directly or through another one."""
    for item in items:
        names = getattr(item, "fixturenames", ())
        if any((item.module.__name__, name) in _SLOW_FIXTURES for name in names):
            item.add_marker(pytest.mark.slow)
