"""Report when something slower takes the place of a kernel.

A program that cannot have a kernel is compiled by XLA instead and computes the same, several times
slower. Every such fallback is one line on standard error, once a process, and is remembered: a run
stores those of its training, and the cache of compiled programs those of each program.
"""

import contextlib
import contextvars
import sys
import threading
from collections.abc import Iterator
from typing import NamedTuple

_COSTS = {
    "physics.impl": "training is 5 to 11 times slower",
    "camera.impl": "images take up to 7 times as long",
    "ppo.update": "training is 2 to 4 times slower",
    "environment step": "training is up to 3 times slower",
    "compilation cache": "every start compiles again, for about half a minute",
}
"""The rough cost of each fallback: docs/troubleshooting.md has the measurements."""


class Fallback(NamedTuple):
    """A `Fallback` holds what runs slower than it could, and why."""

    what: str
    """The setting that chooses the implementation, or `environment step`."""
    reason: str
    """Why there is no kernel, and what the user can do."""

    def __str__(self) -> str:
        return f"{self.what}: {_COSTS[self.what]}: {self.reason}"


_lock = threading.Lock()
_printed: set[str] = set()
_collectors: contextvars.ContextVar[tuple[list[Fallback], ...]] = contextvars.ContextVar(
    "collectors", default=()
)


def report(fallback: Fallback) -> None:
    """Print a fallback as a line on standard error, unless this process has printed it already.

    Args:
      fallback: the fallback, reported whenever a program is traced that has it.
    """
    for found in _collectors.get():
        if fallback not in found:
            found.append(fallback)
    line = str(fallback)
    with _lock:
        if line in _printed:
            return
        _printed.add(line)
    print(f"slow: {line}", file=sys.stderr)


@contextlib.contextmanager
def collect() -> Iterator[list[Fallback]]:
    """Yield a list to which the fallbacks are added that are reported inside the context."""
    found: list[Fallback] = []
    token = _collectors.set((*_collectors.get(), found))
    try:
        yield found
    finally:
        _collectors.reset(token)
